"""Dense skin tracks: where each patch of skin lies in each frame, to a tenth of a pixel.

Landmark networks slide over the skin as the head turns. Here every frame is warped into the layout of a reference frame
by a surface that is roughly right (first the landmarks' triangulation, then the fitted head), so that what remains is a
small motion, found by dense inverse search flow on images of log local contrast: those show skin, not light.

References: [Kroeger2016] (dense inverse search); [Kalal2010] (the forward-backward check).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import Delaunay

from shared.compute.parallel import in_order
from shared.geometry.atlas import sample
from shared.geometry.mesh import interpolate, normalised
from shared.geometry.raycast import RayScene, camera_hits
from shared.geometry.transforms import camera_centres

LEAST_SHOWN = 20
"""A frame that shows fewer of the grid's points is not tracked."""


@dataclass(frozen=True)
class SurfaceGrid:
    """A reference frame's pixels on a surface: corners [h, w, 3] vertex indices, bary [h, w, 3], valid [h, w] bool.

    scale: grid pixels per image pixel.
    """

    reference: int
    corners: np.ndarray
    bary: np.ndarray
    valid: np.ndarray
    scale: float

    def warp(self, values: np.ndarray) -> np.ndarray:
        """Vertex values [V, C] -> [h, w, C] float32, rounded once: sums in single precision end differently by the
        processor, and 8-bit pictures sampled there then differ by a code."""
        columns = values.astype(np.float64).T.copy()
        warped = [sum(column.take(corner) * weight for corner, weight in self._corner_planes) for column in columns]
        return np.stack(warped, axis=-1).astype(np.float32)

    @cached_property
    def _corner_planes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Vertex index [h, w] and weight [h, w] of each corner."""
        return [(self.corners[..., k].copy(), self.bary[..., k].astype(np.float64)) for k in range(3)]


def grid_from_landmarks(landmarks_px: np.ndarray, reference: int, scale: float) -> SurfaceGrid:
    """The reference frame's landmarks [468, 2], triangulated, as a surface. scale: pixels of the grid per pixel of
    the picture."""
    triangles = Delaunay(landmarks_px)
    low, high = np.floor(landmarks_px.min(0)), np.ceil(landmarks_px.max(0))
    x, y = np.meshgrid(np.arange(low[0], high[0], 1 / scale), np.arange(low[1], high[1], 1 / scale))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    simplex = triangles.find_simplex(points)
    affine = triangles.transform[simplex]
    first = np.einsum("nij,nj->ni", affine[:, :2], points - affine[:, 2])
    bary = np.concatenate([first, 1.0 - first.sum(1, keepdims=True)], axis=1)
    corners = triangles.simplices[simplex]
    shape = x.shape
    return SurfaceGrid(
        reference,
        corners.reshape(shape + (3,)),
        bary.reshape(shape + (3,)).astype(np.float32),
        (simplex >= 0).reshape(shape),
        scale,
    )


def grid_from_mesh(
    scene: RayScene,
    faces: np.ndarray,
    usable_face: np.ndarray,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    box: np.ndarray,
    reference: int,
    scale: float,
) -> SurfaceGrid:
    """What the reference camera [4, 4] sees of the mesh within box (x0, y0, x1, y1 px); usable_face [F] bool. box
    [4] px. scale: pixels of the grid per pixel of the picture."""
    zoomed = np.array(intrinsics, np.float64)
    zoomed[:2] *= scale
    zoomed[:2, 2] -= np.asarray(box[:2]) * scale
    width, height = (np.ceil((box[2:] - box[:2]) * scale)).astype(int)
    face, bary, _ = camera_hits(scene, camera_from_head, zoomed, width, height)
    valid = (face >= 0) & usable_face[np.maximum(face, 0)]
    return SurfaceGrid(reference, faces[np.maximum(face, 0)], bary, valid, scale)


def visible_vertices(
    scene: RayScene, vertices: np.ndarray, normals: np.ndarray, camera_from_head: np.ndarray, least_cosine: float
) -> np.ndarray:
    """[V] bool: faces the camera [4, 4] by at least least_cosine, and nothing of the scene stands between."""
    towards = normalised(camera_centres(camera_from_head) - vertices)
    seen = (normals * towards).sum(1) > least_cosine
    index = np.nonzero(seen)[0]
    seen[index] = ~scene.occluded(vertices[index] + 0.3 * normals[index], towards[index])
    return seen


def dense_tracks(
    grid: SurfaceGrid,
    contrast: list[np.ndarray],
    unusable: list[np.ndarray],
    positions_px: np.ndarray,
    visible: np.ndarray,
    *,
    count: int,
    search_px: float,
    progress=iter,
) -> tuple[np.ndarray, np.ndarray]:
    """Tracks of about `count` grid points of the reference through all frames.

    contrast, unusable: F images [H, W]; positions_px [F, V, 2] where the surface's vertices are believed to be;
    visible [F, V] bool. search_px: the largest believed error. -> tracks [F, N, 2] px (NaN: not found) and the points'
    (row, column) in the grid [N, 2].
    """
    rows, columns = _grid_points(grid, count)
    tracks = np.full((len(contrast), len(rows), 2), np.nan)
    layout = grid.warp(positions_px[grid.reference])
    layout[~grid.valid] = -9.0
    target = sample(contrast[grid.reference], layout)
    usable = (sample(unusable[grid.reference], layout, cv2.INTER_NEAREST) == 0) & grid.valid
    place = _Places(rows, columns, usable[rows, columns], search_px)

    def track(i: int) -> np.ndarray:
        shown = grid.valid & (grid.warp(visible[i].astype(np.float32)[:, None])[..., 0] > 0.99)
        return _track_frame(grid, target, contrast[i], unusable[i], grid.warp(positions_px[i]), shown, place)

    for i, found in enumerate(in_order(track, progress(range(len(contrast))))):
        tracks[i] = found
    return tracks, np.stack([rows, columns], axis=1)


@dataclass(frozen=True)
class _Places:
    """Grid points to track: row and column [N], usable in the reference [N] bool, the largest believed error."""

    rows: np.ndarray
    columns: np.ndarray
    usable: np.ndarray
    search_px: float


def _track_frame(grid, target, contrast, unusable, layout, shown, place: _Places) -> np.ndarray:
    """Positions [N, 2] of the grid's points in one frame, NaN: not found; layout [h, w, 2] is where they should be."""
    rows, columns = place.rows, place.columns
    found = np.full((len(rows), 2), np.nan)
    if shown[rows, columns].sum() < LEAST_SHOWN:
        return found
    layout[~shown] = -9.0
    image = sample(contrast, layout)
    image[~shown] = 128
    masked = np.where(shown, target, 128).astype(np.uint8)
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    forward, backward = flow.calc(masked, image, None), flow.calc(image, masked, None)
    moved = forward[rows, columns]
    at = np.stack([columns, rows], axis=1).astype(np.float32) + moved
    good = np.linalg.norm(moved + _lookup(backward, at), axis=1) < 0.3 * grid.scale
    good &= np.linalg.norm(moved, axis=1) < place.search_px * grid.scale
    good &= place.usable & shown[rows, columns]
    reached = _lookup(layout, at)
    good &= (sample(unusable, reached[:, None], cv2.INTER_NEAREST)[:, 0] == 0) & (reached.min(1) > 0)
    found[good] = reached[good]
    return found


def _grid_points(grid: SurfaceGrid, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Evenly spaced grid points well inside the valid region."""
    margin = max(3, int(round(4 * grid.scale)))
    inside = cv2.erode(np.pad(grid.valid.astype(np.uint8), 1), np.ones((2 * margin + 1,) * 2, np.uint8))[1:-1, 1:-1]
    step = max(2, int(np.sqrt(inside.sum() / max(count, 1))))
    rows, columns = np.mgrid[step // 2 : inside.shape[0] : step, step // 2 : inside.shape[1] : step]
    chosen = inside[rows, columns] > 0
    return rows[chosen], columns[chosen]


def _lookup(field: np.ndarray, at: np.ndarray) -> np.ndarray:
    """A field [h, w, 2] interpolated at integer-centred positions [N, 2] -> [N, 2]."""
    x, y = at[:, :1], at[:, 1:]
    return np.stack(
        [cv2.remap(np.ascontiguousarray(field[..., k]), x, y, cv2.INTER_LINEAR)[:, 0] for k in (0, 1)], axis=1
    )


def points_on_grid(grid: SurfaceGrid, where: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """The surface's points [N, 3] at grid places, where [N, 2] (row, column)."""
    corners = grid.corners[where[:, 0], where[:, 1]]
    return interpolate(vertices, corners, np.arange(len(corners)), grid.bary[where[:, 0], where[:, 1]])
