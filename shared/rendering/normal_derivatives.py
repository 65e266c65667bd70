"""Modelled radiance of surface points and how it changes when their normals turn.

The direct irradiance over pi is n . W with the vector W = 4 / J sum_j V L_j w_j over the visible directions, so its
derivative by the normal is W itself (with visibility held). Light that bounced is taken as it is: it comes from all
sides. Reflections are differenced at anchors some millimetres apart and carried to the points between by the normal:

    S_p = sum_a w_pa (S_a + G_a . (n_p - n_a))

Reference: [Arvo1994] (the irradiance vector).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from shared.compute.threads import share_out
from shared.geometry.mesh import normalised, tangent_frames
from shared.rendering.shading import VertexShading
from shared.rendering.transfer import Points, Transfer, position_and_normal, spread_vertices

NORMAL_STEP = 0.06
"""Radians between the normals whose reflections are differenced: half the spacing of 768 directions."""
ANCHORS = 3000
NEIGHBOURS, CLOSEST_MM = 4, 0.5
_POINTS_PER_BLOCK = 512


@dataclass(frozen=True)
class ShadingTerms:
    """P points, F frames: irradiance E over pi and reflection S at specular_intensity 1, [P, F, 3] each, and their
    derivatives irradiance_turn and reflection_turn [P, F, 3, 2] by a turn of the normal towards tangents [P, 2, 3];
    shadow_slope [P, F, 3]: change of E per mm along the surface that the normal does not explain."""

    tangents: np.ndarray
    irradiance: np.ndarray
    reflection: np.ndarray
    irradiance_turn: np.ndarray
    reflection_turn: np.ndarray
    shadow_slope: np.ndarray

    def points(self, index: slice) -> ShadingTerms:
        """The terms of some points."""
        arrays = (self.tangents, self.irradiance, self.reflection, self.irradiance_turn, self.reflection_turn)
        return ShadingTerms(*(array[index] for array in arrays), self.shadow_slope[index])


def irradiance_vectors(transfer: Transfer, rows: np.ndarray, directions: np.ndarray, light: np.ndarray) -> np.ndarray:
    """W [n, F, 3 channels, 3] float32 of some of the transfer's points, rows [n] int; directions [J, 3], light along
    them [J, F, 3]."""
    spread = np.float32(4.0 / len(directions)) * directions.astype(np.float32)
    moments = (light[..., None] * spread[:, None, None]).reshape(len(light), -1)
    result = np.empty((len(rows), moments.shape[1]), np.float32)

    def fill(k: int) -> None:
        part = slice(k * _POINTS_PER_BLOCK, (k + 1) * _POINTS_PER_BLOCK)
        np.matmul(transfer.visibility(rows[part]).astype(np.float32), moments, out=result[part])

    share_out(-(-len(rows) // _POINTS_PER_BLOCK), fill)
    return result.reshape(len(rows), light.shape[1], 3, 3)


class Reflections:
    """S and its derivative by the normal, at rows [P] of the shading's points.

    What is summed at the anchors is kept: after small moves the points' new normals are carried from the same anchors.
    """

    def __init__(self, shading: VertexShading, rows: np.ndarray):
        self.shading, points = shading, shading.points
        self.anchors = rows[spread_vertices(points.positions[rows], ANCHORS)]
        self.normals = points.normals[self.anchors]
        self.tangents = tangent_frames(self.normals)
        table = shading.table.take(self.anchors)
        turned = [table.turned(normalised(self.normals + NORMAL_STEP * self.tangents[:, k])) for k in range(2)]
        self.tables = [table, *turned]
        near = cKDTree(position_and_normal(points.take(self.anchors)))
        distance, which = near.query(position_and_normal(points.take(rows)), k=min(4, len(self.anchors)))
        weight = 1.0 / (distance + 0.3) ** 2
        weight /= weight.sum(1, keepdims=True)
        entries = np.repeat(np.arange(len(rows)), which.shape[1]), which.ravel()
        self._known: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.carry = sparse.csr_matrix((weight.ravel(), entries), (len(rows), len(self.anchors)))

    def at(
        self, frame: int, normals: np.ndarray, rows: slice | np.ndarray = slice(None)
    ) -> tuple[np.ndarray, np.ndarray]:
        """S [n, 3] of some of the P points with normals [n, 3] and its derivative by them [n, 3 channels, 3]."""
        if frame not in self._known:
            self._known[frame] = self._at_anchors(frame)
        value, slope = self._known[frame]
        level = value - np.einsum("acx,ax->ac", slope, self.normals)
        both = self.carry[rows] @ np.concatenate([level, slope.reshape(-1, 9)], axis=1)
        slope = both[:, 3:].reshape(-1, 3, 3)
        return np.maximum(both[:, :3] + (slope @ normals[..., None])[..., 0], 0.0), slope

    def _at_anchors(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        shading = self.shading
        towards, blocked = shading.towards_camera(frame)[self.anchors], shading.blocked_light(frame)[self.anchors]
        facing = np.nonzero((towards * self.normals).sum(1) > -0.1)[0]
        values = [
            shading.reflection_by(table.take(facing), self.anchors[facing], towards[facing], frame, blocked[facing])
            for table in self.tables
        ]
        value, slope = np.zeros((len(self.anchors), 3)), np.zeros((len(self.anchors), 3, 3))
        value[facing] = values[0]
        for k in range(2):
            change = (values[1 + k] - values[0]) / NORMAL_STEP
            slope[facing] += change[:, :, None] * self.tangents[facing, k][:, None]
        return value, slope


def shading_terms(shading: VertexShading, rows: np.ndarray, reflections: Reflections | None) -> ShadingTerms:
    """Terms of the shading's points rows [P] in all its frames; reflections: of all its points, None: there are none.
    """
    normals = shading.points.normals[rows]
    tangents = tangent_frames(normals).astype(np.float32)
    along = irradiance_vectors(shading.transfer, rows, shading.directions, shading.far_along)
    along += shading.lamp_vectors(rows)
    shape = (len(rows), shading.far_along.shape[1], 3)
    turn = (along.reshape(len(rows), -1, 3) @ tangents.transpose(0, 2, 1)).reshape(shape + (2,))
    shadow = shadow_slope(shading.points.take(rows), along)
    reflection, reflection_turn = np.zeros(shape, np.float32), np.zeros(shape + (2,), np.float32)

    def reflect(f: int) -> None:
        reflection[:, f], slope = reflections.at(f, normals, rows)
        reflection_turn[:, f] = slope @ tangents.transpose(0, 2, 1)

    if reflections is not None:
        share_out(shape[1], reflect)
    return ShadingTerms(tangents, shading.irradiance_of_points(rows), reflection, turn, reflection_turn, shadow)


def shadow_slope(points: Points, vectors: np.ndarray) -> np.ndarray:
    """[P, F, 3]: rms change of n . W per mm towards the nearest points, n held: where the borders of cast shadows lie.

    vectors [P, F, 3 channels, 3]: W. Where a border lies is known no better than visibility and shape are.
    """
    distance, near = cKDTree(points.positions).query(points.positions, k=min(1 + NEIGHBOURS, len(points)))
    result = np.zeros(vectors.shape[:3], np.float32)
    blocks = [slice(first, first + _POINTS_PER_BLOCK) for first in range(0, len(result), _POINTS_PER_BLOCK)]

    def fill(block: int) -> None:
        part = blocks[block]
        for k in range(1, near.shape[1]):
            other = near[part, k]
            between = normalised(points.normals[part] + points.normals[other]).astype(np.float32)
            between /= np.maximum(distance[part, k], CLOSEST_MM)[:, None].astype(np.float32)
            change = (vectors[other] - vectors[part]).reshape(len(other), -1, 3) @ between[..., None]
            result[part] += np.square(change).reshape(result[part].shape)

    share_out(len(blocks), fill)
    return np.sqrt(result / NEIGHBOURS)

