"""Irradiance on living eyes, traced at every point that a picture shows: lids shade them more finely than the texels of
the atlas are, and move."""

from __future__ import annotations

import numpy as np

from shared.imaging.texture import sample_bilinear
from tools.synthesis.highlights import SAMPLE_SETS, LobeSamples
from tools.synthesis.irradiance import SyntheticShot
from tools.synthesis.light import EnvironmentLight
from tools.synthesis.sampling import cosine_directions, shifted_hammersley
from tools.synthesis.surface import ShadingPoints, SyntheticSurface

DIRECTIONS, LAMP_SAMPLES = 64, 16
"""Of each primary ray."""


def eye_irradiance(surface: SyntheticSurface, light: EnvironmentLight, irradiance: np.ndarray, shot: SyntheticShot,
                   points: ShadingPoints, rng: np.random.Generator) -> np.ndarray:
    """[N, 3] at N points; irradiance [size, size, 3] of the shot is what the head itself sends there over a bounce."""
    choice = rng.integers(SAMPLE_SETS, size=len(points.position))
    squares = shifted_hammersley(DIRECTIONS, SAMPLE_SETS, rng)[choice]
    directions = cosine_directions(points.normal, squares).astype(np.float32)
    row, column = np.nonzero(np.einsum("nkc,nc->nk", directions, points.geometric_normal) > 0)
    towards = directions[row, column]
    index, uv, free = surface.hits(points.origins[row], towards)
    incident = np.zeros_like(towards)
    incident[free] = light.smooth_radiance(towards[free] @ shot.world_from_head.T.astype(np.float32))
    incident[index] = surface.albedo(uv) * sample_bilinear(irradiance, uv) / np.float32(np.pi)
    smooth = np.zeros(directions.shape, np.float32)
    smooth[row, column] = incident
    return np.float32(np.pi) * smooth.mean(1) + _lamps(surface, light, shot, points, choice, rng)


def _lamps(surface: SyntheticSurface, light: EnvironmentLight, shot: SyntheticShot, points: ShadingPoints,
           choice: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[N, 3] what arrives from the lamps."""
    lamps_at = None if light.lamps_at is None else shot.in_head_space(light.lamps_at)
    samples = LobeSamples.draw(light, shot.world_from_head, 1, LAMP_SAMPLES, rng, lamps_at)
    towards, weights = samples.of_lamps(points.position, choice)
    cosine = np.maximum(np.einsum("nkc,nc->nk", towards, points.normal), 0.0)
    above = np.einsum("nkc,nc->nk", towards, points.geometric_normal) > 0
    row, column = np.nonzero(above & (cosine > 0) & (weights.sum(-1) > 0))
    free = ~surface.scene.occluded(points.origins[row], towards[row, column])
    lit = np.zeros_like(cosine)
    lit[row[free], column[free]] = cosine[row[free], column[free]]
    return np.einsum("nk,nkc->nc", lit, weights) / LAMP_SAMPLES
