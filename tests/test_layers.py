"""The rooms of the house and the doors between them: which package may import which, without circles.

The table below is the whole rule. A row names only rows above it, so there is no circle of packages; modules have none
either. Every package's own words (its __init__) name the same doors, and all of its modules in an order to read them.
"""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
TOPS = ("shared", "stages", "tools")
MAY_IMPORT = {
    "shared.errors": "",
    "shared.contract": "",
    "shared.compute": "",
    "shared.geometry": "compute",
    "shared.imaging": "compute geometry",
    "shared.io": "geometry imaging",
    "shared.capture": "contract compute geometry imaging io",
    "shared.hair": "compute geometry imaging io",
    "shared.tracking": "contract compute geometry io capture",
    "shared.actions": "compute geometry tracking",
    "shared.rendering": "compute geometry imaging",
    "shared.appearance": "compute geometry imaging capture rendering",
    "shared.shape": "compute geometry imaging tracking rendering appearance",
    "shared.selection": "imaging rendering appearance",
    "shared.published": "compute geometry imaging rendering appearance",
    "shared.inverse":
        "contract compute geometry imaging io capture hair tracking rendering appearance shape selection published",
    "shared.report": "contract geometry imaging io capture tracking rendering",
    "stages": "shared",
    "tools.cli": "shared stages",
    "tools.relight": "shared",
    "tools.limn": "shared tools.cli tools.relight",
    "tools.synthesis": "shared",
    "tools.synthesize": "tools.synthesis",
    "tools.scoring": "shared",
    "tools.score": "tools.scoring",
    "tools.demo": "tools.limn tools.synthesis tools.scoring",
    "tools.bench.peers": "shared tools.scoring",
    "tools.bench.runner": "shared",
    "tools.bench.drawing": "shared",
    "tools.bench.chart":
        "shared tools.synthesis tools.scoring tools.demo tools.relight tools.bench.runner tools.bench.drawing",
    "tools.bench.stress":
        "shared tools.cli tools.synthesis tools.scoring tools.bench.runner tools.bench.drawing",
    "tools.bench":
        "shared stages tools.synthesis tools.scoring tools.bench.runner tools.bench.drawing tools.bench.peers "
        "tools.bench.chart tools.bench.stress tools.relight",
    "tools.setup.head_model": "shared",
    "tools.setup": "shared tools.bench.peers tools.setup.head_model",
    "tools.documents": "shared tools.bench tools.bench.chart",
    "tools.goldens": "shared tools.limn tools.scoring",
}
"""Row: rows that it may import. Rows of shared are named without the prefix, and may all import shared.errors; `shared`
stands for all of its rows."""
HEAVY = {"numpy", "scipy", "torch", "cv2", "av", "pycolmap", "OpenEXR", "pxr", "matplotlib", "pymeshlab", "embreex"}
TOUCH_THE_DISK = ("shared.contract", "shared.io", "shared.report.template", "shared.tracking.models",
                  "shared.compute.kept_code")
"""Packages and modules of the library that open files; all others take arrays and return arrays, or call these."""
FILES = sorted(path for top in TOPS for path in (REPOSITORY / top).rglob("*.py"))
PACKAGES = sorted(path.parent for path in FILES if path.name == "__init__.py")


def module_of(path):
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def row_of(module):
    """The row of a module of this project: the longest that it lies in; None for others and for empty roots."""
    parts = module.split(".")
    rows = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
    return next((row for row in rows if row in MAY_IMPORT), None)


def allowed(row):
    """The rows that a row may import."""
    prefix = "shared." if row.startswith("shared.") else ""
    named = [prefix + name for name in MAY_IMPORT[row].split()]
    every = [other for other in MAY_IMPORT if other.startswith("shared.")] if "shared" in named else []
    own = ["shared.errors"] if prefix and row != "shared.errors" else []
    return {*(name for name in named if name != "shared"), *every, *own}


@cache
def imports_of(path):
    """Names of all modules that a file imports, wherever in the file it does so."""
    found = []
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; the house writes absolute ones"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found += [name if is_module(name) else node.module for name in names]
    return found


def is_module(name):
    path = REPOSITORY / name.replace(".", "/")
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def identity(path):
    return path.relative_to(REPOSITORY).as_posix()


def test_files_are_found():
    assert len(FILES) > 200
    assert {row_of(module_of(path)) for path in FILES} - {None} == set(MAY_IMPORT), "a row without a file"


def test_every_module_has_its_row():
    rowless = [identity(path) for path in FILES if row_of(module_of(path)) is None]
    assert rowless == ["shared/__init__.py", "tools/__init__.py"]


def test_a_row_names_only_rows_above_it():
    rows = list(MAY_IMPORT)
    for place, row in enumerate(rows):
        assert allowed(row) <= set(rows[:place]), f"{row}: {allowed(row) - set(rows[:place])}"


@pytest.mark.parametrize("path", FILES, ids=identity)
def test_imports_take_a_door_of_the_table(path):
    own = module_of(path)
    row = row_of(own)
    for name in imports_of(path):
        other = row_of(name)
        if other not in (None, row):
            assert other in allowed(row), f"{own} imports {name}: {row} may not import {other}"
        if row == "stages" and name.startswith("stages."):
            assert name == own, f"{own} imports another stage: {name}"


def test_every_door_of_shared_is_used():
    used = {(row_of(module_of(path)), row_of(name)) for path in FILES for name in imports_of(path)}
    unused = [(row, other) for row in MAY_IMPORT if row.startswith("shared.") for other in allowed(row)
              if other != "shared.errors" and (row, other) not in used]
    assert not unused, "the table allows more than the code takes"


def test_modules_import_each_other_in_no_circle():
    modules = {module_of(path): {name for name in imports_of(path) if name != module_of(path) and is_module(name)}
               for path in FILES}
    TopologicalSorter(modules).prepare()


def said_of(folder, words):
    """What a package's docstring says after these words, up to the full stop."""
    text = " ".join(ast.get_docstring(ast.parse((folder / "__init__.py").read_bytes())).split())
    return re.search(rf"{words}: (.*?)\.( |$)", text)[1]


@pytest.mark.parametrize("folder", [p for p in PACKAGES if p.parent != REPOSITORY], ids=identity)
def test_a_package_says_what_it_may_import_and_in_which_order_to_read_it(folder):
    package = module_of(folder / "__init__.py")
    order, doors = (said_of(folder, words).split(", ") for words in ("Read in this order", "May import"))
    assert sorted(order) == sorted({path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"})
    assert set(doors) - {"errors", "nothing"} == set(MAY_IMPORT[package].split())


@pytest.mark.parametrize("folder", [p for p in PACKAGES if p.parent != REPOSITORY], ids=identity)
def test_the_architecture_page_has_the_modules_in_the_order_of_the_package(folder):
    page = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
    row = re.search(rf"^\| `{identity(folder)}/` \| [^|]+ \| ([^|]+) \|", page, re.MULTILINE)
    assert row and row[1] == said_of(folder, "Read in this order")


def test_the_roots_stay_tidy():
    assert len(list((REPOSITORY / "shared").glob("*.*"))) <= 3
    assert len(list((REPOSITORY / "tools").glob("*.*"))) <= 5


@pytest.mark.parametrize("path", [p for p in FILES if row_of(module_of(p)) in ("shared.contract", "shared.errors")],
                         ids=lambda path: path.name)
def test_contract_is_light(path):
    heavy = {name.partition(".")[0] for name in imports_of(path)} & HEAVY
    assert not heavy, f"{path.name} imports {heavy}: planning must answer in a second"


@pytest.mark.parametrize("path", [p for p in FILES if (row_of(module_of(p)) or "").startswith("shared.")
                                  and not {row_of(module_of(p)), module_of(p)} & {*TOUCH_THE_DISK}], ids=identity)
def test_the_rest_of_the_library_leaves_the_disk_alone(path):
    calls = [node.func for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.Call)]
    opened = [f for f in calls if isinstance(f, ast.Name) and f.id == "open"]
    written = [f.attr for f in calls if isinstance(f, ast.Attribute)
               and f.attr in ("write_text", "write_bytes", "read_text", "read_bytes", "imwrite", "imread", "savez")]
    assert not opened and not written, f"{path.name} touches the disk: arrays in, arrays out"
