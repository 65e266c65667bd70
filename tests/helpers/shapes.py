"""Simple surfaces that several tests use, and a camera before them."""

from __future__ import annotations

import numpy as np

from shared.geometry.mesh import Mesh, midpoint_subdivision, normalised
from shared.geometry.surface import Surface
from shared.geometry.transforms import rigid, rotation_from_vector

LENS = np.array([[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]])
"""Intrinsics of a camera of 160 x 120 pixels."""
FACING = np.diag([1.0, -1.0, -1.0])
"""Rotation of a head that looks into the camera."""


def sphere(radius: float = 1.0, levels: int = 4) -> Mesh:
    """A sphere from a subdivided octahedron, outward faces; UVs are longitude and height, for looks only."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(levels):
        matrix, faces = midpoint_subdivision(faces, len(vertices))
        vertices = normalised(matrix @ vertices)
    uvs = np.stack([np.arctan2(vertices[:, 0], vertices[:, 2]) / (2 * np.pi) + 0.5, vertices[:, 1] / 2 + 0.5], axis=1)
    return Mesh(vertices * radius, faces.astype(np.int32), uvs, faces.astype(np.int32))


def grid_plane(count: int = 9, extent: float = 1.0) -> Mesh:
    """A square in the x-y plane facing +z, count x count vertices, UVs filling the unit square."""
    x, y = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    uvs = np.stack([x.ravel(), y.ravel()], axis=1)
    vertices = np.concatenate([(uvs - 0.5) * extent, np.zeros((len(uvs), 1))], axis=1)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + count + 1], axis=1)
    upper = np.stack([corner, corner + count + 1, corner + count], axis=1)
    faces = np.concatenate([lower, upper]).astype(np.int32)
    return Mesh(vertices, faces, uvs, faces)


def two_balls(centres: np.ndarray, radius: float) -> Surface:
    """A pair of eyeballs about centres [2, 3], right and left, each with a half of the map."""
    ball = sphere(radius, 4)
    faces, uvs = ball.faces, ball.uvs * [0.5, 1.0]
    mesh = Mesh(
        np.concatenate([ball.vertices + centre for centre in centres]),
        np.concatenate([faces, faces + len(ball.vertices)]),
        np.concatenate([uvs, uvs + [0.5, 0.0]]),
        np.concatenate([ball.face_uvs, ball.face_uvs + len(uvs)]),
    )
    return Surface(mesh, np.zeros(2 * len(faces), np.uint8), ("eyes",))


def turned(vectors, place=(0.0, 0.0, 900.0)):
    """[..., 4, 4]: a head that looks into the camera, turned by rotation vectors [..., 3], at `place` [..., 3] mm."""
    return rigid(FACING @ rotation_from_vector(np.asarray(vectors)), np.asarray(place, np.float64))


def nods(degrees, axis=(0.0, 1.0, 0.0), distance=900.0):
    """Poses before the camera, turned by these angles about an axis of the head."""
    return turned(np.radians(degrees)[:, None] * np.array(axis), (0.0, 0.0, distance))
