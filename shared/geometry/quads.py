"""Meshes of quadrilaterals and the surface that they stand for: Catmull-Clark subdivision and its limit.

The rules are those that USD's `catmullClark` means with `interpolateBoundary` edgeOnly and
`faceVaryingLinearInterpolation` all: rims are cubic curves, without corners; texture coordinates are interpolated and
not smoothed.

References: [Catmull1978] (subdivision); [Halstead1993] (limit).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse

from shared.geometry.mesh import unique_pairs


@dataclass(frozen=True, eq=False)
class QuadMesh:
    """vertices [V, 3] mm, quads [Q, 4] counter-clockwise seen from outside, uvs [T, 2] (v up), quad_uvs [Q, 4] indices
    into uvs."""

    vertices: np.ndarray
    quads: np.ndarray
    uvs: np.ndarray
    quad_uvs: np.ndarray

    def replace(self, **changes) -> QuadMesh:
        """A copy with some arrays exchanged."""
        return replace(self, **changes)


def paired_quads(faces: np.ndarray) -> np.ndarray:
    """Triangles [2 Q, 3], of which each pair in a row shares an edge -> quads [Q, 4] without that edge, in the same
    orientation. ValueError where two of a pair do not share exactly one edge."""
    if len(faces) % 2:
        raise ValueError(f"{len(faces)} faces are no pairs")
    first, second = faces[::2], faces[1::2]
    own = ~(first[:, :, None] == second[:, None, :]).any(2)
    other = ~(second[:, :, None] == first[:, None, :]).any(2)
    if not ((own.sum(1) == 1) & (other.sum(1) == 1)).all():
        raise ValueError("faces in a row do not share an edge")
    row, a, b = np.arange(len(first)), own.argmax(1), other.argmax(1)
    return np.stack([first[row, a], first[row, (a + 1) % 3], second[row, b], first[row, (a + 2) % 3]], axis=1)


def triangulated(quads: np.ndarray) -> np.ndarray:
    """[Q, 4] -> [2 Q, 3]: each quad along its first diagonal, the two triangles together."""
    return np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], axis=1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Incidence:
    """Of quads [Q, 4] over `count` vertices: edges [E, 2]; edge of each side [Q, 4]; rim [E] bool; ends [V, E],
    corners [V, Q] and sides [E, Q]: 1 where one belongs to the other."""

    edges: np.ndarray
    side: np.ndarray
    rim: np.ndarray
    ends: sparse.csr_matrix
    corners: sparse.csr_matrix
    sides: sparse.csr_matrix

    @classmethod
    def of(cls, quads: np.ndarray, count: int) -> _Incidence:
        pairs = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
        edges, side, shared = unique_pairs(pairs)
        of_quad = np.repeat(np.arange(len(quads)), 4)
        ends = _ones(edges.ravel(), np.repeat(np.arange(len(edges)), 2), (count, len(edges)))
        corners = _ones(quads.ravel(), of_quad, (count, len(quads)))
        sides = _ones(side, of_quad, (len(edges), len(quads)))
        return cls(edges, side.reshape(-1, 4), shared == 1, ends, corners, sides)

    @property
    def degree(self) -> np.ndarray:
        """[V]: how many quads a vertex has."""
        return np.asarray(self.corners.sum(1)).ravel()

    @property
    def on_rim(self) -> np.ndarray:
        """[V] bool."""
        return np.asarray(self.ends[:, self.rim].sum(1)).ravel() > 0

    def split(self, quads: np.ndarray) -> np.ndarray:
        """[Q, 4] -> [4 Q, 4]: one quad for each corner, the four of a quad together; vertices are the old ones, then
        one for each edge, then one for each quad."""
        count = self.ends.shape[0]
        edge, middle = count + self.side, count + len(self.edges) + np.arange(len(quads))
        children = [[quads[:, k], edge[:, k], middle, edge[:, k - 1]] for k in range(4)]
        return np.array(children).transpose(2, 0, 1).reshape(-1, 4)


def _ones(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> sparse.csr_matrix:
    return sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=shape).tocsr()


def bilinear_subdivision(quads: np.ndarray, count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Splits each quad in four without moving anything: matrix [count + E + Q, count] and quads [4 Q, 4]."""
    mesh = _Incidence.of(quads, count)
    matrix = sparse.vstack([sparse.identity(count), mesh.ends.T / 2.0, mesh.corners.T / 4.0]).tocsr()
    return matrix, mesh.split(quads)


def catmull_clark(quads: np.ndarray, count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """One step of subdivision as a matrix: new vertices = matrix @ old, for positions and for blend shapes.

    quads [Q, 4], count vertices -> matrix [count + E + Q, count], quads [4 Q, 4]. A new vertex of a quad is its middle
    f, of an edge the mean of its ends and the two f; one of degree n goes to F / n + 2 R / n + (n - 3) / n of itself,
    F the mean of the f and R of the edges' middles around. On rims halves, and 1/8, 3/4, 1/8.
    """
    mesh = _Incidence.of(quads, count)
    middles, halves, degree = mesh.corners.T / 4.0, mesh.ends.T / 2.0, mesh.degree
    rim = mesh.on_rim
    of_edges = sparse.diags(np.where(mesh.rim, 1.0, 0.5)) @ halves
    of_edges = of_edges + sparse.diags(np.where(mesh.rim, 0.0, 0.25)) @ (mesh.sides @ middles)
    share = np.where(rim, 0.0, 1.0 / np.maximum(degree, 1.0) ** 2)
    kept = np.where(rim, 0.5, 1.0 - 3.0 / np.maximum(degree, 1.0))
    old = sparse.diags(share) @ (mesh.corners @ middles + 2.0 * mesh.ends @ halves) + sparse.diags(kept)
    old = old + sparse.diags(np.where(rim, 0.25, 0.0)) @ (mesh.ends[:, mesh.rim] @ halves[mesh.rim])
    return sparse.vstack([old, of_edges, middles]).tocsr(), mesh.split(quads)


def limit_matrix(quads: np.ndarray, count: int) -> sparse.csr_matrix:
    """[count, count] of quads [Q, 4]: where vertices come to lie after infinitely many steps of catmull_clark.

    Inside n^2 of the vertex, 4 of each neighbour across an edge and 1 across a quad, over n (n + 5) [Halstead1993]; on
    rims 1/6, 2/3, 1/6.
    """
    mesh = _Incidence.of(quads, count)
    degree, rim = mesh.degree, mesh.on_rim
    beside = _ones(mesh.edges.ravel(), mesh.edges[:, ::-1].ravel(), (count, count))
    along = _ones(mesh.edges[mesh.rim].ravel(), mesh.edges[mesh.rim][:, ::-1].ravel(), (count, count))
    across = _ones(quads.ravel(), np.roll(quads, 2, axis=1).ravel(), (count, count))
    weight = np.where(rim, 0.0, 1.0 / np.maximum(degree * (degree + 5.0), 1.0))
    own = np.where(rim, 2.0 / 3.0, weight * degree**2)
    found = sparse.diags(own) + sparse.diags(weight) @ (4.0 * beside + across)
    return (found + sparse.diags(np.where(rim, 1.0 / 6.0, 0.0)) @ along).tocsr()


@dataclass(frozen=True, eq=False)
class LimitSurface:
    """Triangles on the limit surface of a cage of C vertices: matrix [V, C] gives their vertices, whatever the cage's
    are; faces [F, 3]; uvs [T, 2] and face_uvs [F, 3]."""

    matrix: sparse.csr_matrix
    faces: np.ndarray
    uvs: np.ndarray
    face_uvs: np.ndarray

    @classmethod
    def of(cls, cage: QuadMesh, splits: int) -> LimitSurface:
        """Each of the cage's quads split in four so many times, vertices on the limit."""
        quads, matrix = cage.quads, sparse.identity(len(cage.vertices), format="csr")
        quad_uvs, uvs = cage.quad_uvs, cage.uvs
        for _ in range(splits):
            step, quads = catmull_clark(quads, matrix.shape[0])
            matrix = step @ matrix
            step, quad_uvs = bilinear_subdivision(quad_uvs, len(uvs))
            uvs = step @ uvs
        matrix = limit_matrix(quads, matrix.shape[0]) @ matrix
        return cls(matrix.tocsr(), triangulated(quads), uvs, triangulated(quad_uvs))
