"""A step without corners."""

from __future__ import annotations

import numpy as np


def smooth_step(values: np.ndarray) -> np.ndarray:
    """[...] 0 up to 0, 1 from 1 on, and between them the cubic that is level at both ends; values [...]."""
    share = np.clip(values, 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)
