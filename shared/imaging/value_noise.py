"""Smooth random patterns in space, which know no seams of a map."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

NOISE_PERIOD = 48
"""Nodes after which a pattern repeats: 24 wavelengths."""
DEVIATION, OCTAVE_DEVIATION = 0.41, 0.337
"""Standard deviation of quadratic B-splines over unit normal nodes, and over such without their slow changes."""


def value_noise(places_mm: np.ndarray, wavelength_mm: float, rng: np.random.Generator) -> np.ndarray:
    """[..., 3] mm -> [...] smooth periodic noise of mean 0 and deviation about 1: B-splines over random nodes. It has
    all wavelengths from this one on."""
    nodes = rng.normal(size=(NOISE_PERIOD,) * 3)
    return _splines(nodes - nodes.mean(), places_mm, wavelength_mm) / DEVIATION


def octave_noise(places_mm: np.ndarray, wavelength_mm: float, rng: np.random.Generator) -> np.ndarray:
    """[..., 3] mm -> [...] the same without most of what is more than an octave slower."""
    nodes = rng.normal(size=(NOISE_PERIOD,) * 3)
    return _splines(nodes - gaussian_filter(nodes, 1.0, mode="wrap"), places_mm, wavelength_mm) / OCTAVE_DEVIATION


def _splines(nodes: np.ndarray, places_mm: np.ndarray, wavelength_mm: float) -> np.ndarray:
    coordinates = np.moveaxis(places_mm * (2.0 / wavelength_mm), -1, 0)
    return map_coordinates(nodes, coordinates, order=2, mode="grid-wrap", prefilter=False)
