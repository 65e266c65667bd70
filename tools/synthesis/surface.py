"""The surface that the tracer sees: a head's mesh with its reflectance textures and an embree scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.geometry.mesh import Mesh, face_normals, interpolate, normalised, vertex_normals
from shared.geometry.raycast import RayScene
from shared.imaging.texture import sample_bilinear

OFFSET_MM = 0.02
"""How far above the surface secondary rays start."""


@dataclass(frozen=True)
class Materials:
    """UV textures: albedo [H, W, 3], specular intensity, roughness and face skin mask [H, W], all float32; label [H, W]
    uint8: of material_labels.LABELS, None: not known."""

    albedo: np.ndarray
    specular: np.ndarray
    roughness: np.ndarray
    mask: np.ndarray
    label: np.ndarray | None = None


@dataclass(frozen=True)
class ShadingPoints:
    """Points on the surface: position, shading normal and geometric normal [N, 3], uv [N, 2]."""

    position: np.ndarray
    normal: np.ndarray
    geometric_normal: np.ndarray
    uv: np.ndarray

    @property
    def origins(self) -> np.ndarray:
        """[N, 3] where secondary rays start: just outside the surface."""
        return self.position + OFFSET_MM * self.geometric_normal

    def select(self, index: np.ndarray) -> ShadingPoints:
        """The points of an index or a mask."""
        return ShadingPoints(self.position[index], self.normal[index], self.geometric_normal[index], self.uv[index])


class SyntheticSurface:
    """A textured mesh in head space that rays can be shot at."""

    def __init__(self, mesh: Mesh, materials: Materials):
        self.mesh, self.materials = mesh, materials
        self.scene = RayScene(mesh.vertices, mesh.faces)
        self._vertices = mesh.vertices.astype(np.float32)
        self._uvs = mesh.uvs.astype(np.float32)
        self._normals = vertex_normals(mesh.vertices, mesh.faces).astype(np.float32)
        self._face_normals = normalised(face_normals(mesh.vertices, mesh.faces)).astype(np.float32)

    def points(self, face: np.ndarray, bary: np.ndarray) -> ShadingPoints:
        """Interpolates at faces [N] with corner weights [N, 3]; shading normals are angle-weighted vertex normals."""
        bary = bary.astype(np.float32)
        faces = self.mesh.faces
        return ShadingPoints(
            interpolate(self._vertices, faces, face, bary),
            normalised(interpolate(self._normals, faces, face, bary)),
            self._face_normals[face],
            interpolate(self._uvs, self.mesh.face_uvs, face, bary),
        )

    def hits(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First hits of rays [N, 3]: index [M] of the rays that meet the outer side of the surface, uv [M, 2] there,
        and a mask [N] of the rays that meet nothing. Rays that meet the inner side belong to neither: no light."""
        face, bary, _ = self.scene.intersect(origins, directions)
        index = np.nonzero(face >= 0)[0]
        outer = (self._face_normals[face[index]] * directions[index]).sum(1) < 0
        index = index[outer]
        return index, interpolate(self._uvs, self.mesh.face_uvs, face[index], bary[index]), face < 0

    def albedo(self, uv: np.ndarray) -> np.ndarray:
        """[N, 2] -> [N, 3]."""
        return sample_bilinear(self.materials.albedo, uv)

    def label(self, uv: np.ndarray) -> np.ndarray:
        """[N, 2] -> [N] uint8, of the nearest texel."""
        label = self.materials.label
        return label.ravel()[nearest_texel(uv, len(label))]


def nearest_texel(uv: np.ndarray, size: int) -> np.ndarray:
    """[N, 2] uv -> [N] flat index into a texture of size x size."""
    column = np.clip((uv[:, 0] * size).astype(np.int32), 0, size - 1)
    row = np.clip(((1.0 - uv[:, 1]) * size).astype(np.int32), 0, size - 1)
    return row * size + column
