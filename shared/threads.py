"""Work shared out among threads, for loops that release the interpreter's lock."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Result = TypeVar("Result")


def share_out(count: int, work: Callable[[int], Result]) -> list[Result]:
    """Does work(0) to work(count - 1), on as many threads as torch may use -> what they return, in order."""
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        return list(pool.map(work, range(count)))
