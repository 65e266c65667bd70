"""Smooth random patterns in space."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

NOISE_PERIOD = 48
"""Nodes after which a pattern repeats: 24 wavelengths."""
DEVIATION = 0.41
"""Standard deviation of quadratic B-splines over unit normal nodes."""


def value_noise(places_mm: np.ndarray, wavelength_mm: float, rng: np.random.Generator) -> np.ndarray:
    """[..., 3] mm -> [...] smooth periodic noise of mean 0 and deviation about 1: B-splines over random nodes."""
    nodes = rng.normal(size=(NOISE_PERIOD,) * 3)
    nodes -= nodes.mean()
    coordinates = np.moveaxis(places_mm * (2.0 / wavelength_mm), -1, 0)
    values = map_coordinates(nodes, coordinates, order=2, mode="grid-wrap", prefilter=False)
    return values / DEVIATION
