"""The rim at which a surface ends, made one smooth closed curve.

The head model ends along edges of its mesh. Where its throat has more rings of faces than its nape, that is a zigzag of
a centimetre, and no stage moves it: nothing that is seen tells where a neck should end.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from shared.compute.sparse_solve import factorised
from shared.geometry.mesh import Mesh, boundary_loop, uniform_laplacian

HARMONICS = 3
"""Of the rim's curve: enough for a throat that reaches lower than nape and sides, too few for corners."""
REACH_MM = 20.0
"""So far from the rim vertices move with it. The head model's jaw is 40 mm or more away."""


def smooth_rim(mesh: Mesh) -> Mesh:
    """The mesh, of one boundary, with its rim on a smooth curve; farther from it than REACH_MM nothing moves.

    Each rim vertex goes to where the curve is at its own length along the rim; those near it follow as a thin plate
    does, which minimises the squared Laplacian of their displacements [Botsch2008]. ValueError where the mesh has more
    than one boundary.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    rim = boundary_loop(mesh.faces)
    moved = np.zeros_like(vertices)
    moved[rim] = smooth_curve(vertices[rim], HARMONICS) - vertices[rim]
    free = cKDTree(vertices[rim]).query(vertices)[0] < REACH_MM
    free[rim] = False
    laplacian = uniform_laplacian(mesh.faces, len(vertices))
    bending = (laplacian.T @ laplacian).tocsr()[free]
    moved[free] = factorised(bending[:, free]).solve(-(bending @ moved))
    return mesh.replace(vertices=vertices + moved)


def smooth_curve(points: np.ndarray, harmonics: int) -> np.ndarray:
    """[N, 3] mm: the points [N, 3] mm of a closed polygon on the curve of so many harmonics that fits it best.

    Coordinates are Fourier series of the length along the polygon [Kuhl1982], fitted by least squares in which each
    point counts as much as the length that it stands for.
    """
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    turn = 2.0 * np.pi * (np.cumsum(steps) - steps) / steps.sum()
    orders = turn[:, None] * np.arange(1, harmonics + 1)
    series = np.concatenate([np.ones((len(points), 1)), np.cos(orders), np.sin(orders)], axis=1)
    weight = np.sqrt(steps + np.roll(steps, 1))[:, None]
    return series @ np.linalg.lstsq(weight * series, weight * points, rcond=None)[0]
