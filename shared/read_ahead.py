"""The next item while this one is worked on: reading and decoding leave the interpreter lock alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item, Result = TypeVar("Item"), TypeVar("Result")


def read_ahead(load: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """load(item) for the items in order, each begun on a second thread while the caller is busy with the one before;
    one waits at most. What load raises, the caller gets at that item's turn."""
    with ThreadPoolExecutor(max_workers=1) as reader:
        waiting = None
        for item in items:
            begun = reader.submit(load, item)
            if waiting is not None:
                yield waiting.result()
            waiting = begun
        if waiting is not None:
            yield waiting.result()
