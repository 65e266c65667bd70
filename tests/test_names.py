"""One name stands for one thing: what the code calls its classes."""

import ast
import inspect
from collections import Counter, defaultdict
from pathlib import Path

from shared.errors import InputError

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


def packed_arguments(tree):
    """Lines of calls that unpack (* or **) a name which the same function bound to a tuple or dictionary written out
    and reads nowhere else: arguments that were packed to save lines. Options that several calls share, a size, a range,
    zip(*rows) or a record of a file are none."""
    for function in ast.walk(tree):
        if not isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        nodes = list(ast.walk(function))
        written_out = {
            target.id for node in nodes if isinstance(node, ast.Assign) for target in node.targets
            if isinstance(target, ast.Name) and isinstance(node.value, (ast.Tuple, ast.Dict))
        }
        reads = Counter(node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load))
        for call in (node for node in nodes if isinstance(node, ast.Call)):
            starred = [part.value for part in call.args if isinstance(part, ast.Starred)]
            starred += [part.value for part in call.keywords if part.arg is None]
            if any(isinstance(v, ast.Name) and v.id in written_out and reads[v.id] == 1 for v in starred):
                yield call.lineno


def test_arguments_are_written_at_the_call():
    assert list(packed_arguments(ast.parse("def f():\n    more = 1, 2\n    g(*more)\n    h(*zip(*rows))"))) == [3]
    assert [f"{path}:{line}" for path, tree in modules() for line in sorted(set(packed_arguments(tree)))] == []


def test_errors_are_raised_with_the_words_that_they_know():
    """An error's own line would else be a TypeError, seen only by whom it should have helped."""
    known = set(inspect.signature(InputError).parameters)
    calls = [
        (path, call) for path, tree in modules() for call in ast.walk(tree)
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "InputError"
    ]
    assert len(calls) > 100
    assert [f"{path}:{call.lineno}: {word.arg}" for path, call in calls for word in call.keywords
            if word.arg is not None and word.arg not in known] == []
