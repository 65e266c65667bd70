"""Compiled loops, for what touches millions of numbers once each: array operations would carry every intermediate
result through memory. One thread; the interpreter lock is released, so that other work goes on beside them."""

from __future__ import annotations

import numba

compiled = numba.njit(nogil=True, error_model="numpy", fastmath={"nnan", "ninf", "nsz", "reassoc", "contract", "arcp"})
"""Decorator. Sums may be reordered, so that they use the processor's vectors; arguments must be finite. Compiled at the
first call (half a second) and not kept on disk: a cache there would be code that nobody checks before running it, and
loops that call others give other last digits when numba loads them than when it compiles them (0.68)."""
