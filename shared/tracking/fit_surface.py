"""The free correction of a fitted head: a thin plate (bi-Laplacian) through the track points.

It stays the model's where no track is.

Reference: [Botsch2008].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from shared.compute.robust import ROBUST_SCALE, cauchy_weight
from shared.compute.sparse_solve import factorised
from shared.geometry.mesh import interpolate, uniform_laplacian, vertex_normals
from shared.geometry.raycast import RayScene, on_faces
from shared.tracking.depth_noise import DepthNoise
from shared.tracking.fit_head import FitWeights, HeadFit, pullable_vertices
from shared.tracking.head_model import HeadModel

SURFACE_REACH_MM = 8.0
LEAST_RELIEF_MM = 0.3
"""No head is closer to the model than this."""
CONTACT_MM, CONTACT_WEIGHT, FACING_COSINE = 2.5, 1.0, -0.5


def fit_surface(
    model: HeadModel, fit: HeadFit, points: np.ndarray, noise: DepthNoise, weights: FitWeights, iterations: int = 5
) -> HeadFit:
    """The free correction: vertices move by a thin plate through the track points [N, 3] (track space).

    Each point pulls the place on the surface that lies under it along the normal, not the nearest vertex: between
    vertices a curved surface sags. The plate is as stiff as a Wiener filter wants it: by the power of the points'
    noise over that of what the codes have left. Lips that the codes have closed stay closed, thin walls thin.
    """
    count = len(fit.vertices)
    laplacian = uniform_laplacian(model.faces, count)
    plate = (laplacian.T @ laplacian).tocsr() + 1e-4 * sparse.identity(count)
    contact = CONTACT_WEIGHT * _contact(model, fit.vertices)
    in_head, vertices = fit.to_head(points), fit.vertices
    variance = float(np.median(fit.scale * noise.sigma)) ** 2
    under = _under(model, vertices, in_head, SURFACE_REACH_MM)
    final = weights.stiffness * variance / _relief(under.offset, fit.scale * noise.single)
    for step in range(iterations):
        stiffness = final * 4.0 ** (iterations - 1 - step)
        under = _under(model, vertices, in_head, SURFACE_REACH_MM) if step else under
        interpolation = sparse.csr_matrix(
            (under.bary.ravel(), (np.repeat(np.arange(len(under.bary)), 3), model.faces[under.face].ravel())),
            shape=(len(under.bary), count),
        )
        wanted = interpolation @ (vertices - fit.vertices) + under.offset[:, None] * under.normal
        weighted = sparse.diags(under.weight) @ interpolation
        matrix = interpolation.T @ weighted + stiffness * plate + contact
        vertices = fit.vertices + factorised(matrix).solve(weighted.T @ wanted)
    return replace(fit, vertices=vertices)


def _relief(heights: np.ndarray, noise_mm: float) -> float:
    """Mean square of how far the head lies from the surface, mm^2: the points' heights [N] less their noise."""
    height = ROBUST_SCALE * np.median(np.abs(heights))
    return max(float(height**2 - noise_mm**2), LEAST_RELIEF_MM**2)


def _contact(model: HeadModel, vertices: np.ndarray) -> sparse.csr_matrix:
    """Laplacian [V, V] of the graph that joins vertices closer than CONTACT_MM that face each other or away from each
    other: lips, and thin walls such as lids before their sockets."""
    normals = vertex_normals(vertices, model.faces)
    pairs = cKDTree(vertices).query_pairs(CONTACT_MM, output_type="ndarray")
    pairs = pairs[(normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(1) < FACING_COSINE]
    rows = np.repeat(np.arange(len(pairs)), 2)
    joined = sparse.csr_matrix((np.tile([1.0, -1.0], len(pairs)), (rows, pairs.ravel())), (len(pairs), len(vertices)))
    return joined.T @ joined


@dataclass(frozen=True)
class _Under:
    """Places under points along the normal: face [n], bary [n, 3], offset [n] mm, normal [n, 3], Cauchy weight [n]."""

    face: np.ndarray
    bary: np.ndarray
    offset: np.ndarray
    normal: np.ndarray
    weight: np.ndarray


def _under(model: HeadModel, vertices: np.ndarray, points: np.ndarray, reach_mm: float) -> _Under:
    normals, usable = vertex_normals(vertices, model.faces), pullable_vertices(model)
    _, nearest = cKDTree(vertices[usable]).query(points)
    along = normals[usable[nearest]]
    origins = points + reach_mm * along
    face = RayScene(vertices, model.faces).first_faces(origins, -along)
    hit = face >= 0
    face, along = face[hit], along[hit]
    bary, distance = on_faces(vertices, model.faces, face, origins[hit], -along)
    offset = distance - reach_mm  # of the point above the surface
    near = (np.abs(offset) < reach_mm) & ((interpolate(normals, model.faces, face, bary) * along).sum(1) > 0.5)
    face, bary, offset, along = face[near], bary[near], offset[near], along[near]
    weight = cauchy_weight(offset, 3.0 * np.median(np.abs(offset)) + 0.05)
    return _Under(face, bary, offset, along, weight)
