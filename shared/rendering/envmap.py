"""Environment maps: cubemap in memory, lat-long on disk, and look-ups as sparse matrices.

A cubemap is a flat array [6 n^2, ...] of texels, faces +x -x +y -y +z -z, rows from the top of each face. Looking it
up is linear, so the values at many directions are one sparse matrix times the texels: that matrix, its transpose and
its weights are all the light solver needs. The bilinear look-up crosses face borders without a seam.

Lat-long images follow the OpenEXR and USD dome-light layout: pixel (u, v) in [0, 1) looks along
(sin 2 pi u sin pi v, cos pi v, -cos 2 pi u sin pi v), so +y is the top row and +z the centre.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse

# Columns: right, down and outward axis of each face as seen from inside the cube.
_FACE_AXES = np.array(
    [
        [[0, 0, -1], [0, -1, 0], [1, 0, 0]],
        [[0, 0, 1], [0, -1, 0], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, -1, 0], [0, 0, -1]],
    ],
    np.float64,
)
# The same as coordinate and sign: each axis of a face is one of the three, forwards or backwards.
_COORDINATE, _SIGN = np.abs(_FACE_AXES).argmax(-1), _FACE_AXES.sum(-1)

LAMP_REACH, LAMP_SHARE = np.radians(30.0), 0.1
"""Texels so near to the brightest, and so bright beside it, belong to its lamp."""


def cube_directions(resolution: int) -> np.ndarray:
    """[6 n^2, 3] unit directions of the texel centres."""
    centres = (np.arange(resolution) + 0.5) / resolution * 2.0 - 1.0
    down, right = np.meshgrid(centres, centres, indexing="ij")
    local = np.stack([right, down, np.ones_like(right)], axis=-1).reshape(-1, 3)
    directions = (local @ _FACE_AXES).reshape(-1, 3)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def cube_solid_angles(resolution: int) -> np.ndarray:
    """[6 n^2] exact solid angles of the texels; they sum to 4 pi.

    A corner's share of its face is atan(x y / sqrt(x^2 + y^2 + 1)); a texel is the alternating sum of its corners.
    """
    edge = np.linspace(-1.0, 1.0, resolution + 1)
    x, y = np.meshgrid(edge, edge)
    corner = np.arctan2(x * y, np.sqrt(x * x + y * y + 1.0))
    return np.tile(np.diff(np.diff(corner, axis=0), axis=1).ravel(), 6)


def lamp_texels(light: np.ndarray) -> np.ndarray:
    """[6 n^2] bool: the brightest texel of a cubemap, light [6 n^2, 3] linear, and those around it that are of its
    lamp."""
    directions, brightness = cube_directions(cube_resolution(light)), light.mean(1)
    brightest = brightness.argmax()
    near = directions @ directions[brightest] > np.cos(LAMP_REACH)
    return near & (brightness > LAMP_SHARE * brightness[brightest])


def lamp_solid_angle(light: np.ndarray, texels: np.ndarray) -> float:
    """sr, of the disc of one radiance that gives both the irradiance and the integral of the squared radiance that some
    texels [K] of a cubemap, light [6 n^2, 3] linear, give: E^2 / integral of L^2."""
    solid, radiance = cube_solid_angles(cube_resolution(light))[texels], light[texels].mean(1)
    return float((radiance @ solid) ** 2 / (radiance**2 @ solid))


def cube_resolution(cube: np.ndarray) -> int:
    """n of a cubemap, cube [6 n^2, ...]."""
    return round((len(cube) / 6) ** 0.5)


def cube_face_coordinates(directions: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[M, 3] -> face [M], column and row [M] in texels (centres at integer + 0.5)."""
    d = np.asarray(directions, np.float64)
    axis = np.abs(d).argmax(1)
    index = np.arange(len(d))
    face = 2 * axis + (d[index, axis] < 0)
    local = np.take_along_axis(d, _COORDINATE[face], axis=1) * _SIGN[face]
    scale = 0.5 * resolution / local[:, 2]
    return face, local[:, 0] * scale + 0.5 * resolution, local[:, 1] * scale + 0.5 * resolution


def cube_texel(directions: np.ndarray, resolution: int) -> np.ndarray:
    """[M, 3] -> [M] index of the texel that contains each direction."""
    face, column, row = cube_face_coordinates(directions, resolution)
    column, row = (np.clip(np.floor(x), 0, resolution - 1).astype(np.int64) for x in (column, row))
    return (face * resolution + row) * resolution + column


def _texel_across_borders(face: np.ndarray, column: np.ndarray, row: np.ndarray, n: int) -> np.ndarray:
    """Texel index for integer positions that may lie one step outside their face: the neighbour's nearest texel."""
    x, y = (column + 0.5) / n * 2.0 - 1.0, (row + 0.5) / n * 2.0 - 1.0
    inside = (column >= 0) & (column < n) & (row >= 0) & (row < n)
    index = (face * n + np.clip(row, 0, n - 1)) * n + np.clip(column, 0, n - 1)
    out = ~inside
    local = np.stack([x[out], y[out], np.ones(out.sum())], axis=1)
    index[out] = cube_texel(np.einsum("mji,mj->mi", _FACE_AXES[face[out]], local), n)
    return index


def padded_cube_index(resolution: int) -> np.ndarray:
    """[6 (n + 2)^2] the texel at each place of faces with a border of one texel: the neighbour's nearest."""
    n = resolution
    position = np.arange(-1, n + 1)
    face, row, column = (x.ravel() for x in np.meshgrid(np.arange(6), position, position, indexing="ij"))
    return _texel_across_borders(face, column, row, n)


def cube_lookup(directions: np.ndarray, resolution: int) -> sparse.csr_matrix:
    """Bilinear look-up: [M, 3] unit directions -> [M, 6 n^2] matrix whose rows sum to 1.

    Steps over a face border take the neighbour's nearest texel; at a cube corner the missing fourth texel drops out.
    """
    n = resolution
    face, column, row = cube_face_coordinates(directions, n)
    left, top = np.floor(column - 0.5).astype(np.int64), np.floor(row - 0.5).astype(np.int64)
    fx, fy = column - 0.5 - left, row - 0.5 - top
    columns, rows, weights = [], [], []
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = left + dx, top + dy
        corner = ((x < 0) | (x >= n)) & ((y < 0) | (y >= n))
        weights.append(np.where(corner, 0.0, (fx if dx else 1 - fx) * (fy if dy else 1 - fy)))
        columns.append(_texel_across_borders(face, x, y, n))
        rows.append(np.arange(len(face)))
    weights = np.stack(weights)
    weights /= weights.sum(0)
    shape = (len(face), 6 * n * n)
    entries = (np.concatenate(rows), np.concatenate(columns))
    return sparse.coo_matrix((weights.ravel(), entries), shape=shape).tocsr()


def frame_lookup(
    directions: np.ndarray, world_from_head: np.ndarray, resolution: int, light_index: np.ndarray | None = None
) -> sparse.csr_matrix:
    """Look-up of a cubemap along head-space directions [J, 3] in F frames: [J * F, 6 n^2], frames running fastest.

    world_from_head [F, 3, 3]; light_index [F]: which of L cubemaps, one below the other, each frame stands in, so that
    the matrix is [J * F, L * 6 n^2]; None: there is one.
    """
    lookup = cube_lookup(np.einsum("fij,dj->dfi", world_from_head, directions).reshape(-1, 3), resolution)
    if light_index is None:
        return lookup
    texels = 6 * resolution**2
    first = np.repeat(np.tile(light_index, len(directions)) * texels, np.diff(lookup.indptr))
    shape = (lookup.shape[0], (int(light_index.max()) + 1) * texels)
    return sparse.csr_matrix((lookup.data, lookup.indices + first, lookup.indptr), shape=shape)


def cube_smoothness(resolution: int) -> sparse.csr_matrix:
    """[12 n^2, 6 n^2]: one row per pair of neighbouring texels, +1 and -1, across face borders too."""
    n = resolution
    face, row, column = (x.ravel() for x in np.meshgrid(np.arange(6), np.arange(n), np.arange(n), indexing="ij"))
    here = (face * n + row) * n + column
    pairs = [
        np.stack([here, _texel_across_borders(face, column + dx, row + dy, n)], axis=1)
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    pairs = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    rows = np.repeat(np.arange(len(pairs)), 2)
    values = np.tile([1.0, -1.0], len(pairs))
    return sparse.coo_matrix((values, (rows, pairs.ravel())), shape=(len(pairs), 6 * n * n)).tocsr()


def latlong_directions(height: int, samples: int = 1) -> np.ndarray:
    """[height * samples, 2 * height * samples, 3] unit directions of a lat-long image's (sub)pixel centres."""
    rows, columns = height * samples, 2 * height * samples
    v = np.pi * (np.arange(rows) + 0.5)[:, None] / rows
    u = 2.0 * np.pi * (np.arange(columns) + 0.5)[None] / columns
    return np.stack([np.sin(u) * np.sin(v), np.cos(v) + 0 * u, -np.cos(u) * np.sin(v)], axis=-1)


def latlong_lookup(image: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Bilinear: image [H, 2 H, C], directions [..., 3] -> [..., C]; wraps around, clamps at the poles."""
    height, width = image.shape[:2]
    d = np.asarray(directions, np.float64)
    u = np.arctan2(d[..., 0], -d[..., 2]) / (2.0 * np.pi) % 1.0
    v = np.arccos(np.clip(d[..., 1], -1.0, 1.0)) / np.pi
    x, y = u * width - 0.5, np.clip(v * height - 0.5, 0.0, height - 1.0)
    column, row = np.floor(x).astype(np.int64), np.minimum(np.floor(y).astype(np.int64), height - 2)
    fx, fy = (x - column)[..., None], (y - row)[..., None]
    left, right = column % width, (column + 1) % width
    upper = image[row, left] * (1 - fx) + image[row, right] * fx
    lower = image[row + 1, left] * (1 - fx) + image[row + 1, right] * fx
    return upper * (1 - fy) + lower * fy


def latlong_from_cube(cube: np.ndarray, height: int, samples: int = 2) -> np.ndarray:
    """[6 n^2, C] -> [height, 2 height, C] float32, each pixel the mean of samples^2 look-ups."""
    resolution = cube_resolution(cube)
    directions = latlong_directions(height, samples)
    values = cube_lookup(directions.reshape(-1, 3), resolution) @ np.asarray(cube, np.float64)
    blocks = values.reshape(height, samples, 2 * height, samples, -1)
    return blocks.mean((1, 3)).astype(np.float32)


def cube_from_latlong(image: np.ndarray, resolution: int) -> np.ndarray:
    """[H, 2 H, C] -> [6 n^2, C] float32: each texel the mean over its own solid angle, so that energy is kept."""
    samples = max(2, int(np.ceil(image.shape[0] / (2 * resolution))))
    fine = cube_directions(resolution * samples)
    solid = cube_solid_angles(resolution * samples)
    blocks = (6, resolution, samples, resolution, samples)
    weight = solid.reshape(blocks)[..., None]
    values = latlong_lookup(np.asarray(image, np.float64), fine).reshape(blocks + (-1,))
    mean = (values * weight).sum((2, 4)) / weight.sum((2, 4))
    return mean.reshape(6 * resolution**2, -1).astype(np.float32)
