"""One name stands for one thing: what the code calls its classes."""

import ast
import inspect
import re
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


PRIVATE_WORDS = {
    "ladder": "model selection", "rung": "candidate", "rungs": "candidates", "climbed": "accepted",
    "gloss": "specular intensity or specular transfer", "misfit": "error or reduced chi-square",
    "trust": "weight or covariance", "distrust": "variance inflation", "doubts": "diagnostics",
    "settle": "resolve the albedo-light scale", "roughen": "step or update", "scenery": "precomputed transfer",
    "sights": "observations", "takes": "scenes", "dials": "perturbations", "spoil": "degrade", "booking": "resources",
    "mend": "hint", "satisfied": "inactive",
}
PRIVATE_KEYS = {"signs": "diagnostics", "light_trust": "light_weights", "evidence": "independent_samples"}
ALLOWED_WORDS = {
    "trust": {"shared/contract/confine.py"},  # of folders: whom the operator vouches for
    "settle": {"shared/contract/interpreter.py", "shared/contract/cli.py", "shared/contract/launch.py"},  # variables
}


def words_of(name):
    """The words of a snake_case or CamelCase name, in lower case."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z0-9]+|[A-Z0-9]+(?![a-z])", name)]


def names_of(tree):
    """(name, line) of what a module defines, binds or takes, and of texts that are keys of records."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield node.name, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr, node.lineno
        elif isinstance(node, ast.Dict):
            yield from ((key.value, key.lineno) for key in node.keys
                        if isinstance(key, ast.Constant) and isinstance(key.value, str))


def private_names(path, tree):
    for name, line in names_of(tree):
        for word in words_of(name):
            term = PRIVATE_WORDS.get(word)
            if term and path not in ALLOWED_WORDS.get(word, ()):
                yield f"{path}:{line}: {name}: say {term}"


def test_names_are_the_fields_words():
    sample = "class LadderStep:\n    def at(self, trust): self.rung = {'misfit': 1}\n"
    assert len(list(private_names("x.py", ast.parse(sample)))) == 4
    found = [fault for path, tree in modules() if not path.startswith("tools/") for fault in private_names(path, tree)]
    assert found == []


def test_stored_fields_are_the_fields_words():
    """Names in files that runs write, as shared/contract/records.py declares them, and parameters of the stages."""
    from shared.contract import records
    from shared.contract.pipeline import load_pipeline

    fields = [part for value in vars(records).values() if isinstance(value, tuple) for part in value
              if isinstance(part, records.Field)]
    stored = {part for field in fields for part in re.findall(r"[a-z_]+", field.path)}
    stored |= {word for part in stored for word in words_of(part)}
    assert len(stored) > 100
    assert stored & (PRIVATE_WORDS.keys() | PRIVATE_KEYS.keys()) == set()
    parameters = {p.name for stage in load_pipeline().stages.values() for p in stage.parameters}
    assert {word for name in parameters for word in words_of(name)} & PRIVATE_WORDS.keys() == set()
    assert parameters & {"fit", "window", "texel", "shape_rounds", *PRIVATE_KEYS} == set()


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
