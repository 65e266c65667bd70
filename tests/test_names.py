"""One name stands for one thing: what the code calls its classes."""

import ast
from collections import defaultdict
from pathlib import Path

REPOSITORY = Path(__file__).parent.parent
ROOMS = ("shared", "stages", "tools")


def modules():
    """(path below the repository, syntax tree) of each module."""
    for room in ROOMS:
        for path in sorted((REPOSITORY / room).rglob("*.py")):
            yield path.relative_to(REPOSITORY).as_posix(), ast.parse(path.read_text(encoding="utf-8"))


def test_no_class_name_is_defined_twice():
    places = defaultdict(list)
    for path, tree in modules():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(f"{path}:{node.lineno}")
    assert len(places) > 100
    assert {name: where for name, where in places.items() if len(where) > 1} == {}
