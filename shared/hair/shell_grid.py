"""Hair as a height over the head: rays that leave it at grid places, along which a shell lies so far out.

Rows run from the crown down: over rays from a centre within the skull at first, then over horizontal rays from the
vertical line through it, as hair hangs. Columns run around, from the front towards the head's left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from shared.compute.sparse_solve import factorised
from shared.geometry.mesh import Mesh, normalised
from shared.geometry.raycast import RayScene

COLUMNS, STEP_DEG, STEP_MM = 144, 2.5, 3.5
EQUATOR_DEG = 90.0
FAR_MM = 450.0
NEAREST_MM = 15.0
"""To the axis: nothing of a head's or neck's outside is nearer."""
RIM_MM = 8.0
"""Above the lower end of the head's mesh, from where on its radius goes on as it is."""
NARROWEST = 0.08
"""Sine of the polar angle from which on neighbours in a row count as that far apart."""
STRETCHING, LEAST_KNOWN = 0.01, 1e-6
"""Weights of a change from place to place, and of 0 where nothing is known."""


@dataclass(frozen=True, eq=False)
class ShellGrid:
    """centre [3] mm: within the skull; centres, rays [R, C, 3] mm and unit; base [R, C] mm along the ray: to the
    outermost surface of the head without its ears, evened out; domed: how many of the rows leave from the centre."""

    centre: np.ndarray
    centres: np.ndarray
    rays: np.ndarray
    base: np.ndarray
    domed: int

    @classmethod
    def about(cls, scene: RayScene, ears: np.ndarray, centre: np.ndarray, lowest_mm: float) -> ShellGrid:
        """About the head of a scene, whose middle is centre [3] mm, down to a height; ears [F] bool: its faces that
        hair may press flat."""
        azimuth = 2.0 * np.pi * np.arange(COLUMNS) / COLUMNS
        around = np.stack([np.sin(azimuth), 0.0 * azimuth, np.cos(azimuth)], -1)
        polar = np.radians(np.arange(0.0, EQUATOR_DEG + 1e-6, STEP_DEG))
        dome = np.sin(polar)[:, None, None] * around + np.cos(polar)[:, None, None] * [0.0, 1.0, 0.0]
        heights = np.arange(centre[1] - STEP_MM, lowest_mm, -STEP_MM)
        rays = np.concatenate([dome, np.broadcast_to(around, (len(heights), *around.shape))])
        centres = np.broadcast_to(centre, rays.shape).copy()
        centres[len(polar):, :, 1] = heights[:, None]
        bare = cls(centre, centres, rays, np.zeros(rays.shape[:2]), len(polar))
        return replace(bare, base=bare._outermost(scene, ears))

    @property
    def columns(self) -> int:
        """C, how many there are."""
        return self.rays.shape[1]

    def at(self, radius: np.ndarray) -> np.ndarray:
        """[R, C, 3] mm: places so far along the rays, radius [R, C]."""
        return self.centres + radius[..., None] * self.rays

    def normals(self, radius: np.ndarray) -> np.ndarray:
        """[R, C, 3] unit, outwards, of the surface at a radius [R, C]."""
        places = self.at(radius)
        across = np.roll(places, -1, 1) - np.roll(places, 1, 1)
        found = normalised(np.cross(np.gradient(places, axis=0), across))
        found[0] = [0.0, 1.0, 0.0]
        return found

    def mesh(self, radius: np.ndarray) -> Mesh:
        """The shell at a radius [R, C]: vertex 0 the crown, then row after row; u around, v from the crown down."""
        places = self.at(radius)
        rows, columns = radius.shape
        vertices = np.concatenate([places[:1, :1].reshape(1, 3), places[1:].reshape(-1, 3)])
        row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")

        def number(r: np.ndarray, c: np.ndarray) -> np.ndarray:
            return np.where(r == 0, 0, 1 + (r - 1) * columns + c % columns)

        def texture(r: np.ndarray, c: np.ndarray) -> np.ndarray:
            return r * (columns + 1) + c

        faces, face_uvs = (
            np.stack([np.stack([of(row, column), of(row + 1, column), of(row + 1, column + 1)], -1),
                      np.stack([of(row, column), of(row + 1, column + 1), of(row, column + 1)], -1)], 2)
            for of in (number, texture))
        some = np.ones(faces.shape[:3], bool)
        some[0, :, 1] = False  # at the crown both upper corners are one
        v, u = np.meshgrid(1.0 - np.arange(rows) / (rows - 1), np.arange(columns + 1) / columns, indexing="ij")
        margin = 0.002
        uvs = margin + (1.0 - 2.0 * margin) * np.stack([u, v], -1).reshape(-1, 2)
        return Mesh(vertices, faces[some].astype(np.int32), uvs, face_uvs[some].astype(np.int32))

    def of_vertices(self, values: np.ndarray) -> np.ndarray:
        """What values [R, C] are at the mesh's vertices [V]."""
        return np.concatenate([values[0, :1], values[1:].ravel()])

    def of_grid(self, values: np.ndarray) -> np.ndarray:
        """What values [V] of the mesh's vertices are on the grid [R, C]."""
        return np.concatenate([np.repeat(values[0], self.base.shape[1]), values[1:]]).reshape(self.base.shape)

    def smoothest(self, values: np.ndarray, known: np.ndarray, bending: float, around: float = 1.0, down: float = 1.0
                  ) -> np.ndarray:
        """[R, C] that bends least, and varies little, near values [R, C] as far as these are known [R, C]; bending:
        weight of that beside what is known; around, down: how much changes count along a row and from row to row."""
        rows, columns = values.shape
        index = np.arange(rows * columns).reshape(rows, columns)
        sine = np.linalg.norm(self.rays[:, 0, [0, 2]], axis=1)
        near = np.repeat(around / np.maximum(sine, NARROWEST), columns)
        along = sparse.diags(near) @ _differences(index.ravel(), np.roll(index, -1, 1).ravel(), rows * columns)
        below = down * _differences(index[:-1].ravel(), index[1:].ravel(), rows * columns)
        stiff = along.T @ along + below.T @ below
        matrix = bending * stiff @ stiff + STRETCHING * stiff + sparse.diags(known.ravel() + LEAST_KNOWN)
        return factorised(matrix).solve((known * values).ravel()).reshape(rows, columns)

    def locate(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places [N, 3] mm -> fractional row and column [N], and mm along the ray there [N]."""
        away = places - self.centre
        azimuth = np.arctan2(away[:, 0], away[:, 2]) % (2.0 * np.pi)
        flat = np.linalg.norm(away[:, [0, 2]], axis=1)
        row = np.degrees(np.arctan2(flat, away[:, 1])) / STEP_DEG
        heights = self.centres[self.domed:, 0, 1]
        hangs = places[:, 1] < self.centre[1]
        row = np.where(hangs, self.domed + (heights[0] - places[:, 1]) / STEP_MM, row)
        radius = np.where(hangs, flat, np.linalg.norm(away, axis=1))
        return np.minimum(row, len(self.base) - 1.0), azimuth / (2.0 * np.pi) * self.columns, radius

    def read(self, values: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """[N]: what values [R, C] are at fractional places row [N] and column [N]."""
        return map_coordinates(np.concatenate([values, values[:, :1]], 1), [row, column], order=1, mode="nearest")

    def _outermost(self, scene: RayScene, ears: np.ndarray) -> np.ndarray:
        """[R, C] mm; below the mesh as at its lower end, and where an ear is as around it."""
        starts = (self.centres + FAR_MM * self.rays).reshape(-1, 3)
        face, _, distance = scene.intersect(starts, -self.rays.reshape(-1, 3))
        shape = self.rays.shape[:2]
        radius, ear = (FAR_MM - distance).reshape(shape), ((face >= 0) & ears[face]).reshape(shape)
        lowest = scene.vertices[:, 1].min() + RIM_MM
        for row in range(1, len(radius)):
            below = row >= self.domed and self.centres[row, 0, 1] < lowest
            met = np.isfinite(radius[row]) & (radius[row] > NEAREST_MM) & ~below  # else: the inside of the other side
            radius[row] = np.where(met, radius[row], radius[row - 1])
        ear = maximum_filter(ear, 5, mode=("nearest", "wrap"))
        radius = np.where(ear, self.smoothest(radius, np.where(ear, 0.0, 1.0), 0.1), radius)
        return gaussian_filter(radius, 1.0, mode=("nearest", "wrap"))


def _differences(first: np.ndarray, second: np.ndarray, count: int) -> sparse.csr_matrix:
    """[N], [N] indices -> [N, count]: first minus second."""
    row = np.arange(len(first))
    values = np.concatenate([np.ones(len(first)), -np.ones(len(first))])
    at = np.concatenate([row, row]), np.concatenate([first, second])
    return sparse.coo_matrix((values, at), shape=(len(first), count)).tocsr()
