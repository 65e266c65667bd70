"""Imports point downwards only: errors < contract < maths < io < solve < report < stages < tools."""

import ast
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("shared", "stages", "tools")
LAYERS = ("errors", "contract", "maths", "io", "solve", "report", "stages", "tools")
HEAVY = {"numpy", "scipy", "torch", "cv2", "av", "pycolmap", "OpenEXR", "pxr", "matplotlib", "pymeshlab", "embreex"}
FILES = sorted(path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py"))


def module_of(path):
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def layer_of(module):
    """The layer of a module of this project, None for others and for empty package roots."""
    parts = module.split(".")
    if parts[0] in ("stages", "tools"):
        return parts[0]
    if parts[0] != "shared" or len(parts) == 1:
        return None
    return parts[1] if parts[1] in LAYERS else "maths"


def imports_of(path):
    """Names of all modules that a file imports, wherever in the file it does so."""
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; the house writes absolute ones"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names
                        if (REPOSITORY / f"{node.module.replace('.', '/')}/{alias.name}.py").is_file())


def test_files_are_found():
    assert len(FILES) > 20
    assert {layer_of(module_of(path)) for path in FILES} >= {"errors", "contract", "maths", "io", "tools"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_imports_point_downwards(path):
    own = module_of(path)
    layer = layer_of(own)
    if layer is None:
        return
    for name in imports_of(path):
        other = layer_of(name)
        if other is not None:
            assert LAYERS.index(other) <= LAYERS.index(layer), f"{own} ({layer}) imports {name} ({other})"
        if layer == "stages" and name.startswith("stages."):
            assert name == own, f"{own} imports another stage: {name}"


@pytest.mark.parametrize("path", [p for p in FILES if layer_of(module_of(p)) in ("contract", "errors")],
                         ids=lambda path: path.name)
def test_contract_is_light(path):
    heavy = {name.partition(".")[0] for name in imports_of(path)} & HEAVY
    assert not heavy, f"{path.name} imports {heavy}: planning must answer in a second"


@pytest.mark.parametrize("path", [p for p in FILES if layer_of(module_of(p)) == "maths"], ids=lambda path: path.name)
def test_maths_leaves_the_disk_alone(path):
    calls = [node.func for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.Call)]
    opened = [f for f in calls if isinstance(f, ast.Name) and f.id == "open"]
    written = [f.attr for f in calls if isinstance(f, ast.Attribute)
               and f.attr in ("write_text", "write_bytes", "read_text", "read_bytes", "imwrite", "imread", "savez")]
    assert not opened and not written, f"{path.name} touches the disk: arrays in, arrays out"
