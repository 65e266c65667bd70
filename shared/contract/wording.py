"""How the contract speaks: nearest names, checked keys, YAML read strictly."""

from __future__ import annotations

import difflib
import stat
from collections.abc import Collection, Iterable
from pathlib import Path

import yaml

from shared.errors import InputError, shown

LARGEST_YAML_BYTES = 1 << 16
MOST_PIXELS = 1e9


def nearest(name: str, known: Iterable[str]) -> str:
    """'did you mean ...?' where one of the known names is close to `name`, else the list of them."""
    known = sorted(known)
    close = difflib.get_close_matches(name[:80], known, n=1, cutoff=0.5)
    return f"did you mean {close[0]}?" if close else f"known: {', '.join(known) or 'none'}"


def unknown_name(kind: str, name: object, known: Iterable[str], where: str) -> InputError:
    """The error for a name that nobody declared."""
    return InputError(f"unknown {kind} {shown(name)}", where=where, hint=nearest(shown(name).strip("'\""), known))


def check_keys(mapping: object, known: Collection[str], where: str) -> dict:
    """`mapping` itself ({} for None) when it is a mapping with known keys only; InputError otherwise."""
    if mapping is None:
        return {}
    if not isinstance(mapping, dict):
        raise InputError("not a mapping of keys to values", where=where, got=shown(mapping))
    for key in mapping:
        if key not in known:
            raise unknown_name("key", key, known, where)
    return mapping


class Anything:
    """A collection that holds every key: for mappings whose keys are names that the file itself gives."""

    def __contains__(self, key: object) -> bool:
        return True


class _StrictLoader(yaml.SafeLoader):
    """Safe YAML in which a key that is given twice is an error instead of the last one winning.

    No aliases: a few lines of them can stand for billions of values.
    """

    def compose_node(self, parent: yaml.Node | None, index: object) -> yaml.Node:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(problem="aliases (*name) are not allowed here", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key in (self.construct_object(key, deep=True) for key, _ in node.value):
            if key in seen:
                problem = f"key {shown(key)} is given twice"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


    def construct_yaml_int(self, node: yaml.ScalarNode) -> int | str:
        """060 is sixty, as in YAML 1.2 and on every lens; 1:30 stays text instead of ninety."""
        text = self.construct_scalar(node).replace("_", "")
        if ":" in text:
            return text
        return int(text, 10) if text.lstrip("+-").isdigit() else super().construct_yaml_int(node)

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float | str:
        """1:30.5 stays text."""
        text = self.construct_scalar(node)
        return text if ":" in text else super().construct_yaml_float(node)


for _kind in ("int", "float"):
    _StrictLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", getattr(_StrictLoader, f"construct_yaml_{_kind}"))


def check_pixels(values: Iterable[object], where: str, expected: str) -> None:
    """InputError unless all are numbers that could be a place in a picture."""
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MOST_PIXELS:
            raise InputError("not a number of pixels", where=where, got=shown(value), expected=expected)


def read_yaml(path: Path) -> object:
    """The content of a small YAML file, by the safe loader; InputError with the line when it is not valid."""
    data = _read_settings(path)
    try:
        return yaml.load(data.decode("utf-8"), Loader=_StrictLoader)
    except UnicodeDecodeError as error:
        raise InputError("not a text file", where=str(path), expected="UTF-8") from error
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError, ArithmeticError,
            RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError("not valid YAML", where=f"{path}{line}", got=problem) from error


def _read_settings(path: Path) -> bytes:
    """The bytes of a settings file; InputError for what is too large, or no file at all."""
    try:
        facts = path.stat()
        if not stat.S_ISREG(facts.st_mode):
            raise InputError("not a file", where=str(path))
        if facts.st_size > LARGEST_YAML_BYTES:
            raise InputError("too large for a settings file", where=str(path), got=f"{facts.st_size} bytes",
                             expected=f"{LARGEST_YAML_BYTES} or fewer")
        return path.read_bytes()
    except OSError as error:
        raise InputError("cannot be read", where=str(path), got=error.strerror) from error
