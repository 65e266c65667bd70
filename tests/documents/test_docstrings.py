"""What public functions take: arrays have a shape in the docstring, numbers a word there, a unit in their name, or
either has a name that means the same everywhere."""

import ast
import re

import pytest

from tools.documents.readme import DOCS, README

REPOSITORY = README.parent
FILES = sorted(path for room in ("shared", "stages") for path in (REPOSITORY / room).rglob("*.py"))
_ARRAY = re.compile(r"(np\.ndarray|torch\.Tensor)( \| None)?")
_UNIT = re.compile(r"_(mm|px|deg|s|mb|texels|radians)$")
_SHAPE = re.compile(r"\[[^\]]+\]")


def shared_names():
    """The names in the table of docs/architecture.md; each row states a shape, or that it is a number."""
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    table = text.partition("## Names that mean the same everywhere")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.+?) \|", table, re.MULTILINE)
    assert len(rows) > 10 and all(_SHAPE.search(shape) or shape == "number" for _, shape in rows)
    return {name for name, _ in rows}


def has_shape(name, text):
    """Whether a text says `name [..]`, perhaps with the names that share the shape in between."""
    return re.search(rf"\b{name}\b[^.;\[]{{0,60}}\[", text) is not None


def undocumented(function, docstring, of_class=""):
    """Parameters that are arrays and whose shape neither docstring tells. "[N, 3] and [N] -> [N]" tells the shapes of
    as many parameters as it has before the arrow."""
    arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    arrays = [a.arg for a in arguments if a.annotation and _ARRAY.fullmatch(ast.unparse(a.annotation))]
    own, whole = (" ".join(text.split()) for text in (docstring, f"{docstring} {of_class}"))
    missing = [name for name in arrays if not has_shape(name, whole) and name not in shared_names()]
    before = own.partition("->")[0] if "->" in own else ""
    spare = len(_SHAPE.findall(before)) - sum(has_shape(name, before) for name in arrays)
    return missing if len(missing) > spare else []


def unnamed_numbers(function, docstring, of_class=""):
    """Parameters that are floats, whose name states no unit and which neither docstring mentions."""
    arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    floats = [a.arg for a in arguments if a.annotation and re.fullmatch(r"float( \| None)?", ast.unparse(a.annotation))]
    mentioned = set(re.findall(r"\w+", f"{docstring} {of_class}")) | shared_names()
    return [name for name in floats if name not in mentioned and not _UNIT.search(name)]


def public_functions(tree):
    """(class docstring, function) of all public functions and methods."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield "", node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for own in node.body:
                if isinstance(own, ast.FunctionDef) and (own.name in ("__init__", "__call__") or own.name[0] != "_"):
                    yield ast.get_docstring(node) or "", own


@pytest.mark.parametrize("text, missing", [
    ("Nothing.", ["a", "b"]), ("a [N, 3] mm.", ["b"]), ("a, b [N]: weights.", []), ("[N, 3], [N] -> [N].", []),
    ("[N, 3] -> [N], [M].", ["a", "b"]), ("A tall b [N].", ["a"]),
])  # fmt: skip
def test_the_check_sees_what_is_missing(text, missing):
    function = ast.parse("def f(a: np.ndarray, b: np.ndarray | None, faces: np.ndarray, c: int): pass").body[0]
    assert undocumented(function, text) == missing


def test_the_check_sees_unnamed_numbers():
    function = ast.parse("def f(width: float, edge_mm: float, roughness: float, far: float | None): pass").body[0]
    assert unnamed_numbers(function, "far: px.") == ["width"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_arrays_have_shapes_and_numbers_a_meaning(path):
    found = {}
    for of_class, function in public_functions(ast.parse(path.read_bytes())):
        texts = ast.get_docstring(function) or "", of_class
        found[f"{function.name}:{function.lineno}"] = undocumented(function, *texts) + unnamed_numbers(function, *texts)
    assert {where: names for where, names in found.items() if names} == {}
