"""Work shared out among threads, for loops that release the interpreter's lock."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch


def share_out(count: int, work: Callable[[int], object]) -> None:
    """Does work(0) to work(count - 1), on as many threads as torch may use."""
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(work, range(count)))
