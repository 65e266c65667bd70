"""The same pictures by brute force: one random path after another, nothing precomputed, nothing shared.

It exists to check the fast renderer: both integrate the same paths (eye, surface, light; eye, surface, surface
reflecting diffusely, light), so they agree up to noise.
"""

from __future__ import annotations

import numpy as np

from shared.rendering import brdf
from tools.synthesis.light import EnvironmentLight
from tools.synthesis.sampling import tangent_frame
from tools.synthesis.surface import ShadingPoints, SyntheticSurface


def reference_radiance(surface: SyntheticSurface, light: EnvironmentLight, world_from_head: np.ndarray,
                       points: ShadingPoints,
                       outgoing: np.ndarray, specular: np.ndarray, roughness: np.ndarray, paths: int,
                       seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean [N, 3] and standard error [N, 3] of the radiance that surface points send towards `outgoing` [N, 3].

    specular, roughness [N]. First directions are drawn uniformly over the hemisphere of half of the paths and by the
    cosine for the other half, weighted by the balance heuristic.
    """
    rng = np.random.default_rng(seed)
    total, squares = (np.zeros((len(outgoing), 3)) for _ in range(2))
    albedo = surface.albedo(points.uv)
    for _ in range(paths):
        directions, density = _first_directions(points.normal, rng)
        cosine = (directions * points.normal).sum(1)
        between = (outgoing * directions).sum(1)
        lobe = brdf.specular_cosine((outgoing * points.normal).sum(1), cosine, between, roughness)
        reflectance = albedo * (np.maximum(cosine, 0) / np.pi)[:, None] + (specular * lobe)[:, None]
        above = (directions * points.geometric_normal).sum(1) > 0
        incident = _incident(surface, light, world_from_head, points.origins, directions, rng) * above[:, None]
        value = reflectance * incident / density[:, None]
        total += value
        squares += value * value
    mean = total / paths
    return mean, np.sqrt(np.maximum(squares / paths - mean * mean, 0) / paths)


def _first_directions(normal: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """[N, 3] directions above the shading normal and their density [N]: half cosine, half uniform."""
    square = rng.random((len(normal), 2))
    cosine_weighted = _cosine_direction(square)
    height = square[:, 0]
    ring = np.sqrt(1 - height * height)
    phi = 2 * np.pi * square[:, 1]
    uniform = np.stack([ring * np.cos(phi), ring * np.sin(phi), height], 1)
    local = np.where(rng.random((len(normal), 1)) < 0.5, cosine_weighted, uniform)
    density = 0.5 * local[:, 2] / np.pi + 0.25 / np.pi
    return _from_frame(local, normal), density


def _from_frame(local: np.ndarray, normal: np.ndarray) -> np.ndarray:
    first, second = tangent_frame(normal)
    return first * local[:, :1] + second * local[:, 1:2] + normal * local[:, 2:]


def _incident(surface: SyntheticSurface, light: EnvironmentLight, world_from_head: np.ndarray, origins: np.ndarray,
              directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[N, 3] radiance along rays: the light, or one diffuse reflection of it at whatever the ray meets."""
    face, bary, _ = surface.scene.intersect(origins, directions)
    radiance = light.radiance(directions @ world_from_head.T)
    radiance[face >= 0] = 0.0
    met = np.nonzero(face >= 0)[0]
    second = surface.points(face[met], bary[met])
    outer = (second.geometric_normal * directions[met]).sum(1) < 0
    met, second = met[outer], second.select(outer)
    onwards = _from_frame(_cosine_direction(rng.random((len(met), 2))), second.normal)
    above = (onwards * second.geometric_normal).sum(1) > 0
    free = above & ~surface.scene.occluded(second.origins, onwards)
    radiance[met] = surface.albedo(second.uv) * light.radiance(onwards @ world_from_head.T) * free[:, None]
    return radiance


def _cosine_direction(points: np.ndarray) -> np.ndarray:
    """Points [N, 2] of the unit square -> directions [N, 3] about +z with density cos / pi."""
    radius, phi = np.sqrt(points[..., 0]), 2 * np.pi * points[..., 1]
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1.0 - points[..., 0])], -1)
