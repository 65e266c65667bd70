"""The next item while this one is worked on: decoding, encoding and compiled loops leave the interpreter lock alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
_END = object()


def read_ahead(source: Iterable[Item]) -> Iterator[Item]:
    """The items of source in order, each made on a second thread while the caller is busy with the one before; one
    waits at most. What source raises, the caller gets in its turn."""
    items = iter(source)
    with ThreadPoolExecutor(max_workers=1) as reader:
        waiting = reader.submit(next, items, _END)
        while (item := waiting.result()) is not _END:
            waiting = reader.submit(next, items, _END)
            yield item
