"""Robust statistics: what outliers do not move."""

from __future__ import annotations

import numpy as np

ROBUST_SCALE = 1.4826
"""Standard deviation over median absolute deviation of normally distributed values (1 / 0.6745)."""


def cauchy_weight(error: np.ndarray, scale: float | np.ndarray, weight: float | np.ndarray = 1.0) -> np.ndarray:
    """[...] weights that an error has under a Cauchy loss: weight / (1 + (error / scale)^2).

    error [...]: signed, or lengths. scale: in the error's unit; the weight halves there, and beyond it falls as the
    square of the error. weight: what the error counts by itself, 0 where it is left out. scale and weight are numbers
    or arrays that broadcast against the error. The minimum of the loss scale^2 / 2 log(1 + (error / scale)^2) is that
    of the squares weighted so, anew in each step ([Triggs2000], section 3.3).
    """
    return weight / (1.0 + (error / scale) ** 2)
