"""How far a texel's albedo may be believed, as one number from 0 to 1.

    confidence = p^2 / (p^2 + v + (SURE d)^2)

p: PRIOR_SPREAD, the log albedo's spread if all one knew were the person's mean. v: its variance by what the frames say,
1 / information, which counts light, normals, shadows, borders and contradictions generously: errors of skin are two or
three times smaller. d: standard deviation by what the frames cannot say, however well they agree, since the model has
no such thing: detail finer than the pictures, highlights of hair, shadows of hair on the head. By itself it makes the
confidence 0.5 where an error of p, dE2000 of 6 to 8 by the colour, lies SURE deviations away: few texels above 0.5 are
off by more.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from shared.appearance.texture import LEAST_ALBEDO, PRIOR_SPREAD, TexelMaterial
from shared.imaging.texels import TexelSurface

SURE = 2.33
"""Deviations beyond which 2 % of a normal variable lie."""

BLURRED_TWICE = 2.0
"""Standard deviation of what pictures blur away of a texture, over that of what the same blur takes of it the second
time. Measured on two heads: 1.4 to 1.8 on hair and scalp, 2 to 3 at brows, lids, lips and on skin. 4 if texture were
alike at all scales, down to the texel."""


def texel_confidence(surface: TexelSurface, material: TexelMaterial, resolved: float) -> np.ndarray:
    """[T] confidence; resolved: standard width in texels of what the pictures resolve, 0: everything."""
    told = 1.0 / np.maximum(material.information, 1e-9)
    beyond = unresolved_variance(surface, material.albedo, resolved)
    if material.unmodelled is not None:
        beyond = beyond + material.unmodelled
    return PRIOR_SPREAD**2 / (PRIOR_SPREAD**2 + told + SURE**2 * beyond)


def unresolved_variance(surface: TexelSurface, albedo: np.ndarray, resolved: float) -> np.ndarray:
    """[T] of the log albedo [T, 3], mean of the channels, by detail that the pictures do not resolve: they have blurred
    it once, so what the same blur would take of it now tells what it took; resolved as of texel_confidence."""
    known = _blurred(surface, np.ones(len(surface), np.float32), resolved)
    squared = np.zeros(len(surface), np.float32)
    for channel in np.log(np.maximum(albedo, LEAST_ALBEDO)).astype(np.float32).T:
        squared += np.square(channel - _blurred(surface, channel, resolved) / known) / 3.0
    return BLURRED_TWICE**2 * _blurred(surface, squared, resolved) / known


def _blurred(surface: TexelSurface, values: np.ndarray, width: float) -> np.ndarray:
    """[T] values after a Gaussian of width texels over the map, nothing beside the texels."""
    return gaussian_filter(surface.to_image(values), width, mode="constant").ravel()[surface.pixel]
