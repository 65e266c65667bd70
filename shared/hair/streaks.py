"""Streaks where no frame looks: what is seen beside, mirrored at its border.

The albedo that no frame shows is smooth, and would look like cloth. Of what is seen the part finer than that goes on
beyond the border as in a mirror, again and again: strands keep their direction, strength and colour.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

SMOOTH = 1.0 / 40.0
"""Standard deviation, share of the map's edge, of what counts as smooth."""
BORDER = 1.0 / 100.0
"""Share of the map's edge from the border of what is seen that is not trusted: there hair turns away."""
REFLECTIONS = 6
DARKEST = 1e-3


def with_streaks(albedo: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """albedo [S, S, 3] of a map whose left and right border are one, seen [S, S] bool by frames -> float32 [S, S, 3],
    with streaks where it is not seen. Nothing changes where nothing is seen, or everything."""
    size = len(albedo)
    reach = max(1, round(BORDER * size))
    trusted = cv2.erode(np.pad(seen, ((0, 0), (size, size)), mode="wrap").astype(np.uint8),
                        np.ones((2 * reach + 1,) * 2, np.uint8))[:, size:-size].astype(bool)
    if not trusted.any() or seen.all():
        return albedo.astype(np.float32)
    logs = np.log(np.maximum(albedo, DARKEST)).astype(np.float32)
    weight = trusted[..., None].astype(np.float32)
    fine = (logs - _blurred(logs * weight, size) / np.maximum(_blurred(weight, size), 1e-3)) * weight
    wide = np.pad(~trusted, ((0, 0), (size, size)), mode="wrap")
    rows, columns = distance_transform_edt(wide, return_distances=False, return_indices=True)
    rows, columns = rows[:, size:-size], columns[:, size:-size] - size
    row, column = np.indices(trusted.shape)
    for _ in range(REFLECTIONS):
        at = np.clip(row, 0, size - 1), column % size
        out = ~trusted[at]
        nearest = rows[at], columns[at] + (column - at[1])
        row, column = np.where(out, 2 * nearest[0] - at[0], row), np.where(out, 2 * nearest[1] - column, column)
    mirrored = fine[np.clip(row, 0, size - 1), column % size]
    added = np.where(seen[..., None], 0.0, mirrored)
    return np.exp(logs + added).astype(np.float32)


def _blurred(image: np.ndarray, size: int) -> np.ndarray:
    """[S, S, C] -> the same, smooth across the left and right border, too."""
    wide = np.pad(image, ((0, 0), (size, size), (0, 0)), mode="wrap")
    return cv2.GaussianBlur(wide, (0, 0), SMOOTH * size).reshape(wide.shape)[:, size:-size]
