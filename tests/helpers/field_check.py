"""Compares what a JSON or NPZ file holds with its declared fields, entry by entry."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from shared.contract.declare import Field

ITEM, ANY_KEY, ALL_BELOW = "[]", "<", ".**"
KINDS = {"number": (int, float), "int": (int,), "text": (str,), "bool": (bool,),
         "number or null": (int, float, type(None))}
"""Of JSON values; arrays of NPZ files name their NumPy type instead."""
_PART = re.compile(r"\[\]|[^.\[\]]+")


def parts_of(field: Field) -> tuple[str, ...]:
    """A field's path, key by key."""
    return tuple(_PART.findall(field.path.removesuffix(ALL_BELOW)))


def below(fields: Iterable[Field], path: str) -> tuple[Field, ...]:
    """The fields that lie under a path, named from there on; ValueError where there are none."""
    start = f"{path}."
    inside = [field for field in fields if field.path.startswith(start)]
    found = tuple(replace(field, path=field.path.removeprefix(start)) for field in inside)
    if not found:
        raise ValueError(f"no field lies below {path}")
    return found


def field_faults(content: Mapping[str, object], fields: Sequence[Field]) -> list[str]:
    """Where a file's content and its declared fields differ: undeclared, missing, of another kind or another shape.

    content: what JSON holds, or {name: array} of an NPZ file.
    """
    return list(_faults(content, _tree(fields), "", {}))


def written_fields(content: Mapping[str, object], fields: Sequence[Field]) -> set[str]:
    """Paths of the declared fields that the content holds; lists and mappings without entries hold none of theirs."""
    return {field.path for field in fields if any(True for _ in _values(content, parts_of(field)))}


class _Node(dict):
    """The parts that may follow a path; field: what ends here."""

    field: Field | None = None


def _tree(fields: Sequence[Field]) -> _Node:
    root = _Node()
    for field in fields:
        node = root
        for part in parts_of(field):
            node = node.setdefault(part, _Node())
        if node.field is not None:
            raise ValueError(f"{field.path} is declared twice")
        node.field = field
    return root


def _faults(value: object, node: _Node, path: str, sizes: dict[str, int]) -> Iterator[str]:
    if node.field is not None and node.field.path.endswith(ALL_BELOW):
        return
    if not node:
        yield from _leaf_faults(value, node.field, path, sizes)
    elif ITEM in node:
        if not isinstance(value, list):
            yield f"{path}: not a list"
            return
        for i, item in enumerate(value):
            yield from _faults(item, node[ITEM], f"{path}[{i}]", {})
    elif not isinstance(value, Mapping):
        yield f"{path or 'the file'}: holds no entries by name"
    else:
        start = f"{path}." if path else ""
        any_key = next((child for part, child in node.items() if part.startswith(ANY_KEY)), None)
        for key, below_key in value.items():
            child = node.get(key, any_key)
            if child is None:
                yield f"{start}{key}: not declared"
            else:
                yield from _faults(below_key, child, f"{start}{key}", sizes if child is not any_key else {})
        for part, child in node.items():
            optional = part.startswith(ANY_KEY) or child.field is not None and child.field.optional
            if part not in value and not optional:
                yield f"{start}{part}: not written"


def _leaf_faults(value: object, field: Field, path: str, sizes: dict[str, int]) -> Iterator[str]:
    found = tuple(getattr(value, "shape", _list_shape(value)))
    expected = [part.strip() for part in field.shape.split(",")] if field.shape else []
    if len(found) != len(expected) and 0 not in found:
        yield f"{path}: has shape {list(found)}, declared is [{field.shape}]"
        return
    for size, name in zip(found, expected, strict=False):
        if size != (int(name) if name.isdigit() else sizes.setdefault(name, size)):
            yield f"{path}: has shape {list(found)}, declared is [{field.shape}]"
            return
    if hasattr(value, "dtype"):
        if str(value.dtype) != field.kind:
            yield f"{path}: is {value.dtype}, declared is {field.kind}"
    elif not all(_is_of(item, field.kind) for item in _flat(value)):
        yield f"{path}: is not {field.kind}"


def _is_of(item: object, kind: str) -> bool:
    return isinstance(item, KINDS.get(kind, ())) and (kind == "bool" or not isinstance(item, bool))


def _list_shape(value: object) -> tuple[int, ...]:
    if not isinstance(value, list):
        return ()
    return (len(value), *_list_shape(value[0])) if value else (0,)


def _flat(value: object) -> Iterator[object]:
    if isinstance(value, list):
        for item in value:
            yield from _flat(item)
    else:
        yield value


def _values(value: object, parts: Sequence[str]) -> Iterator[object]:
    if not parts:
        yield value
    elif parts[0] == ITEM:
        for item in value if isinstance(value, list) else ():
            yield from _values(item, parts[1:])
    elif isinstance(value, Mapping):
        for key, item in value.items():
            if parts[0].startswith(ANY_KEY) or key == parts[0]:
                yield from _values(item, parts[1:])
