"""A texture map as points on the surface: sampling frames at texels, filling what no frame shows, and gutters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.ndimage import distance_transform_edt
from scipy.sparse.linalg import splu

from shared.gather import Picture, View, sample_colours, sample_inside, sample_limits, texel_size
from shared.mesh import Mesh, rasterize_uv, vertex_adjacency


@dataclass(frozen=True)
class TexelSamples:
    """One frame at the texels rows [n] (indices into TexelSurface): colours [n, 3], weight [n], limits int8 [n, 3]."""

    rows: np.ndarray
    colours: np.ndarray
    weight: np.ndarray
    limits: np.ndarray


class TexelSurface:
    """The T texels of a size x size map that lie on the mesh: face [T], bary [T, 3]."""

    def __init__(self, mesh: Mesh, size: int):
        self.mesh, self.size = mesh, size
        face, bary = rasterize_uv(mesh, size)
        # Faces without area in the layout give no corner weights.
        self.pixel = np.nonzero((face >= 0).ravel() & np.isfinite(bary).all(-1).ravel())[0]
        self.face, self.bary = face.ravel()[self.pixel], bary.reshape(-1, 3)[self.pixel]
        self._corners = torch.from_numpy(np.ascontiguousarray(mesh.faces[self.face], np.int32))
        self._corner_weights = torch.from_numpy(np.ascontiguousarray(self.bary, np.float32))
        self._texel_mm = texel_size(mesh, size).astype(np.float32)[self.face]

    def __len__(self) -> int:
        return len(self.pixel)

    def typical_texel_mm(self) -> float:
        """Median edge of a texel on the surface, mm."""
        return float(np.median(self._texel_mm))

    def interpolate(self, values: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Vertex values [V, C] at some texels -> [n, C] float32."""
        table = torch.from_numpy(np.ascontiguousarray(values, np.float32))
        chosen = rows if isinstance(rows, slice) else torch.from_numpy(rows)
        corners, weights = self._corners[chosen], self._corner_weights[chosen]
        return torch.nn.functional.embedding_bag(corners, table, per_sample_weights=weights, mode="sum").numpy()

    def to_image(self, values: np.ndarray, elsewhere: float = 0.0) -> np.ndarray:
        """[T, ...] -> [size, size, ...]."""
        image = np.full((self.size**2,) + values.shape[1:], elsewhere, values.dtype)
        image[self.pixel] = values
        return image.reshape((self.size, self.size) + values.shape[1:])

    def dilated(self, image: np.ndarray) -> np.ndarray:
        """The gutters around the charts take the nearest texel's value, so that filtering never reads background."""
        empty = np.ones((self.size, self.size), bool)
        empty.ravel()[self.pixel] = False
        if not empty.any():
            return image
        rows, columns = distance_transform_edt(empty, return_distances=False, return_indices=True)
        return image[rows, columns]

    def samples(
        self, view: View, picture: Picture, intrinsics: np.ndarray, shade: np.ndarray | None = None
    ) -> tuple[TexelSamples, np.ndarray]:
        """What one frame shows of the texels; a face counts as seen when all its corners are.

        shade [V, C]: vertex values to interpolate on the way -> samples, and shade at them [n, C] (C = 0 without).
        """
        seen_face = (view.weight > 0)[self.mesh.faces].all(1)
        rows = np.nonzero(seen_face[self.face])[0]
        # Depth times pixel is linear on the surface; the pixel itself is not.
        depth = view.depth[:, None]
        columns = [view.pixels * depth, depth, view.weight[:, None]] + ([] if shade is None else [shade])
        found = self.interpolate(np.concatenate(columns, axis=1), rows)
        pixels = found[:, :2] / found[:, 2:3]
        footprint = self._texel_mm[rows] * np.float32(intrinsics[0, 0]) / found[:, 2]
        weight = found[:, 3] * sample_inside(picture, pixels)
        colours = sample_colours(picture, pixels, footprint)
        return TexelSamples(rows, colours, weight, sample_limits(picture, pixels)), found[:, 4:]

    def to_vertices(self, values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted means of texel values [T, C, ...] around each vertex; weight [T, C] -> means [V, C, ...] and total
        weights [V, C]."""
        shape = (len(self.mesh.vertices), len(self))
        entries = self.mesh.faces[self.face].ravel(), np.repeat(np.arange(len(self)), 3)
        gather = sparse.csr_matrix((self.bary.ravel(), entries), shape)
        total = gather @ weight
        spread = weight.reshape(weight.shape + (1,) * (values.ndim - 2))
        sums = (gather @ (spread * values).reshape(len(self), -1)).reshape(shape[:1] + values.shape[1:])
        return sums / np.maximum(total, 1e-12).reshape(total.shape + (1,) * (values.ndim - 2)), total


def smooth_field(
    mesh: Mesh,
    values: np.ndarray,
    precision: np.ndarray,
    mean: np.ndarray,
    step: float,
    spread: float,
    region: np.ndarray | None = None,
) -> np.ndarray:
    """Most likely vertex values [V, C, ...] of fields that are smooth over the mesh, given values [V, C, ...] of some
    precision [V, C].

    Gaussian Markov field: neighbours differ by step, and a vertex from the mean [C] by spread, both standard
    deviations. Where nothing is known it continues its surroundings and sinks to the mean. Works across texture seams,
    which a fill in the image cannot. region [V]: neighbours in different ones have nothing in common. Reference: Rue
    and Held, Gaussian Markov Random Fields, 2005, section 3.
    """
    count = len(mesh.vertices)
    adjacency = vertex_adjacency(mesh.faces, count).tocoo()
    if region is not None:
        adjacency.data = adjacency.data * (region[adjacency.row] == region[adjacency.col])
    graph = sparse.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency
    prior = graph / step**2 + sparse.identity(count) / spread**2
    result = np.empty(values.shape)
    for c, known in enumerate(precision.T):
        right = (values[:, c].reshape(count, -1).T * known + mean[c] / spread**2).T
        solved = splu((prior + sparse.diags(known)).tocsc()).solve(right)
        result[:, c] = solved.reshape(result[:, c].shape)
    return result
