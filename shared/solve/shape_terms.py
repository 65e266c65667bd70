"""Modelled radiance of surface points and how it changes when their normals turn.

The direct irradiance over pi is n . W with the vector W = 4 / J sum_j V L_j w_j over the visible directions, so its
derivative by the normal is W itself (with visibility held). Light that bounced is taken as it is: it comes from all
sides. Reflections are differenced at anchors some millimetres apart and carried to the points between by the normal:

    S_p = sum_a w_pa (S_a + G_a . (n_p - n_a))

Reference: the irradiance vector, Arvo, The irradiance Jacobian for partially occluded polyhedral sources, 1994.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.spatial import cKDTree

from shared.lobes import specular_reflection
from shared.mesh import normalised
from shared.shading import VertexShading
from shared.solve.shape_samples import tangent_frames
from shared.transfer import position_and_normal, spread_vertices

NORMAL_STEP = 0.06
"""Radians between the normals whose reflections are differenced: half the spacing of 768 directions."""
ANCHORS = 3000


@dataclass(frozen=True)
class ShadingTerms:
    """P points, F frames: irradiance E over pi and reflection S at specular_intensity 1, [P, F, 3] each, and their
    derivatives irradiance_turn and reflection_turn [P, F, 3, 2] by a turn of the normal towards tangents [P, 2, 3]."""

    tangents: np.ndarray
    irradiance: np.ndarray
    reflection: np.ndarray
    irradiance_turn: np.ndarray
    reflection_turn: np.ndarray


class IrradianceVectors:
    """W of P points: visible [P, J] bool, directions [J, 3], light_along [J, F, 3]."""

    def __init__(self, visible: np.ndarray, directions: np.ndarray, light_along: np.ndarray):
        self.visible = torch.from_numpy(visible.astype(np.float32))
        self.directions, self.light_along = directions.astype(np.float32), light_along

    def frames(self, frames: slice) -> np.ndarray:
        """[P, n, 3 channels, 3] float32 in n of the frames."""
        light = self.light_along[:, frames]
        moments = light[..., None] * self.directions[:, None, None] * np.float32(4.0 / len(self.directions))
        result = self.visible @ torch.from_numpy(moments.reshape(len(light), -1))
        return result.numpy().reshape(len(self.visible), light.shape[1], 3, 3)


class Reflections:
    """S and its derivative by the normal, at rows [P] of the shading's points."""

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
        self.carry = sparse.csr_matrix((weight.ravel(), entries), (len(rows), len(self.anchors)))

    def at(self, frame: int, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """S [P, 3] of points with normals [P, 3] and its derivative by them [P, 3 channels, 3]."""
        value, slope = self._at_anchors(frame)
        level = value - np.einsum("acx,ax->ac", slope, self.normals)
        both = self.carry @ np.concatenate([level, slope.reshape(-1, 9)], axis=1)
        slope = both[:, 3:].reshape(-1, 3, 3)
        return np.maximum(both[:, :3] + np.einsum("pcx,px->pc", slope, normals), 0.0), slope

    def _at_anchors(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        shading = self.shading
        towards, blocked = shading.towards_camera(frame)[self.anchors], shading.blocked_light(frame)[self.anchors]
        facing = np.nonzero((towards * self.normals).sum(1) > -0.1)[0]
        light = shading.light_along[:, frame]
        roughness = shading.roughness_of(self.anchors[facing])
        values = [
            specular_reflection(table.take(facing), towards[facing], roughness, light, blocked[facing])
            for table in self.tables
        ]
        value, slope = np.zeros((len(self.anchors), 3)), np.zeros((len(self.anchors), 3, 3))
        value[facing] = values[0]
        for k in range(2):
            change = (values[1 + k] - values[0]) / NORMAL_STEP
            slope[facing] += change[:, :, None] * self.tangents[facing, k][:, None]
        return value, slope


def shading_terms(shading: VertexShading, rows: np.ndarray, with_specular: bool) -> ShadingTerms:
    """Terms of the shading's points rows [P] in all its frames."""
    normals = shading.points.normals[rows]
    tangents = tangent_frames(normals).astype(np.float32)
    vectors = IrradianceVectors(shading.transfer.visibility(rows), shading.directions, shading.light_along)
    turn = np.einsum("pfcx,pkx->pfck", vectors.frames(slice(None)), tangents)
    shape = (len(rows), shading.light_along.shape[1], 3)
    reflection, reflection_turn = np.zeros(shape, np.float32), np.zeros(shape + (2,), np.float32)
    if with_specular:
        reflections = Reflections(shading, rows)
        for f in range(shape[1]):
            reflection[:, f], slope = reflections.at(f, normals)
            reflection_turn[:, f] = np.einsum("pcx,pkx->pck", slope, tangents)
    return ShadingTerms(tangents, shading.irradiance_of_points(rows), reflection, turn, reflection_turn)

