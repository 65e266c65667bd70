"""Triangle meshes: normals, Laplacian, subdivision and the map from texels to the surface.

References: [Loop1987] (subdivision, with Warren's weights); [Thuermer1998] (vertex normals, weights by angle).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from shared.compute.compiled import compiled


@dataclass(frozen=True)
class Mesh:
    """vertices [V, 3] mm, faces [F, 3], uvs [T, 2] (v up), face_uvs [F, 3] indices into uvs."""

    vertices: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    face_uvs: np.ndarray

    def replace(self, **changes) -> Mesh:
        """A copy with some arrays exchanged."""
        return replace(self, **changes)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[V, 3], [F, 3] -> [F, 3] normals whose length is twice the face's area."""
    corners = vertices[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def normalised(vectors: np.ndarray) -> np.ndarray:
    """[..., N] -> unit length; the zero vector stays zero."""
    squared = sum(part * part for part in np.moveaxis(vectors, -1, 0))  # numpy's sum along so short an axis is slow
    return vectors / np.maximum(np.sqrt(squared), 1e-20)[..., None]


def tangent_frames(normals: np.ndarray) -> np.ndarray:
    """[P, 3] unit normals -> [P, 2, 3]: two unit tangents at right angles to each other."""
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = normalised(np.cross(normals, axis))
    return np.stack([first, np.cross(normals, first)], axis=1)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[V, 3], [F, 3] -> [V, 3] unit normals, faces weighted by their angle at the vertex."""
    total = np.zeros((len(vertices), 3))
    _add_normals(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64), total)
    return normalised(total)


@compiled
def _add_normals(vertices, faces, total):
    """Adds to total [V, 3] each face's unit normal times its angle at the corner."""
    edges = np.empty((3, 3))
    for f in range(len(faces)):
        for k in range(3):
            here, following = faces[f, k], faces[f, (k + 1) % 3]
            squared = 0.0
            for axis in range(3):
                edges[k, axis] = vertices[following, axis] - vertices[here, axis]
                squared += edges[k, axis] * edges[k, axis]
            length = max(np.sqrt(squared), 1e-20)
            for axis in range(3):
                edges[k, axis] /= length
        x = edges[0, 1] * edges[1, 2] - edges[0, 2] * edges[1, 1]
        y = edges[0, 2] * edges[1, 0] - edges[0, 0] * edges[1, 2]
        z = edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-20)
        for k in range(3):
            cosine = 0.0
            for axis in range(3):
                cosine -= edges[k, axis] * edges[k - 1, axis]
            angle = np.arccos(min(max(cosine, -1.0), 1.0)) / length
            total[faces[f, k], 0] += x * angle
            total[faces[f, k], 1] += y * angle
            total[faces[f, k], 2] += z * angle


def shading_normals(mesh: Mesh) -> np.ndarray:
    """[V, 3] unit normals; where there are only faces without area around a vertex, any unit vector."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 0.0, 1.0)
    return normals


def uv_tangents(mesh: Mesh, normals: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """[n, 2, 3] float32 at places on faces [n] with corner weights [n, 3]: unit directions of growing u and v.

    normals [n, 3] unit. The faces' directions of u are averaged at each texture vertex and made orthogonal to the
    normal at the place; the second direction is normal x first, turned to where v grows, as [Mikkelsen2008] has them.
    face [n] int; bary [n, 3].
    """
    corners, uv = mesh.vertices[mesh.faces], mesh.uvs[mesh.face_uvs]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    sign = np.where(d1[:, 0] * d2[:, 1] - d2[:, 0] * d1[:, 1] >= 0, 1.0, -1.0)[:, None]
    along_u = normalised(sign * (e1 * d2[:, 1:] - e2 * d1[:, 1:]))
    total = np.zeros((len(mesh.uvs), 3))
    for k in range(3):
        np.add.at(total, mesh.face_uvs[:, k], along_u)
    first = np.einsum("nk,nkx->nx", bary, total[mesh.face_uvs[face]])
    first = normalised(first - (first * normals).sum(1, keepdims=True) * normals)
    return np.stack([first, np.cross(normals, first) * sign[face]], axis=1).astype(np.float32)


def half_edges(faces: np.ndarray) -> np.ndarray:
    """[F, 3] -> [3 F, 2]: each face's edges in its orientation; corners 0 and 1 of all faces, then 1 and 2, 2 and 0."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def boundary_loop(faces: np.ndarray) -> np.ndarray:
    """[F, 3] -> [N]: vertices along the rim of a surface of one boundary, in its faces' orientation, the lowest first.

    ValueError where the surface has more than one boundary.
    """
    pairs = half_edges(faces)
    _, edge, shared = unique_pairs(np.sort(pairs, axis=1))
    following = dict(pairs[shared[edge] == 1].tolist())
    loop = [min(following)]
    while following[loop[-1]] != loop[0]:
        loop.append(following[loop[-1]])
    if len(loop) != len(following):
        raise ValueError(f"the surface has more than one boundary: {len(loop)} of {len(following)} edges in a loop")
    return np.array(loop)


def vertex_adjacency(faces: np.ndarray, count: int) -> sparse.csr_matrix:
    """[F, 3] -> [count, count]: 1 where an edge joins two vertices."""
    pairs = half_edges(faces)
    adjacency = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return ((adjacency + adjacency.T) > 0).astype(np.float64)


def graph_laplacian(faces: np.ndarray, count: int) -> sparse.csr_matrix:
    """[F, 3] -> [count, count]: D - A, so that L @ x is each vertex, as often as it has neighbours, minus their sum.

    Symmetric. A: vertex_adjacency; D: diagonal, the number of neighbours.
    """
    adjacency = vertex_adjacency(faces, count)
    return (sparse.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency).tocsr()


def uniform_laplacian(faces: np.ndarray, count: int) -> sparse.csr_matrix:
    """[F, 3] -> [count, count]: I - D^-1 A, so that L @ x is each vertex minus the mean of its neighbours."""
    adjacency = vertex_adjacency(faces, count)
    degree = np.maximum(np.asarray(adjacency.sum(1)).ravel(), 1.0)
    return (sparse.identity(count) - sparse.diags(1.0 / degree) @ adjacency).tocsr()


def diffused(values: np.ndarray, faces: np.ndarray, steps: int) -> np.ndarray:
    """The vertices' values [V, ...] after so many steps, in each of which all go half of the way to their neighbours'
    mean: spread over some sqrt(steps) edges. faces [F, 3]."""
    laplacian = uniform_laplacian(faces, len(values))
    for _ in range(steps):
        values = values - 0.5 * (laplacian @ values)
    return values


def typical_edge(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Median length of the faces' first edges, mm."""
    return float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))


def diffused_over(mesh: Mesh, values: np.ndarray, width_mm: float) -> np.ndarray:
    """The vertices' values [V, ...] spread over some width, mm, whatever the mesh's edges are."""
    steps = round((width_mm / typical_edge(mesh.vertices, mesh.faces)) ** 2)
    return diffused(values, mesh.faces, steps)


def unique_pairs(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[N, 2] indices -> distinct pairs [U, 2] in order, which of them each is [N], how often each occurs [U]."""
    count = int(pairs.max(initial=0)) + 1
    # One number for a pair sorts many times faster than rows do.
    keys, inverse, occurs = np.unique(pairs.astype(np.int64) @ [count, 1], return_inverse=True, return_counts=True)
    return np.stack(np.divmod(keys, count), axis=1), inverse.ravel(), occurs


def mesh_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[F, 3] -> edges [E, 2] with the lower vertex first, in order; edge of each corner pair (01, 12, 20) [F, 3]; how
    many faces share each edge [E]."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
    edges, edge, shared = unique_pairs(pairs)
    return edges, edge.reshape(-1, 3), shared


def _split(faces: np.ndarray, face_edges: np.ndarray, count: int) -> np.ndarray:
    """Each face becomes three corner faces and a middle one: [F, 3] -> [4 F, 3], the four of a face together."""
    a, b, c = faces.T
    ab, bc, ca = count + face_edges.T
    children = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])
    return children.transpose(2, 0, 1).reshape(-1, 3)


def midpoint_subdivision(faces: np.ndarray, count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Splits each face in four without moving anything: matrix [count + E, count] and faces [4 F, 3]."""
    edges, face_edges, _ = mesh_edges(faces)
    rows = np.repeat(np.arange(len(edges)), 2)
    middle = sparse.coo_matrix((np.full(len(rows), 0.5), (rows, edges.ravel())), shape=(len(edges), count))
    return sparse.vstack([sparse.identity(count), middle]).tocsr(), _split(faces, face_edges, count)


def loop_subdivision(faces: np.ndarray, count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """One step of Loop subdivision as a matrix: new vertices = matrix @ old, for positions and for blend shapes.

    faces [F, 3], count vertices -> matrix [count + E, count], faces [4 F, 3]. Inner vertices take Warren's weights
    (3/16 for three neighbours, else 3 / (8 n)); boundary vertices 1/8, 3/4, 1/8; inner edges 3/8, 3/8, 1/8, 1/8.
    """
    edges, face_edges, shared = mesh_edges(faces)
    boundary = shared == 1
    adjacency = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count)).tocsr()
    rim = sparse.coo_matrix((boundary.astype(float), edges.T), shape=(count, count)).tocsr()
    adjacency, rim = adjacency + adjacency.T, rim + rim.T
    degree = np.asarray(adjacency.sum(1)).ravel()
    on_rim = np.asarray(rim.sum(1)).ravel() > 0
    beta = np.where(degree == 3, 3.0 / 16.0, 3.0 / (8.0 * np.maximum(degree, 1)))
    inner = sparse.diags(np.where(on_rim, 0.0, beta)) @ adjacency
    outer = sparse.diags(np.where(on_rim, 0.125, 0.0)) @ rim
    old = inner + outer
    old = old + sparse.diags(1.0 - np.asarray(old.sum(1)).ravel())

    opposite = np.roll(faces, 1, axis=1)
    across = sparse.coo_matrix((np.ones(faces.size), (face_edges.ravel(), opposite.ravel())), shape=(len(edges), count))
    rows = np.repeat(np.arange(len(edges)), 2)
    ends = sparse.coo_matrix((np.ones(len(rows)), (rows, edges.ravel())), shape=(len(edges), count))
    new = sparse.diags(np.where(boundary, 0.5, 0.375)) @ ends + sparse.diags(np.where(boundary, 0.0, 0.125)) @ across
    return sparse.vstack([old, new]).tocsr(), _split(faces, face_edges, count)


def subdivide(mesh: Mesh) -> Mesh:
    """One Loop step for the surface, midpoints for its texture coordinates."""
    geometry, faces = loop_subdivision(mesh.faces, len(mesh.vertices))
    texture, face_uvs = midpoint_subdivision(mesh.face_uvs, len(mesh.uvs))
    return Mesh(geometry @ mesh.vertices, faces.astype(np.int32), texture @ mesh.uvs, face_uvs.astype(np.int32))


def is_subdivision(mesh: Mesh, faces: np.ndarray, face_uvs: np.ndarray) -> bool:
    """Whether the mesh has the faces that subdivide makes of coarse ones faces [F, 3] and face_uvs [F, 3]."""
    for found, coarse in ((mesh.faces, faces), (mesh.face_uvs, face_uvs)):
        while len(coarse) < len(found):
            edges, corners, _ = mesh_edges(coarse)
            coarse = _split(coarse, corners, int(coarse.max()) + 1)
        if not np.array_equal(coarse, found):
            return False
    return True


def interpolate(values: np.ndarray, faces: np.ndarray, face_index: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """Barycentric interpolation: values [V, ...] at face_index [N] with corner weights bary [N, 3] -> [N, ...]."""
    corners = faces[face_index]
    weights = bary.reshape(bary.shape + (1,) * (values.ndim - 1)).astype(values.dtype, copy=False)
    result = values[corners[:, 0]] * weights[:, 0]
    result += values[corners[:, 1]] * weights[:, 1]
    result += values[corners[:, 2]] * weights[:, 2]
    return result


def rasterize_uv(mesh: Mesh, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Which face covers each texel's centre. -> face [size, size] int32 (-1: none), bary [size, size, 3] float32.

    Row 0 is v = 1. Where faces overlap in UV the one listed first wins.
    """
    corners = np.ascontiguousarray(mesh.uvs[mesh.face_uvs] * [size, -size] + [0.0, size], float)
    face = np.full((size, size), -1, np.int32)
    bary = np.zeros((size, size, 3), np.float32)
    _rasterize(corners, face, bary)
    return face, bary


@compiled
def _rasterize(corners, face, bary):
    """corners [faces, 3, 2] in texels -> filled in: face [S, S], bary [S, S, 3]."""
    size = len(face)
    for f in range(len(corners)):
        (ax, ay), (bx, by), (cx, cy) = corners[f]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-12:
            continue
        for row in range(max(0, math.ceil(min(ay, by, cy) - 0.5)), min(size, math.floor(max(ay, by, cy) + 0.5))):
            y = row + 0.5
            for column in range(max(0, math.ceil(min(ax, bx, cx) - 0.5)), min(size, math.floor(max(ax, bx, cx) + 0.5))):
                x = column + 0.5
                u = ((cx - bx) * (y - by) - (cy - by) * (x - bx)) / area
                v = ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) / area
                w = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                if face[row, column] >= 0 or min(u, v, w) < -1e-6:
                    continue
                u, v, w = max(u, 0.0), max(v, 0.0), max(w, 0.0)
                face[row, column] = f
                total = u + v + w
                bary[row, column, 0], bary[row, column, 1], bary[row, column, 2] = u / total, v / total, w / total


def segments_at(mesh: Mesh, face_segment: np.ndarray | None, positions: np.ndarray) -> np.ndarray | None:
    """Segment [P] of the vertices nearest to positions [P, 3] mm, from face_segment [F] int; None where the mesh has
    no segments."""
    if face_segment is None:
        return None
    of_vertex = np.zeros(len(mesh.vertices), int)
    of_vertex[mesh.faces] = face_segment[:, None]
    return of_vertex[cKDTree(mesh.vertices).query(positions)[1]]
