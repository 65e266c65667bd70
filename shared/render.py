"""Re-renders a frame in image space from maps and the shading of the mesh's vertices.

Primary rays find the surface; albedo and specular intensity come from the maps, irradiance and the specular lobe sum
from the vertices, interpolated over the triangles. Several rays per pixel share one shading, so edges are smooth and
the picture can be compared with a camera's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.gather import SurfaceViewer
from shared.mesh import interpolate
from shared.raycast import camera_hits
from shared.shading import VertexShading
from shared.texture import sample_bilinear


@dataclass(frozen=True)
class SurfaceMaps:
    """UV-space maps: albedo [S, S, 3] and specular_intensity [S, S]."""

    albedo: np.ndarray
    specular_intensity: np.ndarray


def render_frame(
    viewer: SurfaceViewer,
    shading: VertexShading,
    maps: SurfaceMaps,
    frame: int,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    samples: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance [H, W, 3] and coverage [H, W] in [0, 1] of one frame; 0 outside the head.

    size: (width, height); samples: rays per pixel along each axis. frame: the shading's frame. Radiance is the mean
    over the rays that hit the head, so that partly covered pixels are not darkened.
    """
    width, height = size
    shade = np.concatenate([shading.irradiance(frame), shading.reflection(frame)], axis=1)
    radiance, hits = np.zeros((height * width, 3), np.float32), np.zeros(height * width, np.float32)
    for row in range(samples):
        for column in range(samples):
            offsets = (column + 0.5) / samples, (row + 0.5) / samples
            face, bary, _ = camera_hits(viewer.scene, camera_from_head, intrinsics, width, height, offsets)
            pixel = np.nonzero(face.ravel() >= 0)[0]
            face, bary = face.ravel()[pixel], bary.reshape(-1, 3)[pixel]
            uv = interpolate(viewer.mesh.uvs, viewer.mesh.face_uvs, face, bary)
            both = interpolate(shade, viewer.mesh.faces, face, bary)
            albedo, intensity = sample_bilinear(maps.albedo, uv), sample_bilinear(maps.specular_intensity, uv)
            radiance[pixel] += albedo * both[:, :3] + intensity[:, None] * both[:, 3:]
            hits[pixel] += 1.0
    radiance /= np.maximum(hits, 1.0)[:, None]
    return radiance.reshape(height, width, 3), (hits / samples**2).reshape(height, width)
