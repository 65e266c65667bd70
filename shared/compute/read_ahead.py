"""The next item while this one is worked on, and the last one's files: decoding, encoding and compiled loops leave the
interpreter lock alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
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


@contextmanager
def write_behind() -> Iterator[Callable[..., None]]:
    """A function that makes calls, in order, on a second thread while the caller goes on; one is on its way at most.
    What a call raises, the caller gets at the next one, or at the end."""
    with ThreadPoolExecutor(max_workers=1) as writer:
        last: list[Future] = []

        def write(call: Callable, *arguments: object) -> None:
            while last:
                last.pop().result()
            last.append(writer.submit(call, *arguments))

        yield write
        while last:
            last.pop().result()
