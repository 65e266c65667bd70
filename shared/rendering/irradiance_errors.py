"""How far the modelled irradiance of surface points may be off: by an error of their normals, and where shadows end.

A mesh is off by some tenths of a millimetre to millimetres, and visibility is known along some hundred directions, so
that a cast shadow ends about where the model lets it end. A little beside itself each point sees what it might really
see: the spread of n . W there, W being the irradiance vector of what is visible and n the point's own normal, is the
standard deviation of its direct irradiance. Under a soft light that is little, under a lamp beside the nose all of it.

Reference: [Arvo1994] (the irradiance vector).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from shared.compute.compiled import compiled
from shared.compute.threads import share_out, thread_count
from shared.geometry.mesh import tangent_frames
from shared.rendering.transfer import Points, Transfer, position_and_normal

SHADOW_MM = 4.0
"""So far off may be where a mesh casts the border of a shadow: with its own error, seven degrees between the directions
along which visibility is known are two millimetres for each 16 that the shadow falls."""

_PLACES = 6
_POINTS_PER_BLOCK, _LIGHTS_AT_ONCE = 4096, 48


def irradiance_vectors(transfer: Transfer, light: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[P, 3, N] float32: W = 4 / J sum_j V L_j w_j over what each point sees, for lights light [J, N] along directions
    [J, 3]. n . W is the direct irradiance over pi."""
    moments = (light[:, None] * directions[..., None] * (4.0 / len(directions))).astype(np.float32)
    moments = moments.reshape(len(light), -1)
    vectors = np.empty((len(transfer.direct), moments.shape[1]), np.float32)

    def sum_up(block: int) -> None:
        rows = slice(block * _POINTS_PER_BLOCK, (block + 1) * _POINTS_PER_BLOCK)
        np.matmul(transfer.visibility(rows).astype(np.float32), moments, out=vectors[rows])

    share_out(-(-len(vectors) // _POINTS_PER_BLOCK), sum_up)
    return vectors.reshape(len(vectors), 3, -1)


def irradiance_slope(
    transfer: Transfer, normals: np.ndarray, light: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """[P, N] float32: by how much E over pi of points with normals [P, 3] changes per radian that they turn, at most.

    light [J, N]: along directions [J, 3]. E = n . W, so it is the length of what of W lies in the surface.
    """
    vectors, normals = irradiance_vectors(transfer, light, directions), normals.astype(np.float32)
    along = np.einsum("pxn,px->pn", vectors, normals)
    return np.linalg.norm(vectors - along[:, None] * normals[..., None], axis=1)


def places_around(points: Points, reach_mm: float) -> np.ndarray:
    """[P, K] the points nearest to places up to reach_mm beside each one."""
    tree, tangents = cKDTree(position_and_normal(points)), tangent_frames(points.normals)
    near = []
    for k in range(_PLACES):
        angle = 2.0 * np.pi * k / _PLACES
        beside = np.cos(angle) * tangents[:, 0] + np.sin(angle) * tangents[:, 1]
        moved = points.positions + reach_mm * (1.0 if k % 2 else 0.5) * beside
        near.append(tree.query(position_and_normal(Points(moved, points.normals)), workers=thread_count())[1])
    return np.stack(near, axis=1)


def shadow_uncertainty(
    points: Points, transfer: Transfer, light: np.ndarray, directions: np.ndarray, reach_mm: float
) -> np.ndarray:
    """[P, N] standard deviation of the irradiance over pi of P points in lights [J, N] along directions [J, 3],
    given that the borders of shadows are known to reach_mm. light [J, N] linear."""
    near, normals = places_around(points, reach_mm), points.normals.astype(np.float32)
    squared = np.zeros((len(points), light.shape[1]), np.float32)
    for start in range(0, light.shape[1], _LIGHTS_AT_ONCE):
        lights = slice(start, start + _LIGHTS_AT_ONCE)
        vectors = irradiance_vectors(transfer, light[:, lights], directions)

        def compare(block: int, vectors=vectors, lights=lights) -> None:
            rows = slice(block * _POINTS_PER_BLOCK, (block + 1) * _POINTS_PER_BLOCK)
            _compare_beside(vectors, normals[rows], near[rows], rows.start, squared[rows, lights])

        share_out(-(-len(squared) // _POINTS_PER_BLOCK), compare)
    return np.sqrt(squared / near.shape[1])


@compiled
def _compare_beside(vectors, normals, near, first, squared):
    """Adds to squared [p, N], of the points from `first` on, the squares of n . (W beside - W) over near [p, K]."""
    for p in range(len(near)):
        x, y, z = normals[p]
        for k in range(near.shape[1]):
            there = near[p, k]
            for n in range(squared.shape[1]):
                change = (x * (vectors[there, 0, n] - vectors[first + p, 0, n])
                          + y * (vectors[there, 1, n] - vectors[first + p, 1, n])
                          + z * (vectors[there, 2, n] - vectors[first + p, 2, n]))
                squared[p, n] += change * change
