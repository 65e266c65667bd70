"""A clip of a turning egg whose truth is known, for solvers of appearance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from shapes import turned
from toy_head import toy_head

from shared.geometry.surface import Surface
from shared.imaging.color import encode_srgb
from shared.imaging.image_sampling import prepare_picture
from shared.imaging.views import Views
from shared.rendering.envmap import cube_directions, latlong_from_cube
from shared.rendering.precomputed_transfer import Sizes
from shared.rendering.views import HeadViews, ViewCamera

FRAMES, SIZE, MAP = 9, (64, 64), 32
LENS = np.array([[230.0, 0, 32], [0, 230.0, 32], [0, 0, 1]])


@dataclass(frozen=True)
class ToyClip:
    """A clip as solvers take it."""

    views: Views
    surface: Surface

    @property
    def mesh(self):
        return self.surface.mesh

    @property
    def lens(self):
        return LENS


def true_maps():
    v, u = np.mgrid[0:MAP, 0:MAP] / MAP
    pattern = np.exp(0.35 * np.sin(12.0 * u) * np.cos(9.0 * v))
    albedo = (np.array([0.48, 0.30, 0.22]) * pattern[..., None]).astype(np.float32)
    full = np.ones((MAP, MAP), np.float32)
    return {"diffuse_albedo": albedo, "specular_intensity": 0.5 * full, "roughness": 0.45 * full}


def true_light():
    texels = cube_directions(16)
    lamp = np.exp(5.0 * (texels @ np.array([-0.52, 0.43, 0.74]) - 1.0))[:, None]
    return 0.35 + np.array([1.6, 1.5, 1.3]) * lamp + 0.1 * texels[:, 1:2]


def toy_clip():
    """A turning egg, rendered by the shared renderer (no part of the reference solver)."""
    mesh = toy_head(4).mesh(np.zeros(2), np.zeros(1))
    angle = np.linspace(-0.6, 0.6, FRAMES)
    vectors = np.stack([0.15 * np.sin(5 * angle), angle, 0 * angle], axis=1)
    poses = turned(vectors)
    cameras = [ViewCamera(pose, LENS, SIZE) for pose in poses]
    views = HeadViews(mesh, true_maps(), Sizes(directions=512, nodes=60), cameras)
    light = latlong_from_cube(true_light(), 64)
    pictures = []
    for camera, image in zip(cameras, views.render(light, cameras, "head", fade=False), strict=True):
        codes = np.round(255 * encode_srgb(np.clip(image, 0, 1))).astype(np.uint8)
        mask = (views.coverage(camera) > 0.5).astype(np.uint8) * 255
        pictures.append(prepare_picture(codes, image.astype(np.float32), mask))
    views = Views.in_one_light(poses, LENS, SIZE, "head", pictures.__getitem__, None)
    return ToyClip(views, Surface(mesh))
