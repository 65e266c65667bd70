"""A statue-like bust made by formula: sockets, a nose, an open mouth, folds of cloth, a wreath that stands off.

For renderers, not for likeness: it shades itself far more than a head does.
"""

from __future__ import annotations

import numpy as np

from shared.geometry.mesh import Mesh, midpoint_subdivision, normalised

_SIZE = np.array([72.0, 108.0, 86.0])
# direction (x right, y up, z front), width, height of the bump relative to the radius
_FEATURES = (
    ((0.36, 0.14, 0.90), 0.20, -0.34),
    ((-0.36, 0.14, 0.90), 0.20, -0.34),
    ((0.0, -0.06, 1.0), 0.13, 0.34),
    ((0.0, -0.20, 0.98), 0.10, 0.16),
    ((0.0, -0.44, 0.90), 0.12, -0.30),
    ((0.97, 0.05, -0.05), 0.14, 0.18),
    ((-0.97, 0.05, -0.05), 0.14, 0.18),
)
_RING_RADIUS, _RING_WIDTH, _RING_HEIGHT = 88.0, 9.0, 58.0


def statue(levels: int = 6) -> Mesh:
    """The bust in millimetres, y up, facing +z: 4^(levels + 1) + 2 vertices and a ring of 6144."""
    directions, faces = _unit_sphere(levels)
    vertices = directions * _SIZE * _radius(directions)[:, None]
    ring, ring_faces = _ring()
    faces = np.concatenate([faces, ring_faces + len(vertices)]).astype(np.int32)
    vertices = np.concatenate([vertices, ring])
    height = (vertices[:, 1] - vertices[:, 1].min()) / np.ptp(vertices[:, 1])
    uvs = np.stack([np.arctan2(vertices[:, 0], vertices[:, 2]) / (2.0 * np.pi) + 0.5, height], axis=1)
    return Mesh(vertices, faces, uvs, faces)


def _unit_sphere(levels: int) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    for _ in range(levels):
        matrix, faces = midpoint_subdivision(faces, len(points))
        points = normalised(matrix @ points)
    return points, faces


def _radius(directions: np.ndarray) -> np.ndarray:
    """[N, 3] -> [N] relative radius."""
    radius = np.ones(len(directions))
    for towards, width, height in _FEATURES:
        away2 = 2.0 - 2.0 * directions @ normalised(np.array(towards))
        radius += height * np.exp(-away2 / width**2)
    azimuth, y = np.arctan2(directions[:, 0], directions[:, 2]), directions[:, 1]
    cloth = 1.0 / (1.0 + np.exp((y + 0.62) / 0.05))
    away_from_pole = 1.0 - np.exp(-(1.0 + y) / 0.05)
    return radius + cloth * away_from_pole * (0.25 + 0.13 * np.cos(13.0 * azimuth + 3.0 * np.sin(4.0 * y)))


def _ring(around: int = 192, across: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """A twisted torus round the forehead -> vertices, faces."""
    u, v = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(across) * 2 * np.pi / across, indexing="ij")
    tube = _RING_WIDTH * (1.0 + 0.3 * np.cos(2.0 * v + 9.0 * u))
    out = _RING_RADIUS + tube * np.cos(v)
    vertices = np.stack([out * np.sin(u), _RING_HEIGHT + tube * np.sin(v), out * np.cos(u)], axis=-1).reshape(-1, 3)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    corner = [((i + a) % around) * across + (j + b) % across for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate(
        [np.stack([corner[0], corner[1], corner[2]], 1), np.stack([corner[0], corner[2], corner[3]], 1)]
    )
    return vertices, faces
