"""Work shared out among threads, for loops that release the interpreter's lock."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Result = TypeVar("Result")


def thread_count() -> int:
    """How many this process may use: as many as torch, which is not loaded for that; what it would go by then."""
    if "torch" in sys.modules:
        return sys.modules["torch"].get_num_threads()
    return int(os.environ.get("OMP_NUM_THREADS", "").partition(",")[0] or os.cpu_count() or 1)


@contextmanager
def single_thread() -> Iterator[None]:
    """Within it torch, and what goes by its count, keep to the calling thread: matrices of a few hundred rows take
    longer on two, and their sums do not depend on the number of cores."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def share_out(count: int, work: Callable[[int], Result]) -> list[Result]:
    """Does work(0) to work(count - 1), on as many threads as torch may use -> what they return, in order.

    Each thread takes the next number when it is done with its last. The caller is one of them: with a single thread
    nothing is handed over, which for small pieces of work can cost as much as they do.
    """
    results: list = [None] * count
    numbers = iter(range(count))  # threads that share it never get the same one

    def toil() -> None:
        for number in numbers:
            results[number] = work(number)

    others = min(thread_count(), count) - 1
    if others < 1:
        toil()
        return results
    with ThreadPoolExecutor(others) as pool:
        helping = [pool.submit(toil) for _ in range(others)]
        toil()
    for helper in helping:
        helper.result()
    return results
