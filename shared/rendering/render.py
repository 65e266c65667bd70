"""Re-renders a frame in image space from maps and the shading of the mesh's vertices.

Primary rays find the surface; albedo and specular intensity come from the maps, irradiance and the specular lobe sum
from the vertices, interpolated over the triangles. Several rays per pixel share one shading, so edges are smooth and
the picture can be compared with a camera's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shared.compute.compiled import compiled
from shared.compute.threads import share_out
from shared.geometry.mesh import Mesh, interpolate, normalised
from shared.geometry.raycast import RAY_START_MM, RayScene, camera_hits, pixel_directions
from shared.geometry.transforms import camera_centres
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.texture import sample_bilinear
from shared.imaging.turning_eyes import TurningEyes
from shared.rendering.eye_shine import EyeShine
from shared.rendering.shading import VertexShading

_ROWS_PER_BAND = 32
LAYERS, LEAST_LEFT = 4, 0.02
"""Surfaces behind each other that a ray looks through, and the share of it below which what is left does not count."""


@dataclass(frozen=True)
class SurfaceMaps:
    """UV-space maps: albedo [S, T, 3], specular_intensity [S, T], and alpha [S, T]: how much of a place is there, None:
    all of it."""

    albedo: np.ndarray
    specular_intensity: np.ndarray
    alpha: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class LookingEyes:
    """Eyes with their gaze [2, 2] radians; NaN: straight ahead."""

    eyes: TurningEyes
    gaze: np.ndarray

    def shine(
        self, viewer: SurfaceViewer, shading: VertexShading, frame: int, camera: np.ndarray, face: np.ndarray,
        bary: np.ndarray,
    ) -> np.ndarray:
        """S [N, 3] float32 of rays that meet face [N] int (-1: none) with corner weights bary [N, 3]; -1 where that is
        no eye. frame: the shading's; camera [3]: its centre in head space, mm."""
        own = np.full((len(face), 3), -1.0, np.float32)
        at = np.nonzero((face >= 0) & (self.eyes.side[face] >= 0))[0]
        if len(at):
            own[at] = EyeShine(viewer, shading, self.eyes).reflection(frame, self.gaze, camera, face[at], bary[at])
        return own


def render_frame(
    viewer: SurfaceViewer,
    shading: VertexShading,
    maps: SurfaceMaps,
    frame: int,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    samples: int = 2,
    eyes: LookingEyes | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance [H, W, 3] and coverage [H, W] in [0, 1] of one frame; 0 outside the head.

    size: (width, height); samples: rays per pixel along each axis. frame: the shading's frame; eyes: those of
    the head, None: its eyeballs are parts of the skin. Radiance is the mean over the rays that hit the head, so that
    partly covered pixels are not darkened.
    """
    (radiance,), coverage = render_lights(
        viewer, shading, maps, [frame], camera_from_head, intrinsics, size, samples=samples, eyes=eyes
    )
    return radiance, coverage


def render_lights(
    viewer: SurfaceViewer,
    shading: VertexShading,
    maps: SurfaceMaps,
    frames: Sequence[int],
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    samples: int = 2,
    eyes: LookingEyes | None = None,
) -> tuple[list[np.ndarray], np.ndarray]:
    """As render_frame of several of the shading's frames in which the camera stands alike and the light may not: a
    ray is traced once for all of them. -> radiance [H, W, 3] of each, and their coverage [H, W]."""
    width, height = size
    mesh, uvs = viewer.mesh, viewer.mesh.uvs.astype(np.float32)
    shades = [
        np.concatenate([shading.irradiance(frame), shading.reflection(frame)], axis=1, dtype=np.float32)
        for frame in frames
    ]
    albedo = np.ascontiguousarray(maps.albedo, np.float32)
    intensity = np.ascontiguousarray(maps.specular_intensity, np.float32)
    radiance, hits = np.zeros((len(shades), height * width, 3), np.float32), np.zeros(height * width, np.float32)

    camera, no_shine = camera_centres(camera_from_head[None])[0], np.empty((0, 3), np.float32)

    def render(band: int) -> None:
        first = band * _ROWS_PER_BAND
        rows = min(_ROWS_PER_BAND, height - first)
        lens = intrinsics - np.array([[0.0, 0.0, 0.0], [0.0, 0.0, first], [0.0, 0.0, 0.0]])
        pixels = slice(first * width, (first + rows) * width)
        for row in range(samples):
            for column in range(samples):
                offsets = (column + 0.5) / samples, (row + 0.5) / samples
                for face, bary, share in seen_layers(
                    viewer, maps.alpha, camera_from_head, lens, (width, rows), offsets
                ):
                    hits[pixels] += share
                    read = (face, bary) if eyes is None else eyes.eyes.read_at(face, bary, eyes.gaze)
                    for frame, shade, sent in zip(frames, shades, radiance[:, pixels], strict=True):
                        shine = no_shine if eyes is None else eyes.shine(viewer, shading, frame, camera, face, bary)
                        _add_radiance(
                            face, bary, share, *read, shine, mesh.faces, mesh.face_uvs, uvs, albedo, intensity, shade,
                            sent,
                        )

    share_out(-(-height // _ROWS_PER_BAND), render)
    radiance /= np.where(hits > 0.0, hits, 1.0)[:, None]
    return list(radiance.reshape(-1, height, width, 3)), (hits / samples**2).reshape(height, width)


def seen_layers(
    viewer: SurfaceViewer, alpha: np.ndarray | None, camera_from_head: np.ndarray, intrinsics: np.ndarray,
    size: tuple[int, int], offsets: tuple[float, float],
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """What a ray through each of N pixels meets, layer by layer: face [N] int (-1: nothing), bary [N, 3], and the share
    of the ray that ends there [N] float32. size: (width, height); offsets within the pixels.

    alpha [S, T]: what lets through what it is short of 1, for the next layer; None: nothing does.
    """
    face, bary, _ = camera_hits(viewer.scene, camera_from_head, intrinsics, *size, offsets)
    face, bary = face.ravel(), bary.reshape(-1, 3)
    if alpha is None:
        yield face, bary, (face >= 0).astype(np.float32)
        return
    mesh, left = viewer.mesh, np.ones(len(face), np.float32)
    directions = pixel_directions(intrinsics, *size, offsets).reshape(-1, 3) @ camera_from_head[:3, :3]
    for _ in range(LAYERS):
        own, hit = np.zeros_like(left), np.nonzero(face >= 0)[0]
        place = interpolate(mesh.uvs, mesh.face_uvs, face[hit], bary[hit])
        own[hit] = sample_bilinear(alpha, place)
        yield face, bary, left * own
        left = left * (1.0 - own)
        on = hit[left[hit] > LEAST_LEFT]
        if not len(on):
            return
        start = interpolate(mesh.vertices, mesh.faces, face[on], bary[on])
        away = normalised(directions[on])
        face, bary = np.full_like(face, -1), np.zeros_like(bary)
        face[on], bary[on], _ = viewer.scene.intersect(start + RAY_START_MM * away, away)


def head_coverage(
    viewer: SurfaceViewer, alpha: np.ndarray | None, camera_from_head: np.ndarray, intrinsics: np.ndarray,
    size: tuple[int, int], samples: int = 2,
) -> np.ndarray:
    """[H, W] in [0, 1]: how much of each pixel of a picture of a size (width, height) the mesh covers, as render_frame
    counts it with so many samples. alpha [S, T]: as of seen_layers."""
    vertices = viewer.mesh.vertices @ camera_from_head[:3, :3].T + camera_from_head[:3, 3]
    seen = vertices @ intrinsics.T
    pixels = seen[:, :2] / seen[:, 2:]
    low, high = (np.clip(np.floor(corner), 0, size).astype(int) for corner in (pixels.min(0), pixels.max(0) + 1.0))
    covered = np.zeros(size[::-1])
    width, height = high - low
    if width <= 0 or height <= 0:
        return covered
    lens = intrinsics - np.array([[0.0, 0.0, low[0]], [0.0, 0.0, low[1]], [0.0, 0.0, 0.0]])
    inside = covered[low[1] : high[1], low[0] : high[0]]
    for row in range(samples):
        for column in range(samples):
            offsets = (column + 0.5) / samples, (row + 0.5) / samples
            for _, _, share in seen_layers(viewer, alpha, camera_from_head, lens, (width, height), offsets):
                inside += share.reshape(height, width)
    return covered / samples**2


def solid_viewer(mesh: Mesh, alpha: np.ndarray | None) -> SurfaceViewer:
    """A viewer of the mesh past whose faces that are less than half there, by alpha [S, T], light and looks go; None:
    all are there. Faces keep their numbers: those without area are met by no ray."""
    if alpha is None:
        return SurfaceViewer.of(mesh)
    there = sample_bilinear(alpha, mesh.uvs)[mesh.face_uvs].mean(1) >= 0.5
    return SurfaceViewer(mesh, RayScene(mesh.vertices, np.where(there[:, None], mesh.faces, mesh.faces[:, :1])))


@compiled
def _add_radiance(
    face, bary, part, texture_face, texture_bary, shine, faces, face_uvs, uvs, albedo, specular_intensity, shade,
    radiance,
):
    """Adds to radiance [N, 3] the part [N] of what rays see: face [N] (-1: nothing), bary [N, 3], and where the texture
    is read;
    shade [V, 6]: E and S; shine [N, 3]: S of the rays themselves where it is not negative, [0, 3]: nowhere; maps as by
    texture.sample_bilinear."""
    one, half, (height, width) = np.float32(1.0), np.float32(0.5), albedo.shape[:2]
    for n in range(len(face)):
        if face[n] < 0:
            continue
        u, v = np.float32(0.0), np.float32(0.0)
        for k in range(3):
            u += texture_bary[n, k] * uvs[face_uvs[texture_face[n], k], 0]
            v += texture_bary[n, k] * uvs[face_uvs[texture_face[n], k], 1]
        x, y = u * width - half, (one - v) * height - half
        left, top = int(np.floor(x)), int(np.floor(y))
        fx, fy = x - np.float32(left), y - np.float32(top)
        right, bottom, left, top = (left + 1) % width, (top + 1) % height, left % width, top % height
        corners = (one - fx) * (one - fy), fx * (one - fy), (one - fx) * fy, fx * fy
        specular = (corners[0] * specular_intensity[top, left] + corners[1] * specular_intensity[top, right]
                 + corners[2] * specular_intensity[bottom, left] + corners[3] * specular_intensity[bottom, right])
        for c in range(3):
            diffuse = (corners[0] * albedo[top, left, c] + corners[1] * albedo[top, right, c]
                       + corners[2] * albedo[bottom, left, c] + corners[3] * albedo[bottom, right, c])
            irradiance, reflection = np.float32(0.0), np.float32(0.0)
            for k in range(3):
                irradiance += bary[n, k] * shade[faces[face[n], k], c]
                reflection += bary[n, k] * shade[faces[face[n], k], c + 3]
            if len(shine) > 0 and shine[n, c] >= 0.0:
                reflection = shine[n, c]
            radiance[n, c] += part[n] * (diffuse * irradiance + specular * reflection)
