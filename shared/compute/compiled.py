"""Compiled loops, for what touches millions of numbers once each: array operations would carry every intermediate
result through memory. One thread; the interpreter lock is released, so that other work goes on beside them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numba
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target

from shared.compute.kept_code import VARIABLE, KeptCode

_OPTIONS = {"nogil": True, "error_model": "numpy",
            "fastmath": {"nnan", "ninf", "nsz", "reassoc", "contract", "arcp"}}
cpu_target.typing_context.refresh()  # as the first call of a loop does: a tenth of a second, spent with the imports
cpu_target.target_context.refresh()


def compiled(loop: Callable) -> Callable:
    """Decorator. Sums may be reordered, so that they use the processor's vectors; arguments must be finite.

    Compiled at the first call (half a second), or read from where an earlier process kept it. A loop that closes over
    variables of a function is never kept: they are no part of its sources.
    """
    result = numba.njit(**_OPTIONS)(loop)
    if (folder := os.environ.get(VARIABLE)) and isinstance(result, Dispatcher) and loop.__closure__ is None:
        result._cache = KeptCode(loop, Path(folder) / "loops")
    return result


def compiled_part(loop: Callable) -> Callable:
    """Decorator for what compiled loops call: it becomes a part of each of them.

    A loop with calls to functions of their own is not kept on disk, see kept_code.stands_alone.
    """
    return numba.njit(forceinline=True, **_OPTIONS)(loop)
