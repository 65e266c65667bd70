"""Specular reflection as lobe sums on the direction set: exact for wide lobes, up to the grid of directions.

    S[v, f] = sum_j V[v, j] f_GGX(n_v, o_vf, w_j) cos_i dw L_f[j]

at specular_intensity 1, with the same visibility and light as the diffuse transfer. The set resolves lobes that are
wider than its spacing (sqrt(4 pi / J)): with 768 directions roughness 0.25 and up; skin lies above. Narrower lobes
(wet lips, oil, eyes) get their weights from the split sum. Where the head itself blocks the lobe, the blocked weight
is returned too, so that the caller can fill in light that bounced.

A weight takes some forty operations on numbers that are not needed again, so the loops are compiled and a point's
weights never leave the cache (15 times as fast as array operations, on one core).
"""

from __future__ import annotations

from copy import copy

import numpy as np

from shared.compute.compiled import compiled, compiled_part
from shared.rendering.brdf import F0, MINIMUM_COSINE
from shared.rendering.direction_set import widest_spacing
from shared.rendering.split_sum import SplitSum, narrowest_roughness

_POINTS_PER_BLOCK = 512


class SpecularTransfer:
    """What the lobes of P points share over all views: J directions, also as the loops want them, and visibility.

    normals [P, 3], visible [P, J] bool (as Transfer.visibility), directions [J, 3]: a direction_set.
    """

    def __init__(self, normals: np.ndarray, visible: np.ndarray, directions: np.ndarray):
        self.normals = np.ascontiguousarray(normals, np.float32)
        self.directions = directions
        size = np.linalg.norm(directions, axis=1)
        self.rows = np.ascontiguousarray(np.c_[directions / size[:, None], size].T, np.float32)
        self.visible = np.ascontiguousarray(visible)
        self.narrowest = narrowest_roughness(widest_spacing(directions))
        self._split_sum: SplitSum | None = None

    def take(self, index: np.ndarray) -> SpecularTransfer:
        """The table of the points index [n] int."""
        part = copy(self)
        part.normals, part.visible = self.normals[index], self.visible[index]
        return part

    def turned(self, normals: np.ndarray) -> SpecularTransfer:
        """The same points with other normals [P, 3]; what they see stays."""
        other = copy(self)
        other.normals = np.ascontiguousarray(normals, np.float32)
        return other

    def __len__(self) -> int:
        return len(self.normals)

    def resolves(self, roughness: float | np.ndarray) -> bool:
        """Are lobes this wide summed over the directions? Those that slip between them go through split_sum."""
        return np.ndim(roughness) > 0 or roughness >= self.narrowest

    def split_sum(self, part: slice, towards: np.ndarray, roughness: float) -> tuple[np.ndarray, np.ndarray]:
        """Weights of narrow lobes: all directions [p, J], and the open share [p, J]. towards [p, 3] unit."""
        if self._split_sum is None:
            self._split_sum = SplitSum(self.directions)
        return self._split_sum.kernel(self.normals[part], towards, float(roughness), self.visible[part])

    def alpha2(self, roughness: float | np.ndarray) -> np.ndarray:
        """GGX alpha^2 [P]."""
        return np.broadcast_to(np.asarray(roughness, np.float32) ** 4, len(self)).astype(np.float32)


def specular_reflection(
    table: SpecularTransfer,
    towards: np.ndarray,
    roughness: float | np.ndarray,
    light: np.ndarray,
    blocked_light: np.ndarray | None = None,
) -> np.ndarray:
    """Specular radiance of P points from one camera at specular_intensity 1.

    towards [P, 3] unit vectors to the camera; roughness: one, or each point's [P], then not below table.narrowest;
    light [J, C] along the directions; blocked_light [P, C]: mean radiance of what the head itself puts in the way (0
    when None) -> [P, C] float32.
    """
    towards, light = np.ascontiguousarray(towards, np.float32), np.ascontiguousarray(light, np.float32)
    result, blocked = np.zeros((len(table), light.shape[1]), np.float32), np.zeros(len(table), np.float32)
    if table.resolves(roughness):
        channels = np.ascontiguousarray(light.T)
        _sum_lobes(
            table.normals, towards, table.alpha2(roughness), table.rows, table.visible, channels, result, blocked
        )
    else:
        for part in blocks_of(table):
            every, seen = table.split_sum(part, towards[part], roughness)
            result[part], blocked[part] = seen @ light, every.sum(1) - seen.sum(1)
    return result if blocked_light is None else result + blocked[:, None] * blocked_light


def blocks_of(table: SpecularTransfer) -> list[slice]:
    """Parts of the points whose weights fit into memory."""
    return [slice(start, start + _POINTS_PER_BLOCK) for start in range(0, len(table), _POINTS_PER_BLOCK)]


@compiled_part
def weigh_directions(normal, towards, alpha2, directions, weights):
    """One point's lobe on all directions -> weights [J]: brdf.specular_cosine times the solid angle. directions [4, J]:
    unit vectors and their relative solid angles.

    D's alpha^2 / pi, both masking terms' factor 2, the denominator's 4 cos_o and the solid angle's 4 pi / J make up the
    common factor, with the masking of the outgoing direction.
    """
    one, half, least = np.float32(1.0), np.float32(0.5), np.float32(1e-6)
    nx, ny, nz, ox, oy, oz = normal[0], normal[1], normal[2], towards[0], towards[1], towards[2]
    cos_o = max(nx * ox + ny * oy + nz * oz, np.float32(MINIMUM_COSINE))
    root = np.sqrt(alpha2 + (one - alpha2) * cos_o * cos_o) + cos_o
    factor = np.float32(4.0) * alpha2 / (root * np.float32(len(weights)))
    for j in range(len(weights)):
        x, y, z = directions[0, j], directions[1, j], directions[2, j]
        n_dot_i = nx * x + ny * y + nz * z
        length2 = max(np.float32(2.0) * (one + ox * x + oy * y + oz * z), least)
        n_dot_h2 = min((n_dot_i + cos_o) * (n_dot_i + cos_o) / length2, one)
        base = n_dot_h2 * (alpha2 - one) + one
        away = max(one - half * np.sqrt(length2), np.float32(0.0))
        fresnel = np.float32(F0) + np.float32(1.0 - F0) * away * away * away * away * away
        cos_i = max(n_dot_i, np.float32(0.0))
        masking = np.sqrt(cos_i * cos_i * (one - alpha2) + alpha2) + cos_i
        weights[j] = directions[3, j] * (factor * fresnel * cos_i / (masking * base * base))


@compiled_part
def cover_lobe(weights, visible):
    """Clears the weights [J] of directions that are not visible [J] and returns their sum."""
    every, seen = np.float32(0.0), np.float32(0.0)
    for j in range(len(weights)):
        every += weights[j]
        weights[j] *= visible[j]
        seen += weights[j]
    return every - seen


@compiled
def _sum_lobes(normals, towards, alpha2, directions, visible, light, result, blocked):
    """light [C, J] -> result [P, C] over the open directions, blocked [P]: the weight of the others."""
    count = directions.shape[1]
    weights = np.empty(count, np.float32)
    for p in range(len(normals)):
        weigh_directions(normals[p], towards[p], alpha2[p], directions, weights)
        blocked[p] = cover_lobe(weights, visible[p])
        for c in range(len(light)):
            total = np.float32(0.0)
            for j in range(count):
                total += weights[j] * light[c, j]
            result[p, c] = total
