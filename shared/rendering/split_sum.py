"""Narrow lobes on a coarse direction set: the visibility-modulated split sum, as weights on the directions.

    S = [F0 A(n.o, r) + B(n.o, r)] * V~ * L_prefiltered(reflection, r)

A lobe narrower than the spacing of the directions cannot be summed over them point by point. Its energy is known in
closed form, though (A and B), light prefiltered along the reflected direction is a mean over samples of the lobe, and
V~ is the mean of the visibility over directions sampled from D. Each factor is linear in the light or free of it, so
the product is again one weight per direction, and the caller need not know which way a lobe was made.

V~ is 1 for a point that nothing covers at any roughness, binary for a mirror, ambient occlusion when rough. The error
grows with roughness (visibility and light are averaged apart), that of sums over the directions falls with it.

Reference: [Karis2013] (split sum; prefiltering with n = o = r).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from shared.rendering.brdf import F0, MINIMUM_COSINE, microfacet_integrals
from shared.rendering.envmap import cube_directions, cube_texel

SAMPLES = 64
_TABLE_RESOLUTION, _NEIGHBOURS = 48, 3
_POINTS_PER_BLOCK = 256
_COSINES = (np.arange(64) + 0.5) / 64


def narrowest_roughness(spacing: float) -> float:
    """Roughness below which lobes slip between directions: alpha under 0.48 of their spacing, radians.

    768 directions: 0.25. The errors of the two ways cross there: earlier beside an occluder, later in the open.
    """
    return float((0.48 * spacing) ** 0.5)


def sample_half_vectors(roughness: float, count: int = SAMPLES) -> np.ndarray:
    """[count, 3] half vectors about +z distributed as D(h) n.h ([Walter2007], eq. 35), on a Fibonacci spiral."""
    u = (np.arange(count) + 0.5) / count
    cos = np.sqrt((1.0 - u) / (1.0 + (roughness**4 - 1.0) * u))
    azimuth = np.pi * (1.0 + 5.0**0.5) * np.arange(count)
    sin = np.sqrt(1.0 - cos * cos)
    return np.stack([sin * np.cos(azimuth), sin * np.sin(azimuth), cos], axis=1)


def frames_about(axis: np.ndarray) -> np.ndarray:
    """[P, 3] unit vectors -> [P, 3, 3]: rows are two tangents and the axis [Duff2017]."""
    x, y, z = axis.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([first, second, axis], axis=1)


def mirrored_about_axis(roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """A lobe along its own axis, +z ([Karis2013]: n = o = r): directions [M, 3] and their weights, the cosines [M]."""
    half = sample_half_vectors(roughness)
    local = 2.0 * half[:, 2:] * half - np.array([0.0, 0.0, 1.0])
    return local[local[:, 2] > 0], local[local[:, 2] > 0, 2]


class SplitSum:
    """Weights of narrow lobes on directions [J, 3]."""

    def __init__(self, directions: np.ndarray):
        self.directions = directions
        texels, size = cube_directions(_TABLE_RESOLUTION), np.linalg.norm(directions, axis=1)
        distance, nearest = cKDTree(directions / size[:, None]).query(texels, k=_NEIGHBOURS)
        share = np.maximum(1.2 * distance[:, -1:] - distance, 0.0) * size[nearest]
        self._nearest, self._share = nearest, share / share.sum(1, keepdims=True)
        self._integrals: dict[float, np.ndarray] = {}

    def _energy(self, cosine: np.ndarray, roughness: float) -> np.ndarray:
        """F0 A + B at cosines [P]."""
        if roughness not in self._integrals:
            _, scale, bias = microfacet_integrals(_COSINES, roughness)
            self._integrals[roughness] = F0 * scale + bias
        return np.interp(cosine, _COSINES, self._integrals[roughness])

    def prefilter(self, reflected: np.ndarray, roughness: float) -> np.ndarray:
        """[P, 3] reflected directions -> weights [P, J] that sum to 1: the lobe seen along its own axis."""
        local, cosine = mirrored_about_axis(roughness)
        world = local @ frames_about(reflected)
        texel = cube_texel(world.reshape(-1, 3), _TABLE_RESOLUTION)
        count, total = len(reflected), len(self.directions)
        weight = (cosine / cosine.sum())[:, None] * self._share[texel].reshape(count, len(local), _NEIGHBOURS)
        entry = np.arange(count)[:, None, None] * total + self._nearest[texel].reshape(weight.shape)
        return np.bincount(entry.ravel(), weight.ravel(), count * total).reshape(count, total)

    def visible_share(
        self, normals: np.ndarray, towards: np.ndarray, roughness: float, visible: np.ndarray
    ) -> np.ndarray:
        """V~ [P]: share of directions sampled from D about the normals [P, 3] that visible [P, J] leaves open.

        towards [P, 3]: to the camera. Directions below the horizon do not count.
        """
        half, share = sample_half_vectors(roughness), np.empty(len(normals))
        for start in range(0, len(normals), _POINTS_PER_BLOCK):
            part = slice(start, start + _POINTS_PER_BLOCK)
            share[part] = self._visible_share(half, normals[part], towards[part], visible[part])
        return share

    def _visible_share(
        self, half: np.ndarray, normals: np.ndarray, towards: np.ndarray, visible: np.ndarray
    ) -> np.ndarray:
        half = half @ frames_about(normals)
        o_dot_h = (half @ towards[..., None])[..., 0]
        incoming = 2.0 * o_dot_h[..., None] * half - towards[:, None]
        above = ((incoming @ normals[..., None])[..., 0] > 0) & (o_dot_h > 0)
        texel = cube_texel(incoming.reshape(-1, 3), _TABLE_RESOLUTION)
        nearest = self._nearest[texel, 0].reshape(above.shape)
        # A sample above the horizon may find its nearest direction below: nothing covers it there.
        open_ = np.take_along_axis(visible | (normals @ self.directions.T <= 0), nearest, axis=1)
        return (open_ & above).sum(1) / np.maximum(above.sum(1), 1)

    def kernel(
        self, normals: np.ndarray, towards: np.ndarray, roughness: float, visible: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weights [P, J] float32 of all directions and of the open ones; normals, towards [P, 3], visible [P, J]."""
        n, o = normals.astype(np.float64), towards.astype(np.float64)
        cosine = (n * o).sum(1)
        reflected = 2.0 * cosine[:, None] * n - o
        every = self.prefilter(reflected, roughness)
        every *= (self._energy(np.maximum(cosine, MINIMUM_COSINE), roughness) * (cosine > 0))[:, None]
        share = self.visible_share(n, o, roughness, visible)
        return every.astype(np.float32), (every * share[:, None]).astype(np.float32)
