"""Streaks where no frame looks: drawn, as strong and as fine as those that frames show, down the rows of hair's map.

The albedo that no frame shows is smooth, and would look like cloth. What is seen was tried in its place, mirrored at
its border: it is recognised, and its ragged border draws blocks.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

SMOOTH = 1.0 / 60.0
"""Standard deviation, share of the map's edge, of what counts as smooth."""
BORDER = 1.0 / 100.0
"""Share of the map's edge from the border of what is seen that is not trusted: there hair turns away."""
LENGTH = 1.0 / 12.0
"""Of a streak: standard deviation, share of the map's edge."""
FINEST, COARSEST = 0.7, 8.0
"""Standard deviation of its width, texels."""
SEED, DARKEST = 20, 1e-3


def with_streaks(albedo: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """albedo [S, S, 3], at most 1, of a map whose left and right border are one, seen [S, S] bool by frames -> float32
    [S, S, 3], with streaks where it is not seen. Nothing changes where nothing is seen, or everything."""
    size = len(albedo)
    reach = max(1, round(BORDER * size))
    wide = np.pad(seen, ((0, 0), (size, size)), mode="wrap").astype(np.uint8)
    trusted = cv2.erode(wide, np.ones((2 * reach + 1,) * 2, np.uint8))[:, size:-size].astype(bool)
    if not trusted.any() or seen.all():
        return albedo.astype(np.float32)
    logs = np.log(np.maximum(albedo, DARKEST)).mean(-1)
    weight = trusted.astype(np.float64)
    fine = logs - _blurred(logs * weight, SMOOTH * size) / np.maximum(_blurred(weight, SMOOTH * size), 1e-3)
    pairs = trusted & np.roll(trusted, -1, axis=1)
    power, steps = np.mean(fine[trusted] ** 2), np.mean((np.roll(fine, -1, axis=1) - fine)[pairs] ** 2)
    # A field smoothed over s texels differs from one to the next by 2 (1 - exp(-1 / 4 s^2)) of its variance.
    alike = np.clip(1.0 - 0.5 * steps / max(power, 1e-12), 1e-3, 1.0 - 1e-3)
    width = float(np.clip(np.sqrt(-0.25 / np.log(alike)), FINEST, COARSEST))
    drawn = gaussian_filter(np.random.default_rng(SEED).normal(size=seen.shape), (LENGTH * size, width),
                            mode=("nearest", "wrap"))
    drawn *= np.sqrt(power) / drawn.std()
    unseen = np.clip(1.0 - _blurred(seen.astype(np.float64), reach), 0.0, 1.0) * ~seen
    return np.minimum(albedo * np.exp(unseen * drawn)[..., None], 1.0).astype(np.float32)


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """[S, S] by a standard deviation in texels, across the left and right border, too."""
    return gaussian_filter(image, sigma, mode=("nearest", "wrap"))
