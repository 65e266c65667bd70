"""The next item while this one is worked on: decoding, encoding and compiled loops leave the interpreter lock alone."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from shared.compute.threads import thread_count

Item = TypeVar("Item")
Result = TypeVar("Result")
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


def work_ahead(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """work(item) for each in the items' order, on as many threads as torch may use, while the caller is busy with the
    one before; as many wait or are made at most. The items themselves are asked for in the caller's thread; what work
    raises, the caller gets in its turn."""
    threads, under_way = thread_count(), deque()
    with ThreadPoolExecutor(threads) as pool:
        for item in items:
            under_way.append(pool.submit(work, item))
            if len(under_way) > threads:
                yield under_way.popleft().result()
        while under_way:
            yield under_way.popleft().result()
