"""Grain where no frame looks: noise as strong and as fine as what frames show of surface of the same kind.

What is filled in is smooth, and beside what is seen it looks like wax. Octave by octave, grain has the spread that log
albedo has among the texels that are known, with the colour that their differences have; it is drawn in space, so that
it goes on across the seams of the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from shared.appearance.texture import LEAST_ALBEDO, TexelMaterial, known_share
from shared.compute.robust import ROBUST_SCALE
from shared.imaging.texels import TexelSurface
from shared.imaging.value_noise import octave_noise

KNOWN = 0.9
"""How far a texel is known from which on it is learnt from."""
FEWEST = 2000
"""Texels to learn from; of fewer, nothing is learnt."""
FINEST_TEXELS, COARSEST_MM = 3.0, 6.0
"""Wavelengths: of the first octave, and the longest; slower changes are the fill's."""
OVERLAP = 0.77
"""Levels of the pyramid overlap, so that their variances sum up to some such share of a pattern's: 0.84 of one of
the first octave, 0.7 of others."""
ALONE = 0.95
"""Of a texel of a coarser octave: how much of it must be known."""
SEED = 7


@dataclass(frozen=True)
class Grain:
    """Of one octave: its wavelength in mm, and the standard deviation of the log albedo [3]."""

    wavelength_mm: float
    deviation: np.ndarray


def with_grain(
    surface: TexelSurface, material: TexelMaterial, kinds: Sequence[tuple[np.ndarray, np.ndarray]]
) -> TexelMaterial:
    """The material with grain where samples tell nothing. kinds: for each kind of surface, the texels to learn from [T]
    bool, and how much of it each texel is [T] in 0 .. 1. What is learnt from too few texels has none."""
    logs = np.log(np.maximum(material.albedo, LEAST_ALBEDO))
    known = known_share(material.information)
    grain = np.zeros_like(logs)
    for number, (learnt, share) in enumerate(kinds):
        trusted, rows = learnt & (known > KNOWN), np.nonzero(share * (1.0 - known) > 0.0)[0]
        if np.count_nonzero(trusted) < FEWEST or not len(rows):
            continue
        rng = np.random.default_rng([SEED, number])
        places = surface.interpolate(surface.mesh.vertices, rows)
        for octave in octaves(surface, logs, trusted):
            drawn = octave_noise(places, octave.wavelength_mm, rng)
            grain[rows] += (share[rows] * (1.0 - known[rows]) * drawn)[:, None] * octave.deviation
    albedo = np.clip(material.albedo * np.exp(grain), LEAST_ALBEDO, 1.0)
    return replace(material, albedo=albedo.astype(np.float32))


def octaves(surface: TexelSurface, logs: np.ndarray, trusted: np.ndarray) -> list[Grain]:
    """What the log albedo, logs [T, 3], has of grain among the trusted texels [T] bool, from the finest octave on: the
    levels of a Laplacian pyramid ([Burt1983]) of them alone."""
    weight = trusted.astype(np.float32)
    level = surface.to_image(np.concatenate([logs * weight[:, None], weight[:, None]], axis=1).astype(np.float32))
    found, wavelength = [], FINEST_TEXELS * surface.typical_texel_mm()
    while wavelength <= COARSEST_MM and min(level.shape[:2]) >= 8:
        coarser = cv2.pyrDown(level)
        up = cv2.pyrUp(coarser, dstsize=level.shape[1::-1])
        whole = (level[..., 3] > ALONE) & (up[..., 3] > ALONE)
        if np.count_nonzero(whole) < FEWEST // 4 ** len(found):
            break
        band = level[whole][:, :3] / level[whole][:, 3:] - up[whole][:, :3] / up[whole][:, 3:]
        found.append(Grain(wavelength, _deviation(band)))
        level, wavelength = coarser, 2.0 * wavelength
    return found


def _deviation(band: np.ndarray) -> np.ndarray:
    """[3] of differences of the log albedo [n, 3]: their mean's, which outliers do not move, in the colour that goes
    with it."""
    mean = band.mean(1)
    slopes = (band * mean[:, None]).sum(0) / max(float((mean**2).sum()), 1e-12)
    return ROBUST_SCALE * np.median(np.abs(mean)) / np.sqrt(OVERLAP) * slopes
