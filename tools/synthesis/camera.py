"""Pictures of the lit surface: radiance, and the buffers of the truth.

Each pixel averages a regular grid of sub x sub primary rays. Diffuse light comes from the irradiance atlas, the
specular part from samples of its own. Living eyes are painted and mirror by the gaze of the shot (iris).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.geometry.mesh import normalised
from shared.geometry.transforms import camera_centres, project
from shared.imaging.material_labels import LABELS
from shared.imaging.texture import sample_bilinear
from shared.rendering.envmap import latlong_lookup
from tools.synthesis.eye_light import eye_irradiance
from tools.synthesis.highlights import SAMPLE_SETS, LobeSamples, mirrored_radiance, specular_radiance
from tools.synthesis.iris import WET_SPECULAR, EyePaint
from tools.synthesis.irradiance import SyntheticShot
from tools.synthesis.light import EnvironmentLight
from tools.synthesis.surface import ShadingPoints, SyntheticSurface

TEXTURES = ("albedo", "specular", "roughness")


@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole with its principal point in the middle: width and height in pixels, focal length in pixels."""

    width: int
    height: int
    focal_px: float

    @property
    def intrinsics(self) -> np.ndarray:
        """[3, 3], pixel centres at integer + 0.5."""
        return np.array([[self.focal_px, 0, self.width / 2], [0, self.focal_px, self.height / 2], [0, 0, 1.0]])


@dataclass(frozen=True)
class PictureQuality:
    """Primary rays per pixel (sub^2), and lobe and lamp samples per primary ray."""

    sub: int = 2
    lobe_samples: int = 2
    lamp_samples: int = 4


def take_picture(surface: SyntheticSurface, light: EnvironmentLight, irradiance: np.ndarray, shot: SyntheticShot,
                 camera: PinholeCamera, quality: PictureQuality,
                 eyes: EyePaint | None = None) -> dict[str, np.ndarray]:
    """irradiance [size, size, 3] of this shot -> float32 images by name. eyes: how the head's look, if it has living
    ones.

    label [H, W] uint8, where the textures have it: what most rays of the pixel show, UNKNOWN where none hits the head.
    radiance [H, W, 3]; albedo [H, W, 3], normal [H, W, 3] (head space), specular and roughness [H, W]: means over the
    rays that hit the head, 0 where none does; depth (camera z, mm), mask (face skin) and head [H, W]: means over all
    rays.
    """
    rays = quality.sub**2
    rng = np.random.default_rng(shot.seed)
    samples = LobeSamples.draw(light, shot.world_from_head, rays * quality.lobe_samples,
                                rays * quality.lamp_samples, rng,
                                None if light.lamps_at is None else shot.in_head_space(light.lamps_at))
    pixels = _head_pixels(surface, shot, camera)
    choice = rng.integers(SAMPLE_SETS, size=len(pixels))
    background = _background(light, shot, camera)
    total = {"radiance": background * rays}
    for order, offset in enumerate(np.ndindex(quality.sub, quality.sub)):
        shift = (np.array(offset[::-1]) + 0.5) / quality.sub
        hit, directions, values = _primary_hits(surface, shot, camera, pixels + shift)
        wet = None if eyes is None else _look_at_eyes(eyes, shot, directions, values)
        values["radiance"] = _shade(surface, light, irradiance, shot, directions, values, samples.part(order, rays),
                                    choice[hit], wet, order)
        column, row = pixels[hit].T
        if surface.materials.label is not None:
            votes = total.setdefault("votes", np.zeros((camera.height, camera.width, len(LABELS)), np.uint8))
            votes[row, column, surface.label(values["points"].uv)] += 1
        total["radiance"][row, column] -= background[row, column]
        for name in ("radiance", "normal", "depth", "mask", "head", *TEXTURES):
            empty = np.zeros((camera.height, camera.width, *values[name].shape[1:]), np.float32)
            total.setdefault(name, empty)[row, column] += values[name]
    votes = total.pop("votes", None)
    return _averaged(total, rays) | ({} if votes is None else {"label": votes.argmax(-1).astype(np.uint8)})


def _averaged(total: dict[str, np.ndarray], rays: int) -> dict[str, np.ndarray]:
    seen = np.maximum(total["head"], 1.0)
    for name in TEXTURES:
        total[name] /= seen.reshape(seen.shape + (1,) * (total[name].ndim - 2))
    total["normal"] = normalised(total["normal"])
    for name in ("radiance", "depth", "mask", "head"):
        total[name] /= rays
    return {name: image.astype(np.float32) for name, image in total.items()}


def _head_pixels(surface: SyntheticSurface, shot: SyntheticShot, camera: PinholeCamera) -> np.ndarray:
    """[N, 2] column and row of the pixels in the bounding box of the projected mesh."""
    px, _ = project(surface.mesh.vertices, shot.camera_from_head, camera.intrinsics)
    size = [camera.width, camera.height]
    low, high = np.clip([np.floor(px.min(0)), np.ceil(px.max(0))], 0, size).astype(int)
    return np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), -1).reshape(-1, 2)


def _camera_directions(points_px: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """[..., 2] -> [..., 3] in camera space, z = 1."""
    offset = (points_px - [camera.width / 2, camera.height / 2]) / camera.focal_px
    return np.concatenate([offset, np.ones((*offset.shape[:-1], 1))], -1)


def _background(light: EnvironmentLight, shot: SyntheticShot, camera: PinholeCamera) -> np.ndarray:
    """[H, W, 3] what the camera sees past the head: the light itself, near lamps as if they were far."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1) + 0.5
    world_from_camera = shot.world_from_head @ shot.camera_from_head[:3, :3].T
    return latlong_lookup(light.image, normalised(_camera_directions(pixels, camera)) @ world_from_camera.T)


def _primary_hits(surface: SyntheticSurface, shot: SyntheticShot, camera: PinholeCamera,
                  points_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Rays through image points [N, 2]: which hit [M], their head-space directions [M, 3] and what lies there."""
    directions = (_camera_directions(points_px, camera) @ shot.camera_from_head[:3, :3]).astype(np.float32)
    origins = np.broadcast_to(camera_centres(shot.camera_from_head), directions.shape)
    face, bary, depth = surface.scene.intersect(origins, directions)
    hit = np.nonzero(face >= 0)[0]
    points = surface.points(face[hit], bary[hit])
    values = {name: sample_bilinear(getattr(surface.materials, name), points.uv) for name in TEXTURES}
    inside = sample_bilinear(surface.materials.mask, points.uv) > 0.5
    return hit, directions[hit], {**values, "face": face[hit], "points": points, "normal": points.normal,
                                  "depth": depth[hit], "mask": inside, "head": np.ones(len(hit), np.float32)}


def _look_at_eyes(eyes: EyePaint, shot: SyntheticShot, directions: np.ndarray,
                  values: dict) -> tuple[np.ndarray, ShadingPoints]:
    """Paints the values of hits on eyeballs with what the shot's gaze turns there -> their index [K] among the hits,
    and the points of their wet surface."""
    side = eyes.eyes.face_side[np.minimum(values["face"], len(eyes.eyes.face_side) - 1)]
    side = np.where(values["face"] < len(eyes.eyes.face_side), side, -1)
    index = np.nonzero(side >= 0)[0]
    points = values["points"].select(index)
    albedo, roughness, place, normal = eyes.look(points.position, normalised(directions[index]), side[index], shot.gaze)
    for name, value in (("albedo", albedo), ("specular", WET_SPECULAR), ("roughness", roughness)):
        values[name][index] = value
    place, normal = place.astype(np.float32), normal.astype(np.float32)
    return index, ShadingPoints(place, normal, normal, points.uv)


def _shade(surface: SyntheticSurface, light: EnvironmentLight, irradiance: np.ndarray, shot: SyntheticShot,
           directions: np.ndarray, values: dict, samples: LobeSamples, choice: np.ndarray,
           wet: tuple[np.ndarray, ShadingPoints] | None, order: int) -> np.ndarray:
    """[M, 3] radiance towards the camera: albedo / pi times irradiance, plus the specular lobe. At the wet points the
    lobe is narrow and the irradiance is traced anew, with random numbers of the ray's order in its pixel."""
    outgoing = -normalised(directions)
    specular = specular_radiance(surface, light, irradiance, shot.world_from_head, values["points"],
                                 outgoing, values["roughness"], samples, choice)
    if wet is not None and len(wet[0]):
        index, points = wet
        specular[index] = mirrored_radiance(surface, light, irradiance, shot.world_from_head, points, outgoing[index],
                                            values["roughness"][index], samples, choice[index])
    arriving = sample_bilinear(irradiance, values["points"].uv)
    if wet is not None and len(wet[0]):
        rng = np.random.default_rng([shot.seed, 14, order])
        arriving[wet[0]] = eye_irradiance(surface, light, irradiance, shot, values["points"].select(wet[0]), rng)
    diffuse = values["albedo"] * arriving / np.float32(np.pi)
    return diffuse + values["specular"][:, None] * specular
