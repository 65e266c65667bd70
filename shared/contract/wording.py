"""How the contract speaks: nearest names, checked keys, YAML read strictly."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable
from pathlib import Path

import yaml

from shared.errors import InputError

LARGEST_YAML_BYTES = 1 << 20


def nearest(name: str, known: Iterable[str]) -> str:
    """'did you mean ...?' where one of the known names is close to `name`, else the list of them."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]}?" if close else f"known: {', '.join(known) or 'none'}"


def unknown_name(kind: str, name: object, known: Iterable[str], where: str) -> InputError:
    """The error for a name that nobody declared."""
    return InputError(f"unknown {kind} {str(name)!r}", where=where, mend=nearest(str(name), known))


def check_keys(mapping: object, known: Collection[str], where: str) -> dict:
    """`mapping` itself ({} for None) when it is a mapping with known keys only; InputError otherwise."""
    if mapping is None:
        return {}
    if not isinstance(mapping, dict):
        raise InputError("not a mapping of keys to values", where=where, got=repr(mapping))
    for key in mapping:
        if key not in known:
            raise unknown_name("key", key, known, where)
    return mapping


class _StrictLoader(yaml.SafeLoader):
    """Safe YAML in which a key that is given twice is an error instead of the last one winning."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.MarkedYAMLError(problem=f"key {key!r} is given twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> object:
    """The content of a small YAML file, by the safe loader; InputError with the line when it is not valid."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError("cannot be read", where=str(path), got=error.strerror) from error
    if len(data) > LARGEST_YAML_BYTES:
        raise InputError("too large for a settings file", where=str(path), got=f"{len(data)} bytes")
    try:
        return yaml.load(data.decode("utf-8"), Loader=_StrictLoader)
    except UnicodeDecodeError as error:
        raise InputError("not a text file", where=str(path), expected="UTF-8") from error
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise InputError("not valid YAML", where=f"{path}{line}", got=problem) from error
