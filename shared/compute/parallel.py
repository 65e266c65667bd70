"""Work on several frames or points at once: OpenCV, numpy and compiled loops let go of the interpreter."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS = len(os.sched_getaffinity(0))
"""So much at once: OpenCV's own threads gain little on pictures as small as a head."""


def in_order(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """work(item) for each, THREADS at once, in the items' order; few results wait, so that memory stays bounded."""
    with ThreadPoolExecutor(THREADS) as pool:
        waiting = []
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > 2 * THREADS:
                yield waiting.pop(0).result()
        for future in waiting:
            yield future.result()


def shared_out(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """work(item) for each on THREADS threads, or here where there is one item only -> what they return, in order."""
    if len(items) < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, items))
