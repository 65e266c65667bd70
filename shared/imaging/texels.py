"""A texture map as points on the surface: sampling frames at texels, filling what no frame shows, and gutters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from scipy.ndimage import distance_transform_edt

from shared.compute.compiled import compiled
from shared.compute.sparse_solve import Factors, factorised, solved_by_factors_of_another
from shared.compute.threads import share_out
from shared.geometry.mesh import Mesh, rasterize_uv, vertex_adjacency
from shared.imaging.image_sampling import Picture, View, sample_colours, sample_inside, sample_saturation, texel_size

_BLOCK = 1 << 16
_ACCURACY = 1e-6
"""Of smooth fields, relative: what maps in half precision show is a thousandth."""


@dataclass(frozen=True)
class TexelSamples:
    """One frame at the texels rows [n] (indices into TexelSurface): colours [n, 3], weight [n], saturation int8 [n,
    3]."""

    rows: np.ndarray
    colours: np.ndarray
    weight: np.ndarray
    saturation: np.ndarray


@dataclass(frozen=True)
class MovedTexels:
    """Texels rows [k], growing, that a frame shows at other places than their own: on faces face [k] with corner
    weights bary [k, 3], and what a FrameView's table is there, values [k, 4 + C]."""

    rows: np.ndarray
    face: np.ndarray
    bary: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class FrameView:
    """A frame before it is sampled: rows [n] of the texels that it shows, table [V, 4 + C] of what is linear on the
    surface (pixel times depth, depth, weight, C values of the caller's), the picture and its saturation bounds as
    float32; moved: texels that lie elsewhere on the surface than in the map; None: none do."""

    rows: np.ndarray
    table: np.ndarray
    picture: Picture
    saturation: np.ndarray
    focal_length: np.float32
    moved: MovedTexels | None = None

    def blocks(self) -> list[np.ndarray]:
        """The rows, cut where what a block needs no longer fits the processor's cache."""
        return [self.rows[start : start + _BLOCK] for start in range(0, len(self.rows), _BLOCK)]


def nearest_shown(shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] bool -> places [n] of an image, row by row, where nothing is shown, and of each the nearest one where
    something is [n]."""
    empty = np.nonzero(~shown.ravel())[0]
    if len(empty) == 0:
        return empty, empty
    rows, columns = distance_transform_edt(~shown, return_distances=False, return_indices=True)
    return empty, rows.ravel()[empty] * np.int64(shown.shape[1]) + columns.ravel()[empty]


class TexelSurface:
    """The T texels of a size x size map that lie on the mesh: face [T], bary [T, 3]."""

    def __init__(self, mesh: Mesh, size: int):
        self.mesh, self.size = mesh, size
        face, bary = rasterize_uv(mesh, size)
        self.pixel = np.nonzero(face.ravel() >= 0)[0]
        self.face, self.bary = face.ravel()[self.pixel], bary.reshape(-1, 3)[self.pixel]
        self._corners = np.ascontiguousarray(mesh.faces[self.face], np.int32)
        self._texel_mm = texel_size(mesh, size).astype(np.float32)[self.face]

    def __len__(self) -> int:
        return len(self.pixel)

    def typical_texel_mm(self) -> float:
        """Median edge of a texel on the surface, mm."""
        return float(np.median(self._texel_mm))

    def interpolate(self, values: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Vertex values [V, C] at some texels, None: at all -> [n, C] float32. rows [n] int: numbers of texels."""
        rows = np.arange(len(self)) if rows is None else rows
        found = np.empty((len(rows), values.shape[1]), np.float32)
        _interpolate(self._corners, self.bary, rows, np.ascontiguousarray(values, np.float32), found)
        return found

    def to_image(self, values: np.ndarray, elsewhere: float = 0.0) -> np.ndarray:
        """[T, ...] -> [size, size, ...]. elsewhere: the value of all other texels."""
        image = np.full((self.size**2,) + values.shape[1:], elsewhere, values.dtype)
        image[self.pixel] = values
        return image.reshape((self.size, self.size) + values.shape[1:])

    def dilated(self, image: np.ndarray) -> np.ndarray:
        """The gutters around the charts take the nearest texel's value, so that filtering never reads background.
        image [size, size, ...]."""
        empty, nearest = self._gutters
        filled = image.copy()
        filled.reshape((-1,) + image.shape[2:])[empty] = image.reshape((-1,) + image.shape[2:])[nearest]
        return filled

    @cached_property
    def _gutters(self) -> tuple[np.ndarray, np.ndarray]:
        """Places in the image where nothing lies, and of each the nearest one where something does."""
        shown = np.zeros((self.size, self.size), bool)
        shown.ravel()[self.pixel] = True
        return nearest_shown(shown)

    def frame_view(
        self, view: View, picture: Picture, intrinsics: np.ndarray, values: np.ndarray | None = None
    ) -> FrameView:
        """What one frame shows; a face counts as seen when all its corners are. values [V, C]: to interpolate at the
        samples."""
        seen_face = np.empty(len(self.mesh.faces), bool)
        _faces_seen(self.mesh.faces, view.weight, seen_face)
        # Depth times pixel is linear on the surface; the pixel itself is not.
        depth = view.depth[:, None]
        columns = [view.pixels * depth, depth, view.weight[:, None]] + ([] if values is None else [values])
        table = np.concatenate(columns, axis=1, dtype=np.float32, casting="same_kind")
        rows, saturation = np.nonzero(seen_face[self.face])[0], picture.saturation.astype(np.float32)
        return FrameView(rows, table, picture, saturation, np.float32(intrinsics[0, 0]))

    def samples(self, frame: FrameView, rows: np.ndarray | None = None) -> tuple[TexelSamples, np.ndarray]:
        """What the frame shows of some of its rows [n], None: of all -> samples, and its values at them [n, C]."""
        rows = frame.rows if rows is None else rows
        found = self.interpolate(frame.table, rows)
        if frame.moved is not None:
            _, here, there = np.intersect1d(rows, frame.moved.rows, assume_unique=True, return_indices=True)
            found[here] = frame.moved.values[there]
        pixels, footprint = np.empty((len(rows), 2), np.float32), np.empty(len(rows), np.float32)
        _project(found, self._texel_mm, rows, frame.focal_length, pixels, footprint)
        weight = found[:, 3] * sample_inside(frame.picture, pixels)
        colours = sample_colours(frame.picture, pixels, footprint)
        return TexelSamples(rows, colours, weight, sample_saturation(frame.saturation, pixels)), found[:, 4:]

    def to_vertices(self, values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted means of texel values [T, C] around each vertex; weight [T, C] -> means and total weights [V, C]."""
        sums, total = np.zeros((2, len(self.mesh.vertices), values.shape[1]))
        _scatter(self._corners, self.bary, values, weight, sums, total)
        return sums / np.maximum(total, 1e-12), total


class SmoothFields:
    """Fields that are smooth over a mesh, through what is known at its vertices.

    Gaussian Markov field: neighbours differ by step, and a vertex from the mean by spread, both standard deviations.
    Where nothing is known it continues its surroundings and sinks to the mean. Works across texture seams, which a fill
    in the image cannot. region [V]: neighbours in different ones have nothing in common. Reference: [Rue2005],
    section 3.

    The first precisions are factorised, each vertex's mean over the channels, and serve all that come later.
    """

    def __init__(self, mesh: Mesh, step: float, spread: float, region: np.ndarray | None = None):
        count = len(mesh.vertices)
        adjacency = vertex_adjacency(mesh.faces, count).tocoo()
        if region is not None:
            adjacency.data = adjacency.data * (region[adjacency.row] == region[adjacency.col])
        graph = sparse.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency
        self._least = 1.0 / spread**2
        self._prior = (graph / step**2 + sparse.identity(count) * self._least).tocsr()
        self._factors: Factors | None = None

    def through(self, values: np.ndarray, precision: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Most likely vertex values [V, C, ...], given values [V, C, ...] of some precision [V, C]; mean [C]."""
        if self._factors is None:
            typical = np.exp(np.log(precision + self._least).mean(1)) - self._least
            self._factors = factorised((self._prior + sparse.diags(typical)).astype(np.float32))
        factors, count = self._factors, len(values)

        def solved(c: int) -> np.ndarray:
            known = precision[:, c]
            right = (values[:, c].reshape(count, -1).T * known + mean[c] * self._least).T
            return solved_by_factors_of_another(self._prior + sparse.diags(known), right, factors, _ACCURACY)

        channels = share_out(values.shape[1], solved)
        return np.stack([channel.reshape(values[:, 0].shape) for channel in channels], axis=1)


@compiled
def _interpolate(corners, weights, rows, table, found):
    for i in range(len(rows)):
        a, b, c = corners[rows[i]]
        u, v, w = weights[rows[i]]
        for k in range(table.shape[1]):
            found[i, k] = u * table[a, k] + v * table[b, k] + w * table[c, k]


@compiled
def _faces_seen(faces, weight, seen):
    for f in range(len(faces)):
        seen[f] = weight[faces[f, 0]] > 0 and weight[faces[f, 1]] > 0 and weight[faces[f, 2]] > 0


@compiled
def _project(found, texel_mm, rows, focal_length, pixels, footprint):
    for i in range(len(rows)):
        nearness = np.float32(1.0) / found[i, 2]
        pixels[i, 0], pixels[i, 1] = found[i, 0] * nearness, found[i, 1] * nearness
        footprint[i] = texel_mm[rows[i]] * focal_length * nearness


@compiled
def _scatter(corners, weights, values, precision, sums, total):
    for t in range(len(corners)):
        for k in range(3):
            vertex, share = corners[t, k], weights[t, k]
            for c in range(values.shape[1]):
                part = np.float64(share) * precision[t, c]
                total[vertex, c] += part
                sums[vertex, c] += part * values[t, c]
