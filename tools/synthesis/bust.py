"""A neck does not end in the air: shoulders in a plain shirt, joined to the head's open rim."""

from __future__ import annotations

import numpy as np

from shared.geometry.mesh import Mesh, boundary_loop, half_edges, normalised

UV_SCALE, UV_STRIP = 0.92, 0.075
"""The head's layout shrinks to this share of the texture; the shoulders take a strip along the lower border."""
RINGS = 40
NECK_REACH_MM = 24.0
SHOULDER_WIDTH_MM, SHOULDER_DEPTH_MM = 205.0, 80.0
SHOULDER_Y_MM, BOTTOM_Y_MM, SPINE_Z_MM = -192.0, -420.0, -38.0


def with_bust(head: Mesh) -> Mesh:
    """The head with a bust below its rim. New vertices and faces follow the old ones; uvs move, see UV_SCALE."""
    rim = boundary_loop(head.faces)
    count, columns = len(head.vertices), len(rim)
    rings = _bust_rings(head.vertices[rim], _outward_tangents(head, rim))
    index = np.concatenate([rim[None], count + np.arange((RINGS - 1) * columns).reshape(RINGS - 1, columns)])
    down = np.sqrt(np.linspace(0, 1, RINGS))  # more texels for the neck than for what the picture cuts off
    u, v = np.meshgrid(np.linspace(0.01, 0.99, columns + 1), (UV_STRIP - 0.01) * (1 - down) + 0.005 * down)
    uvs = np.concatenate([head.uvs * UV_SCALE + [0.04, 1 - UV_SCALE], np.stack([u, v], -1).reshape(-1, 2)])
    uv_index = len(head.uvs) + np.arange(RINGS * (columns + 1)).reshape(RINGS, columns + 1)
    closed = np.concatenate([index, index[:, :1]], 1)
    return Mesh(
        np.concatenate([head.vertices, rings[1:].reshape(-1, 3)]),
        np.concatenate([head.faces, quads(closed)]).astype(np.int32),
        uvs,
        np.concatenate([head.face_uvs, quads(uv_index)]).astype(np.int32),
    )


def _outward_tangents(head: Mesh, rim: np.ndarray) -> np.ndarray:
    """[C, 3] unit directions in which the surface would go on beyond its rim, smoothed along it."""
    edges = half_edges(head.faces)
    edges = np.concatenate([edges, edges[:, ::-1]])
    tangents = np.zeros((len(rim), 3))
    for i, vertex in enumerate(rim):
        inner = np.setdiff1d(edges[edges[:, 0] == vertex, 1], rim)
        if len(inner):
            tangents[i] = head.vertices[vertex] - head.vertices[inner].mean(0)
    for _ in range(len(rim) // 8):
        tangents = tangents + np.roll(tangents, 1, 0) + np.roll(tangents, -1, 0)
        tangents /= np.linalg.norm(tangents, axis=1).mean()
    return normalised(tangents)


def _bust_rings(rim: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """[RINGS, C, 3] from the rim [C, 3] over the shoulders down: cubic Bezier curves, one per rim vertex."""
    angle = np.arctan2(rim[:, 0] / SHOULDER_WIDTH_MM, (rim[:, 2] - SPINE_Z_MM) / SHOULDER_DEPTH_MM)
    across = np.stack([SHOULDER_WIDTH_MM * np.sin(angle), SHOULDER_DEPTH_MM * np.cos(angle)], 1)

    def ring(share: float, y: np.ndarray) -> np.ndarray:
        return np.stack([share * across[:, 0], y, SPINE_Z_MM + share * across[:, 1]], 1)

    level = np.full(len(rim), SHOULDER_Y_MM) - 22.0 * np.cos(angle) ** 2
    neck = rim + NECK_REACH_MM * tangents
    shoulder, bottom = ring(1.02, level), ring(1.12, np.full(len(rim), BOTTOM_Y_MM))
    t = np.linspace(0, 1, RINGS)[:, None, None]
    return (1 - t) ** 3 * rim + 3 * t * (1 - t) ** 2 * neck + 3 * t**2 * (1 - t) * shoulder + t**3 * bottom


def quads(index: np.ndarray) -> np.ndarray:
    """[R, C] grid of indices -> triangles [2 (R - 1) (C - 1), 3], facing whom columns run to the left for."""
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    return np.stack([np.stack([b, a, c], -1), np.stack([b, c, d], -1)], 2).reshape(-1, 3)
