"""Ray queries against a triangle mesh through embree.

embreex traces one ray per call inside (about 4 M rays/s) and keeps the interpreter lock: parallel tracing means
processes, not threads.
"""

from __future__ import annotations

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from shared.geometry.transforms import camera_centres

RAY_START_MM = 0.05
"""How far above a surface rays start that must not meet it again."""


class RayScene:
    """An acceleration structure over vertices [V, 3] and faces [F, 3]."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self._scene = rtcore_scene.EmbreeScene()
        triangles = np.ascontiguousarray(np.asarray(vertices)[faces], np.float32)
        self._mesh = TriangleMesh(self._scene, triangles)

    def occluded(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """[N, 3], [N, 3] -> [N] bool: does anything lie along the ray (any distance)?"""
        if len(origins) == 0:
            return np.zeros(0, bool)
        return np.asarray(self._scene.run(_rays(origins), _rays(directions), query="OCCLUDED")) != -1

    def first_faces(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """[N, 3], [N, 3] -> the face that each ray meets first [N] int32, -1: none. Half the time of intersect."""
        if len(origins) == 0:
            return np.zeros(0, np.int32)
        return np.asarray(self._scene.run(_rays(origins), _rays(directions), query="INTERSECT"), np.int32)

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[N, 3], [N, 3] -> face [N] int32 (-1: nothing hit), bary [N, 3] corner weights, distance [N].

        Distances are in units of the direction's length; where nothing is hit they are infinite.
        """
        if len(origins) == 0:
            return np.zeros(0, np.int32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        hits = self._scene.run(_rays(origins), _rays(directions), query="INTERSECT", output=1)
        face = np.asarray(hits["primID"], np.int32)
        u, v = np.asarray(hits["u"]), np.asarray(hits["v"])
        bary = np.stack([1.0 - u - v, u, v], axis=1).astype(np.float32)
        missed = face < 0
        bary[missed] = 0.0
        return face, bary, np.where(missed, np.inf, np.asarray(hits["tfar"])).astype(np.float32)


def on_faces(
    vertices: np.ndarray, faces: np.ndarray, face: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corner weights [N, 3] and distance [N], in units of the direction's length, where rays [N, 3] meet the planes of
    the faces face [N]: in doubles, where embree's single precision would be taken for a change of the surface.

    Reference: [Moeller1997].
    """
    a, b, c = np.moveaxis(np.asarray(vertices, np.float64)[faces[face]], 1, 0)
    first, second, away = b - a, c - a, origins - a
    across = np.cross(directions, second)
    scale = 1.0 / (first * across).sum(1)
    turned = np.cross(away, first)
    u, v = scale * (away * across).sum(1), scale * (directions * turned).sum(1)
    return np.stack([1.0 - u - v, u, v], axis=1), scale * (second * turned).sum(1)


def _rays(vectors: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(vectors, np.float32)


def pixel_directions(
    intrinsics: np.ndarray, width: int, height: int, offsets: tuple[float, float] = (0.5, 0.5)
) -> np.ndarray:
    """[height, width, 3] camera-space directions with z = 1 through each pixel; offsets within the pixel, 0 to 1."""
    x, y = np.meshgrid(np.arange(width) + offsets[0], np.arange(height) + offsets[1])
    return np.stack(
        [(x - intrinsics[0, 2]) / intrinsics[0, 0], (y - intrinsics[1, 2]) / intrinsics[1, 1], np.ones_like(x)], axis=-1
    )


def camera_hits(
    scene: RayScene,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    width: int,
    height: int,
    offsets: tuple[float, float] = (0.5, 0.5),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What each pixel sees: face [H, W] (-1: background), bary [H, W, 3], depth [H, W] mm along the camera's z axis."""
    directions = pixel_directions(intrinsics, width, height, offsets).reshape(-1, 3) @ camera_from_head[:3, :3]
    origins = np.broadcast_to(camera_centres(camera_from_head), directions.shape)
    face, bary, depth = scene.intersect(origins, directions)
    return face.reshape(height, width), bary.reshape(height, width, 3), depth.reshape(height, width)
