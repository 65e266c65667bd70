"""What can be wrong with a mesh before it is handed to others; usd-core's validators do not look at any of
it."""

from __future__ import annotations

import numpy as np

from shared.geometry.mesh import Mesh, face_normals, mesh_edges, unique_pairs

MAXIMUM_DEGENERATE = 0.01
"""Share of faces without area above which a mesh counts as broken rather than untidy."""


def mesh_errors(mesh: Mesh) -> list[str]:
    """Sentences about what makes the mesh unusable; empty when it is sound.

    Indices in range, finite positions and UVs, UVs inside the unit square, few faces without area.
    """
    errors = []
    arrays = (("faces", mesh.faces, len(mesh.vertices)), ("face_uvs", mesh.face_uvs, len(mesh.uvs)))
    for name, indices, count in arrays:
        if indices.ndim != 2 or indices.shape[1] != 3 or len(indices) == 0:
            errors.append(f"{name} should be [F, 3] with F > 0, got {indices.shape}")
        elif indices.min() < 0 or indices.max() >= count:
            errors.append(
                f"{name} point outside of their array: {indices.min()} to {indices.max()} of {count}"
            )
    if len(mesh.faces) != len(mesh.face_uvs):
        errors.append(f"{len(mesh.faces)} faces but {len(mesh.face_uvs)} faces in UV space")
    for name, values in (("vertices", mesh.vertices), ("uvs", mesh.uvs)):
        if not np.isfinite(values).all():
            errors.append(f"{np.count_nonzero(~np.isfinite(values))} numbers in {name} are not finite")
    if errors:
        return errors
    if mesh.uvs.min() < -1e-6 or mesh.uvs.max() > 1.0 + 1e-6:
        errors.append(f"UVs leave the unit square: {mesh.uvs.min():.4g} to {mesh.uvs.max():.4g}")
    flat = degenerate_faces(mesh).sum()
    if flat > MAXIMUM_DEGENERATE * len(mesh.faces):
        errors.append(f"{flat} of {len(mesh.faces)} faces have no area")
    return errors


def mesh_warnings(mesh: Mesh) -> list[str]:
    """Sentences about what a modeller would want to know of a mesh without errors."""
    warnings = []
    flat = int(degenerate_faces(mesh).sum())
    if flat:
        warnings.append(f"{flat} of {len(mesh.faces)} faces have no area")
    crowded, turned = non_manifold_edges(mesh.faces)
    if crowded:
        warnings.append(f"{crowded} edges are shared by more than two faces")
    if turned:
        warnings.append(f"{turned} edges join faces of opposite winding")
    return warnings


def degenerate_faces(mesh: Mesh) -> np.ndarray:
    """[F] bool: two corners in one place or all three on a line (area below 1e-9 of the longest edge
    squared)."""
    corners = mesh.vertices[mesh.faces]
    longest = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(-1).max(1)
    area = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    return area <= 1e-9 * longest


def non_manifold_edges(faces: np.ndarray) -> tuple[int, int]:
    """[F, 3] -> edges with more than two faces; edges that two faces walk in the same direction."""
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    return int((mesh_edges(faces)[2] > 2).sum()), int((unique_pairs(directed)[2] > 1).sum())
