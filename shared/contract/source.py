"""Reads a stage's declaration from its file without importing what the stage imports.

Planning must answer in a second although the stages themselves load torch, OpenCV and pycolmap. Only the statement
`STAGE = Stage(...)`, the file's own constants that it uses and imports from shared.contract are evaluated.
"""

from __future__ import annotations

import ast
import hashlib
import marshal
import os
import sys
import sysconfig
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import CodeType

from shared.contract.declare import Stage
from shared.contract.hashing import hash_file
from shared.errors import InputError, LimnError

_STANDARD_LIBRARY = sysconfig.get_path("stdlib")
_INSTALLED = {"site-packages", "dist-packages"}
CODE_SUFFIXES = frozenset({".py", ".j2", ".css", ".js"})
"""Modules, and templates of pages with their styles and scripts."""


def read_declaration(path: Path) -> Stage:
    """The STAGE of a stage file; InputError where there is no such file or it declares nothing."""
    if not path.is_file():
        raise InputError("no such stage", where=str(path), hint="correct 'stages' in pipeline.yaml")
    tree = ast.parse(path.read_bytes(), filename=str(path))
    assigned = {target.id: node for node in tree.body for target in _targets(node)}
    if "STAGE" not in assigned:
        raise InputError("declares no STAGE = Stage(...)", where=str(path))
    needed = _needed_names(assigned, "STAGE")
    statements = [node for node in tree.body if _is_contract_import(node) or needed & {t.id for t in _targets(node)}]
    namespace: dict[str, object] = {}
    try:
        exec(compile(ast.Module(statements, type_ignores=[]), str(path), "exec"), namespace)
    except NameError as error:
        raise LimnError(f"{path}: STAGE uses {error.name}, which is neither a constant of the file nor of "
                        "shared.contract") from error
    stage = namespace["STAGE"]
    if not isinstance(stage, Stage) or stage.name != path.stem:
        raise LimnError(f"{path}: STAGE is not a Stage named {path.stem!r}")
    return stage


def loaded_files(roots: Sequence[Path]) -> dict[str, Path]:
    """{file relative to the first of the folders that holds it: its path} of the modules loaded from there.

    A module that fills templates names their folder, TEMPLATES: its files count as the module's own. This package and
    all that is installed are left out.
    """
    inside = tuple(f"{root}{os.sep}" for root in roots)
    files = {file: module for module in list(sys.modules.values()) if (file := getattr(module, "__file__", None))}
    ours = {Path(file): module for file, module in files.items()
            if file.startswith(inside) and _INSTALLED.isdisjoint(file.split(os.sep))}
    folders = {vars(module)["TEMPLATES"] for module in ours.values() if "TEMPLATES" in vars(module)}
    found = {*ours, *(path for folder in folders for path in Path(folder).iterdir())}
    names: dict[str, Path] = {}
    for path in sorted(found):
        root = next((root for root in roots if path.is_relative_to(root)), None)
        if root is not None and path.suffix in CODE_SUFFIXES and not path.is_relative_to(_STANDARD_LIBRARY):
            names.setdefault(path.relative_to(root).as_posix(), path)
    return {name: path for name, path in names.items()
            if not name.startswith((".", "shared/contract/")) and _INSTALLED.isdisjoint(path.parts)}


def loaded_code(roots: Sequence[Path]) -> dict[str, str]:
    """{file: fingerprint} of the same."""
    return {name: fingerprint(path) for name, path in loaded_files(roots).items()}


def loaded_sources(roots: Sequence[Path]) -> dict[str, str]:
    """{file: SHA-256} of the same. A file whose bytes are those of before needs no fingerprint to be the same code."""
    return {name: hash_file(path) for name, path in loaded_files(roots).items()}


def fingerprint(path: Path) -> str:
    """SHA-256 of the file's byte code: without comments, layout, docstrings and assertions; of a template's bytes.

    Advisory: a stage runs again when its version changes, not when this does; see drift.py.
    """
    if path.suffix != ".py":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return _fingerprint_of(path.read_bytes())


@cache
def _fingerprint_of(source: bytes) -> str:
    code = compile(source, "", "exec", dont_inherit=True, optimize=2)
    return hashlib.sha256(marshal.dumps(_without_lines(code), 2)).hexdigest()  # 2: the last without shared references


def _without_lines(code: CodeType) -> CodeType:
    constants = tuple(_without_lines(part) if isinstance(part, CodeType) else part for part in code.co_consts)
    return code.replace(co_consts=constants, co_firstlineno=0, co_linetable=b"")


def _targets(node: ast.stmt) -> list[ast.Name]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    flat = [part for target in targets for part in (target.elts if isinstance(target, ast.Tuple) else [target])]
    return [target for target in flat if isinstance(target, ast.Name)]


def _needed_names(assigned: dict[str, ast.stmt], name: str) -> set[str]:
    """Names of the file's own constants that `name` depends on, itself included."""
    needed, waiting = set(), [name]
    while waiting:
        current = waiting.pop()
        if current in needed or current not in assigned:
            continue
        needed.add(current)
        waiting += [node.id for node in ast.walk(assigned[current]) if isinstance(node, ast.Name)]
    return needed


def _is_contract_import(node: ast.stmt) -> bool:
    return isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith("shared.contract")
