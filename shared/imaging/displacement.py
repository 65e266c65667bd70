"""A head as few quads under subdivision, and a map of how far its surface lies above theirs.

The cage has the vertices of the mesh before it was ever subdivided, joined to quads. It is laid so that its limit
surface comes as near as it can to the place that the mesh has at the same texture coordinates, by least squares over
the texels of the atlas: textures stay on, and what is left is small. The map holds the rest: from each texel's place on
the limit surface, along its normal, to the mesh. That is what USD, MaterialX and Blender call displacement.

Places on the limit surface are those between its triangles' corners and half of the way to the corners' tangent planes
[Boubekeur2008], which has no error of second order.

References: [Catmull1978], [Boubekeur2008].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from shared.compute.sparse_solve import Factors, factorised
from shared.geometry.blend_shapes import BlendShape
from shared.geometry.mesh import Mesh, normalised, vertex_normals
from shared.geometry.quads import LimitSurface, QuadMesh, paired_quads
from shared.geometry.raycast import RayScene
from shared.imaging.image_sampling import texel_size
from shared.imaging.texels import TexelSurface, nearest_shown

SPLITS = 2
"""Of the quads into triangles on the limit surface: edges of less than a mm on a head."""
FITTED_TEXELS, HEIGHT_TEXELS = 512, 1024
"""Edges of the maps: the heights have no detail that the mesh's edges of a mm and more do not have."""
TIE = 1e-3
"""Square mm by which a vertex of the cage is drawn to where it was, for those that no texel shows."""
REACHES_MM = (0.3, 1.0, 3.0)
"""So far from its texel's place the mesh is looked for; what lies beyond belongs to another part of it."""
STEP_MM = 2.0**-7
"""Heights are multiples of it, off by 0.004 mm at most, in a seventh of the bytes of heights that are not."""
LEAST_MOVE_MM = 0.05


@dataclass(frozen=True, eq=False)
class CageFit:
    """How a cage follows its mesh: right [C, V], and the factors of what it is solved by."""

    right: sparse.csr_matrix
    factors: Factors

    def follow(self, values: np.ndarray) -> np.ndarray:
        """Of the mesh's vertices [V, 3], places or moves -> of the cage's [C, 3]."""
        return self.factors.solve(self.right @ np.asarray(values, np.float64))

    def shape(self, shape: BlendShape) -> BlendShape:
        """A blend shape of the mesh as one of the cage, of vertices that it moves by more than LEAST_MOVE_MM."""
        def moves(offsets: np.ndarray) -> np.ndarray:
            whole = np.zeros((self.right.shape[1], 3))
            whole[shape.vertices] = offsets
            return self.follow(whole)

        between = tuple((weight, moves(offsets)) for weight, offsets in shape.between)
        return BlendShape.of(shape.name, moves(shape.offsets), LEAST_MOVE_MM, between)


@dataclass(frozen=True, eq=False)
class DisplacedBase:
    """cage: control mesh of a Catmull-Clark surface, two of the coarse faces in each quad; heights [S, S] float32 mm
    along that surface's normal to the mesh, row 0 at v = 1; fit: how the cage follows the mesh; splits: into how many
    faces, as powers of 4, the mesh has each of the coarse ones."""

    cage: QuadMesh
    heights: np.ndarray
    fit: CageFit
    splits: int

    def quads_beside(self, faces: np.ndarray) -> np.ndarray:
        """[Q] bool: the quads without those that hold any of the faces [n] int of the mesh."""
        kept = np.ones(len(self.cage.quads), bool)
        kept[np.asarray(faces) // (2 * 4**self.splits)] = False
        return kept


def displaced_base(mesh: Mesh, coarse_faces: np.ndarray, coarse_face_uvs: np.ndarray) -> DisplacedBase:
    """The cage of a mesh and the heights of the mesh above its surface.

    coarse_faces, coarse_face_uvs [F0, 3]: the faces that the mesh was subdivided from, whose vertices and UVs are its
    first ones; pairs in a row make the quads. ValueError where these are no pairs.
    """
    quads, quad_uvs = paired_quads(coarse_faces), paired_quads(coarse_face_uvs)
    cage = QuadMesh(mesh.vertices[: quads.max() + 1], quads, mesh.uvs[: quad_uvs.max() + 1], quad_uvs)
    limit = LimitSurface.of(cage, SPLITS)
    fit = _fitted(mesh, limit)
    cage = cage.replace(vertices=fit.follow(mesh.vertices))
    heights = _heights(mesh, _as_mesh(limit, cage))
    splits = int(round(np.log(len(mesh.faces) / len(coarse_faces)) / np.log(4.0)))
    return DisplacedBase(cage, heights, fit, splits)


def _as_mesh(limit: LimitSurface, cage: QuadMesh) -> Mesh:
    return Mesh(limit.matrix @ cage.vertices, limit.faces, limit.uvs, limit.face_uvs)


def _fitted(mesh: Mesh, limit: LimitSurface) -> CageFit:
    count = limit.matrix.shape[1]
    flat = Mesh(np.zeros((limit.matrix.shape[0], 3)), limit.faces, limit.uvs, limit.face_uvs)
    on_limit, on_mesh = (TexelSurface(each, FITTED_TEXELS) for each in (flat, mesh))
    _, rows, own_rows = np.intersect1d(on_limit.pixel, on_mesh.pixel, assume_unique=True, return_indices=True)
    shown = (_weights(on_limit, rows) @ limit.matrix).tocsr()
    area = sparse.diags(texel_size(mesh, FITTED_TEXELS)[on_mesh.face[own_rows]] ** 2)
    tie = sparse.eye(count, len(mesh.vertices)) * TIE
    left = shown.T @ area @ shown + sparse.identity(count) * TIE
    return CageFit((shown.T @ area @ _weights(on_mesh, own_rows) + tie).tocsr(), factorised(left))


def _weights(surface: TexelSurface, rows: np.ndarray) -> sparse.csr_matrix:
    """[n, V]: from values at the vertices to those at texels rows [n]."""
    corners = surface.mesh.faces[surface.face[rows]]
    number = np.repeat(np.arange(len(rows)), 3)
    shape = (len(rows), len(surface.mesh.vertices))
    return sparse.csr_matrix((surface.bary[rows].astype(np.float64).ravel(), (number, corners.ravel())), shape)


def surface_points(base: Mesh, face: np.ndarray, bary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places [N, 3] mm and unit normals [N, 3] on the smooth surface whose triangles base holds, on faces face [N] with
    corner weights bary [N, 3]."""
    corners, weights = base.faces[face], np.asarray(bary, np.float64)[..., None]
    ends, ends_normals = base.vertices[corners], vertex_normals(base.vertices, base.faces)[corners]
    flat = (ends * weights).sum(1)
    lift = ((ends - flat[:, None]) * ends_normals).sum(2, keepdims=True)
    return flat + 0.5 * (lift * ends_normals * weights).sum(1), normalised((ends_normals * weights).sum(1))


def _heights(mesh: Mesh, base: Mesh) -> np.ndarray:
    """[S, S] float32 mm. Texels from which the normal misses the mesh, beyond its rim, have the nearest one's."""
    texels, wanted = TexelSurface(base, HEIGHT_TEXELS), TexelSurface(mesh, HEIGHT_TEXELS)
    _, rows, own_rows = np.intersect1d(texels.pixel, wanted.pixel, assume_unique=True, return_indices=True)
    places, normals = surface_points(base, texels.face[rows], texels.bary[rows])
    target = (mesh.vertices[mesh.faces[wanted.face[own_rows]]] * wanted.bary[own_rows, :, None]).sum(1)
    height = _along_normals(RayScene(mesh.vertices, mesh.faces), places, normals, target)
    found = np.isfinite(height)
    heights, known = np.zeros(HEIGHT_TEXELS**2, np.float32), texels.pixel[rows[found]]
    heights[known] = np.round(height[found] / STEP_MM) * STEP_MM
    shown = np.zeros((HEIGHT_TEXELS, HEIGHT_TEXELS), bool)
    shown.ravel()[known] = True
    empty, nearest = nearest_shown(shown)
    heights[empty] = heights[nearest]
    return heights.reshape(shown.shape)


def _along_normals(scene: RayScene, places: np.ndarray, normals: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Heights [N] mm above places [N, 3] along normals [N, 3] at which the scene's surface lies, that crossing which is
    nearest to target [N, 3]; NaN where none is within reach."""
    guess, height = ((target - places) * normals).sum(1), np.full(len(places), np.nan)
    for reach in REACHES_MM:
        left = np.nonzero(np.isnan(height))[0]
        off = np.full(len(left), np.inf)
        for side in (reach, -reach):
            start = guess[left] + side
            origins, directions = places[left] + start[:, None] * normals[left], -np.sign(side) * normals[left]
            distance = scene.intersect(origins, directions)[2].astype(np.float64)
            hit = np.where(distance < 2.0 * reach, start - np.sign(side) * distance, np.nan)
            apart = np.linalg.norm(places[left] + hit[:, None] * normals[left] - target[left], axis=1)
            nearer = apart < off
            off[nearer], height[left[nearer]] = apart[nearer], hit[nearer]
    return height
