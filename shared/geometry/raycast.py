"""Ray queries against a triangle mesh through embree.

The loops over the rays are compiled and leave the interpreter's lock alone: several threads may ask the same scene at
once, each some 4 M rays/s.
"""

from __future__ import annotations

import numpy as np

from shared.compute.compiled import compiled
from shared.geometry.embree import FACE, FAR, FARTHEST, GEOMETRY, MASK, Triangles, call_embree, ray_buffer
from shared.geometry.transforms import camera_centres

RAY_START_MM = 0.05
"""How far above a surface rays start that must not meet it again."""


class RayScene:
    """An acceleration structure over vertices [V, 3] and faces [F, 3]. triangles: for other compiled loops."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self.triangles, self.vertices, self.faces = Triangles(vertices, faces), vertices, faces

    def occluded(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """[N, 3], [N, 3] -> [N] bool: does anything lie along the ray (any distance)?"""
        return self._traced(self.triangles.occluded, origins, directions) >= 0

    def first_faces(self, origins: np.ndarray, directions: np.ndarray, farthest: float = FAR) -> np.ndarray:
        """[N, 3], [N, 3] -> the face that each ray meets first [N] int32, -1: none up to the farthest distance."""
        return self._traced(self.triangles.intersect, origins, directions, farthest)

    def intersect(
        self, origins: np.ndarray, directions: np.ndarray, farthest: float = FAR
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[N, 3], [N, 3] -> face [N] int32 (-1: nothing hit), bary [N, 3] corner weights, distance [N].

        Distances are in units of the direction's length; where nothing is hit they are infinite. Rays that end at the
        farthest one that matters take less time. Which face it is embree says; where on it, doubles do: each
        processor's embree approximates reciprocals in its own way.
        """
        face = self.first_faces(origins, directions, farthest)
        bary, distance = np.zeros((len(face), 3), np.float32), np.full(len(face), np.inf, np.float32)
        hit = face >= 0
        bary[hit], distance[hit] = on_faces(self.vertices, self.faces, face[hit], origins[hit], directions[hit])
        face[np.isinf(distance)] = -1
        return face, bary, distance

    def _traced(
        self, function: np.uint64, origins: np.ndarray, directions: np.ndarray, farthest: float = FAR
    ) -> np.ndarray:
        """By embree's function -> face [N], -1 where nothing is hit."""
        origins, directions = np.asarray(origins, np.float32), np.asarray(directions, np.float32)
        face = np.empty(len(origins), np.int32)
        _trace(function, self.triangles.scene, *ray_buffer(), origins, directions, np.float32(farthest), face)
        return face


@compiled
def _trace(function, scene, ray, words, address, origins, directions, farthest, face):
    """Rays [N, 3] -> face [N], -1: none."""
    for n in range(len(origins)):
        for k in range(3):
            ray[k], ray[4 + k] = origins[n, k], directions[n, k]
        ray[FARTHEST] = farthest
        words[MASK] = words[GEOMETRY] = -1
        call_embree(function, scene, address)
        face[n] = -1
        if words[GEOMETRY] != -1:
            face[n] = words[FACE]
        elif words[FARTHEST] < 0:  # rtcOccluded1 says so by an infinite negative distance, and not what it met
            face[n] = 0


def on_faces(
    vertices: np.ndarray, faces: np.ndarray, face: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corner weights [N, 3] and distance [N], in units of the direction's length, where rays [N, 3] meet the planes of
    the faces face [N]: in doubles, where embree's single precision would be taken for a change of the surface. A ray
    that lies in its face's plane meets it nowhere: infinite distance, no weights.

    Reference: [Moeller1997].
    """
    a, b, c = np.moveaxis(np.asarray(vertices, np.float64)[faces[face]], 1, 0)
    first, second, away = b - a, c - a, origins - a
    across = np.cross(directions, second)
    volume, turned = (first * across).sum(1), np.cross(away, first)
    meets = volume != 0.0
    scale = np.divide(1.0, volume, out=np.zeros(len(volume)), where=meets)
    u, v = scale * (away * across).sum(1), scale * (directions * turned).sum(1)
    bary = np.stack([1.0 - u - v, u, v], axis=1) * meets[:, None]
    return bary, np.where(meets, scale * (second * turned).sum(1), np.inf)


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
