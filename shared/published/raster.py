"""What each pixel sees, differentiable by the mesh's vertices: primary rays inside, blended silhouettes at the edges.

Inside a triangle the point that a pixel sees follows from intersecting its ray with the triangle's plane, which torch
differentiates: moving a vertex slides texture and normals under the pixel. At silhouettes a pixel switches surface,
which has no derivative; there the two pixels on either side are blended by where the edge crosses the line between
their centres, and the crossing carries the gradient.

Reference: [Laine2020], section 3.6 (antialiasing). Theirs looks for the edge among those of the nearer pixel's
triangle; here every silhouette edge is drawn along the lines between pixel centres, so that triangles smaller than a
pixel do not hide it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from shared.geometry.mesh import Mesh, face_normals, half_edges
from shared.geometry.raycast import RayScene, camera_hits, pixel_directions
from shared.geometry.transforms import camera_centres

NEAR_MM = 0.5
"""A pixel's surface lies behind an edge when it is deeper than it by this much."""


@dataclass(frozen=True)
class Hits:
    """face [h, w] (-1: background), depth [h, w] mm along the camera's axis (infinite there)."""

    face: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class Pairs:
    """N pairs of neighbouring pixels with a silhouette edge between them: flat indices of the pixel on the edge's own
    surface (near) and of the one beyond (far), the edge's vertices [N, 2], the axis that the pair lies along (0: x,
    1: y), and far minus near along it (+1 or -1)."""

    near: np.ndarray
    far: np.ndarray
    edge: np.ndarray
    axis: np.ndarray
    sign: np.ndarray

    def __len__(self) -> int:
        return len(self.near)

    def take(self, chosen: np.ndarray) -> Pairs:
        """Some of the pairs. chosen [n] int or bool."""
        return Pairs(self.near[chosen], self.far[chosen], self.edge[chosen], self.axis[chosen], self.sign[chosen])


@dataclass(frozen=True)
class SurfacePoints:
    """What P pixels see: position [P, 3] mm, normal [P, 3] unit, uv [P, 2], towards [P, 3] unit, to the camera."""

    position: torch.Tensor
    normal: torch.Tensor
    uv: torch.Tensor
    towards: torch.Tensor


def torch_vertex_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """shared.geometry.mesh.vertex_normals in torch: [V, 3], [F, 3] -> [V, 3], faces weighted by their angle."""
    corners = vertices[faces]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(cross, dim=1)
    total = torch.zeros_like(vertices)
    for k in range(3):
        one, other = (corners[:, (k + step) % 3] - corners[:, k] for step in (1, 2))
        angle = torch.atan2(torch.linalg.cross(one, other).norm(dim=1), (one * other).sum(1))
        total = total.index_add(0, faces[:, k], normals * angle[:, None])
    return torch.nn.functional.normalize(total, dim=1)


class Raster:
    """A mesh's topology before a camera of fixed lens. size: (width, height)."""

    def __init__(self, mesh: Mesh, intrinsics: np.ndarray, size: tuple[int, int], dtype=torch.float32):
        self.faces, self.intrinsics, self.size = mesh.faces, intrinsics, size
        self._rays = pixel_directions(intrinsics, *size).reshape(-1, 3)
        self._dtype = dtype
        self._faces, self._face_uvs = (
            torch.from_numpy(x.astype(np.int64)) for x in (mesh.faces, mesh.face_uvs)
        )
        self._uvs = torch.from_numpy(mesh.uvs).to(dtype)
        edges = np.sort(half_edges(mesh.faces), axis=1)
        self._edges, of_corner, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(of_corner.ravel(), kind="stable") % len(mesh.faces)
        first = np.concatenate([[0], np.cumsum(count)[:-1]])
        # -1: an edge of one face alone, where the mesh was cut; no silhouette of the person.
        self._edge_faces = np.stack(
            [order[first], np.where(count > 1, order[np.minimum(first + 1, len(order) - 1)], -1)], 1
        )

    def hits(self, scene: RayScene, camera_from_head: np.ndarray) -> Hits:
        """Primary rays through all pixel centres."""
        face, _, depth = camera_hits(scene, camera_from_head, self.intrinsics, *self.size)
        return Hits(face, depth)

    def points(
        self,
        vertices: torch.Tensor,
        normals: torch.Tensor,
        camera_from_head: np.ndarray,
        pixels: np.ndarray,
        face: np.ndarray,
    ) -> SurfacePoints:
        """The surface behind flat pixel indices [P] that see these faces [P]; normals [V, 3] of the vertices. pixels
        [P] int; face [P] int."""
        origin = self._tensor(camera_centres(camera_from_head))
        direction = self._tensor(self._rays[pixels] @ camera_from_head[:3, :3])
        index = torch.from_numpy(face.astype(np.int64))
        a, b, c = vertices[self._faces[index]].unbind(1)
        # ray against triangle [Moeller1997]
        across = torch.linalg.cross(direction, c - a)
        scale = 1.0 / (across * (b - a)).sum(1)
        from_a = origin - a
        beside = torch.linalg.cross(from_a, b - a)
        u, v = (from_a * across).sum(1) * scale, (direction * beside).sum(1) * scale
        bary = torch.stack([1.0 - u - v, u, v], dim=1)[..., None]
        position = origin + ((c - a) * beside).sum(1, keepdim=True) * scale[:, None] * direction
        normal = torch.nn.functional.normalize((normals[self._faces[index]] * bary).sum(1), dim=1)
        uv = (self._uvs[self._face_uvs[index]] * bary).sum(1)
        return SurfacePoints(position, normal, uv, torch.nn.functional.normalize(origin - position, dim=1))

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._dtype)

    # ------------------------------------------------------------------ silhouettes
    def pairs(self, vertices: np.ndarray, camera_from_head: np.ndarray, hits: Hits) -> Pairs:
        """The pairs of neighbouring pixels between which one surface ends before another or the background."""
        pixels, depth, edges = self._project_silhouette(vertices, camera_from_head)
        found = [self._crossings(pixels, depth, edges, hits, axis) for axis in (0, 1)]
        return Pairs(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    def _project_silhouette(self, vertices: np.ndarray, camera_from_head: np.ndarray):
        """Pixels [E, 2, 2], depth [E, 2] and vertices [E, 2] of the edges between a front and a back face."""
        towards = camera_centres(camera_from_head) - vertices[self.faces[:, 0]]
        facing = (towards * face_normals(vertices, self.faces)).sum(1) > 0
        one, other = self._edge_faces.T
        edges = self._edges[(other >= 0) & (facing[one] != facing[other])]
        seen = vertices[edges] @ camera_from_head[:3, :3].T + camera_from_head[:3, 3]
        pixels = seen[..., :2] / seen[..., 2:] * self.intrinsics[[0, 1], [0, 1]] + self.intrinsics[:2, 2]
        return pixels, seen[..., 2], edges

    def _crossings(self, pixels: np.ndarray, depth: np.ndarray, edges: np.ndarray, hits: Hits, axis: int):
        """Pairs along one axis: where edges cross the lines through pixel centres, the outermost edge of each pair."""
        along, line = pixels[..., axis], pixels[..., 1 - axis]
        width, height = self.size
        lines, places = (height, width) if axis == 0 else (width, height)
        # Steep edges are blended along rows, flat ones along columns: both at once would count an edge twice.
        steep = np.abs(np.diff(line, axis=1)) >= np.abs(np.diff(along, axis=1)) + 1e-12 * (axis == 1)
        kept = steep[:, 0]
        along, line, depth, edges = along[kept], line[kept], depth[kept], edges[kept]
        low, high = np.ceil(line.min(1) - 0.5).astype(int), np.floor(line.max(1) - 0.5).astype(int)
        low, high = np.maximum(low, 0), np.minimum(high, lines - 1)
        count = np.maximum(high - low + 1, 0)
        which = np.repeat(np.arange(len(edges)), count)
        row = low[which] + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        span = line[which, 1] - line[which, 0]
        share = (row + 0.5 - line[which, 0]) / np.where(np.abs(span) < 1e-9, 1e-9, span)
        # The perspective depth of the crossing: 1 / z is linear in the picture.
        place = along[which, 0] + share * (along[which, 1] - along[which, 0])
        deep = 1.0 / ((1.0 - share) / depth[which, 0] + share / depth[which, 1])
        before = np.floor(place - 0.5).astype(int)
        kept = (before >= 0) & (before + 1 < places)
        which, row, place, deep, before = (x[kept] for x in (which, row, place, deep, before))
        flat = (row * width + before) if axis == 0 else (before * width + row)
        step = 1 if axis == 0 else width
        surface = hits.depth.ravel()
        one, other = surface[flat], surface[flat + step]
        forth = (one <= deep + NEAR_MM) & (other > deep + NEAR_MM)
        back = (other <= deep + NEAR_MM) & (one > deep + NEAR_MM)
        use = np.nonzero(forth ^ back)[0]
        sign = np.where(forth[use], 1, -1)
        # Of several edges the one farthest out decides.
        order = np.lexsort((-sign * place[use], flat[use]))
        first = np.unique(flat[use][order], return_index=True)[1]
        use, sign = use[order][first], sign[order][first]
        near = flat[use] + np.where(sign > 0, 0, step)
        return near, near + sign * step, edges[which[use]], np.full(len(use), axis), sign

    def crossing(self, vertices: torch.Tensor, camera_from_head: np.ndarray, pairs: Pairs) -> torch.Tensor:
        """[N] how far from the near pixel's centre towards the far one's the edge lies, 0 .. 1; differentiable."""
        rotation, shift = self._tensor(camera_from_head[:3, :3]), self._tensor(camera_from_head[:3, 3])
        edge = torch.from_numpy(pairs.edge.astype(np.int64))
        seen = vertices[edge] @ rotation.T + shift
        lens = self._tensor(self.intrinsics)
        pixels = seen[..., :2] / seen[..., 2:] * torch.stack([lens[0, 0], lens[1, 1]]) + lens[:2, 2]
        axis = torch.from_numpy(pairs.axis)
        along = torch.where(axis[:, None] == 0, pixels[..., 0], pixels[..., 1])
        line = torch.where(axis[:, None] == 0, pixels[..., 1], pixels[..., 0])
        width = self.size[0]
        centre = np.stack([pairs.near % width, pairs.near // width], axis=1) + 0.5
        own, row = (self._tensor(np.take_along_axis(centre, k[:, None], 1)[:, 0]) for k in (pairs.axis, 1 - pairs.axis))
        span = line[:, 1] - line[:, 0]
        share = (row - line[:, 0]) / torch.where(span.abs() < 1e-9, torch.full_like(span, 1e-9), span)
        place = along[:, 0] + share * (along[:, 1] - along[:, 0])
        return ((place - own) * self._tensor(pairs.sign)).clamp(0.0, 1.0)


def blend(values: torch.Tensor, near: torch.Tensor, far: torch.Tensor, crossing: torch.Tensor) -> torch.Tensor:
    """Antialiases values [M, C]: rows near [N] and far [N] of each pair take from each other by the crossing [N]."""
    reach = (crossing - 0.5)[:, None]
    change = reach * (values[near] - values[far])
    outwards = (reach > 0).to(values.dtype)
    return values.index_add(0, far, outwards * change).index_add(0, near, (1.0 - outwards) * change)
