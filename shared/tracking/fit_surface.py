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
STEPS = (256.0, 64.0, 16.0, 4.0, 1.0)
"""By how much the plate is stiffer than at the end: the first places under the points are far from the last."""


class ThinPlate:
    """The thin plate over one head model, made once: its fits differ in what pulls."""

    def __init__(self, model: HeadModel) -> None:
        count = len(model.template)
        laplacian = uniform_laplacian(model.faces, count)
        self.model, self.pullable = model, pullable_vertices(model)
        self.bending = (laplacian.T @ laplacian).tocsr() + 1e-4 * sparse.identity(count)
        self.smooth = model.from_coarser
        self.smooth_bending = None if self.smooth is None else _within(self.bending, self.smooth)


def fit_surface(
    plate: ThinPlate, fit: HeadFit, points: np.ndarray, noise: DepthNoise, weights: FitWeights, rough: bool = False
) -> HeadFit:
    """The free correction: vertices move by a thin plate through the track points [N, 3] (track space).

    Each point pulls the place on the surface that lies under it along the normal, not the nearest vertex: between
    vertices a curved surface sags. The plate is as stiff as a Wiener filter wants it: by the power of the points'
    noise over that of what the codes have left. Lips that the codes have closed stay closed, thin walls thin.

    A stiffer plate, with which it begins, moves as a coarser mesh does: displacements are then those of the level
    before, smoothed, a quarter of the unknowns. They are off by 0.002 mm there, by 0.004 mm at the last stiffness.
    rough: all steps so; what tracking needs between its passes.
    """
    model, bending, smooth = plate.model, plate.bending, plate.smooth
    contact = CONTACT_WEIGHT * _contact(model, fit.vertices)
    smooth_contact = None if smooth is None else _within(contact, smooth)
    in_head, vertices = fit.to_head(points), fit.vertices
    variance = float(np.median(fit.scale * noise.sigma)) ** 2
    under = _under(plate, vertices, in_head, SURFACE_REACH_MM)
    final = weights.stiffness * variance / _relief(under.offset, fit.scale * noise.single)
    for step, stiffer in enumerate(STEPS):
        under = _under(plate, vertices, in_head, SURFACE_REACH_MM) if step else under
        rows = np.repeat(np.arange(len(under.bary)), 3)
        interpolation = sparse.csr_matrix(
            (under.bary.ravel(), (rows, model.faces[under.face].ravel())), shape=(len(under.bary), len(vertices))
        )
        wanted = interpolation @ (vertices - fit.vertices) + under.offset[:, None] * under.normal
        held = final * stiffer
        if smooth is not None and (rough or stiffer > 1.0):
            pulls, stays = interpolation @ smooth, held * plate.smooth_bending + smooth_contact
            moved = smooth @ _displaced(pulls, under.weight, wanted, stays)
        else:
            moved = _displaced(interpolation, under.weight, wanted, held * bending + contact)
        vertices = fit.vertices + moved
    return replace(fit, vertices=vertices)


def _displaced(pulls: sparse.csr_matrix, weight: np.ndarray, wanted: np.ndarray, stays: sparse.spmatrix) -> np.ndarray:
    """Displacements [K, 3] by weighted least squares: pulls [N, K] @ them is near wanted [N, 3], stays [K, K] holds."""
    weighted = sparse.diags(weight) @ pulls
    return factorised(pulls.T @ weighted + stays).solve(weighted.T @ wanted)


def _within(energy: sparse.spmatrix, basis: sparse.csr_matrix) -> sparse.csr_matrix:
    """A quadratic form [V, V] for displacements that a basis [V, K] spans: [K, K]."""
    return (basis.T @ energy @ basis).tocsr()


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


def _under(plate: ThinPlate, vertices: np.ndarray, points: np.ndarray, reach_mm: float) -> _Under:
    model, usable = plate.model, plate.pullable
    normals = vertex_normals(vertices, model.faces)
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
