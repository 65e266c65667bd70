"""What can be wrong with a mesh before it is handed to others; usd-core's validators do not look at any of
it."""

from __future__ import annotations

import numpy as np

from shared.geometry.mesh import Mesh, face_normals, mesh_edges, unique_pairs

MAXIMUM_DEGENERATE = 0.01
"""Share of faces without area above which a mesh counts as broken rather than untidy."""
_AT_ONCE = 1 << 20
"""Texels that are looked at together while faces are drawn."""


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


def uv_overlap(mesh: Mesh, size: int) -> tuple[float, tuple[float, float]]:
    """Share of the texels that faces cover which more than one face covers, and the middle (u, v) of those: 0 and
    (0, 0) where there are none. size: edge of the map in texels."""
    cover = texel_cover(mesh, size)
    rows, columns = np.nonzero(cover > 1)
    if len(rows) == 0:
        return 0.0, (0.0, 0.0)
    middle = (float(np.median(columns)) + 0.5) / size, 1.0 - (float(np.median(rows)) + 0.5) / size
    return float(len(rows) / np.count_nonzero(cover)), middle


def texel_cover(mesh: Mesh, size: int) -> np.ndarray:
    """[size, size] int32: how many faces cover each texel's centre in UV space, row 0 at v = 1.

    Faces that share an edge share no texel: a centre on the edge belongs to one of the two, as in any rasteriser.
    """
    corners = mesh.uvs[mesh.face_uvs] * [size, -size] + [0.0, size]
    first = np.clip(np.ceil(corners.min(1) - 0.5), 0, size).astype(int)
    count = np.clip(np.floor(corners.max(1) + 0.5), 0, size).astype(int) - first
    texels = np.where((count > 0).all(1), count.prod(1), 0)
    edges = [_edge(corners[:, k], corners[:, k - 2], corners[:, k - 1]) for k in range(3)]
    cover = np.zeros(size * size, np.int32)
    ends = np.cumsum(texels)
    starts = [0, *np.searchsorted(ends, np.arange(_AT_ONCE, ends[-1] + _AT_ONCE, _AT_ONCE), "right").tolist()]
    for low, high in zip(starts, [*starts[1:], len(texels)], strict=True):
        own = texels[low:high]
        face = np.repeat(np.arange(low, high), own)
        place = np.arange(len(face)) - np.repeat(np.cumsum(own) - own, own)
        row, column = np.divmod(place, count[face, 0])
        row, column = row + first[face, 1], column + first[face, 0]
        for start, along, side in edges:
            x, y = column + 0.5 - start[face, 0], row + 0.5 - start[face, 1]
            left = along[face, 0] * y - along[face, 1] * x >= 0.0
            inside = np.where(left, 1, -1) == side[face]
            face, row, column = face[inside], row[inside], column[inside]
        cover += np.bincount(row * size + column, minlength=len(cover)).astype(np.int32)
    return cover.reshape(size, size)


def _edge(one: np.ndarray, other: np.ndarray, third: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of edges between one and other [F, 2]: start [F, 2], direction [F, 2], and on which side the face's third
    corner lies, 1: left, -1: right, 0: on it.

    The ends are taken in one order whichever face asks, so that both faces of an edge round alike.
    """
    later = (one[:, 0] > other[:, 0]) | (one[:, 0] == other[:, 0]) & (one[:, 1] > other[:, 1])
    start, end = np.where(later[:, None], other, one), np.where(later[:, None], one, other)
    along, towards = end - start, third - start
    return start, along, np.sign(along[:, 0] * towards[:, 1] - along[:, 1] * towards[:, 0]).astype(int)
