"""Where two clips show the same skin: their mean textures, laid beside each other in the one layout of the head model.

Each clip's mean texture lies on a mesh of its own, fitted to its own tracks, so that the same freckle falls on slightly
different texels. Dense flow between images of log local contrast, which show skin and not light, finds which.

References: [Kroeger2016] (dense inverse search); [Kalal2010] (forward-backward error).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from shared.geometry.atlas import sample
from shared.geometry.mesh import Mesh, normalised, vertex_normals
from shared.imaging.color import LUMINANCE, encode_srgb
from shared.imaging.texels import TexelSurface
from shared.tracking.tracked_clip import local_contrast

SEEN_WEIGHT = 2.0
"""Frames seen head-on from which on a mean texel shows more skin than noise."""
RETURN_TEXELS = 0.5
"""How near the way there and back must lead to where it started."""
LIKENESS, WINDOW_TEXELS = 0.6, 3.0
"""Least correlation of the contrast around two matching texels, and the standard width of what is around."""


@dataclass(frozen=True)
class ClipTexture:
    """mean radiance [S, S, 3] linear of a clip on its mesh, weight [S, S]: of the samples, in frames seen head-on."""

    mesh: Mesh
    mean: np.ndarray
    weight: np.ndarray

    def contrast(self) -> np.ndarray:
        """[S, S] uint8 log local contrast."""
        sigma = WINDOW_TEXELS * len(self.mean) / 256
        grey = np.rint(255.0 * encode_srgb(np.clip(self.mean @ LUMINANCE, 0.0, 1.0))).astype(np.uint8)
        return local_contrast(grey, sigma, 1.5 * sigma, 0.02)

    def places(self) -> np.ndarray:
        """[S, S, 6] float32: each texel's place on the mesh, mm, and the normal; NaN where hardly anything was seen."""
        surface = TexelSurface(self.mesh, len(self.mean))
        normals = vertex_normals(self.mesh.vertices, self.mesh.faces)
        places = surface.to_image(surface.interpolate(np.concatenate([self.mesh.vertices, normals], axis=1)), np.nan)
        places[self.weight < SEEN_WEIGHT] = np.nan
        return places


@dataclass(frozen=True)
class Matches:
    """N places that show the same skin: first, second [N, 3] on the two meshes, and the second one's normals [N, 3]."""

    first: np.ndarray
    second: np.ndarray
    normals: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    def thinned(self, most: int) -> Matches:
        """Every so many, at most about that many."""
        step = max(1, len(self) // most)
        return Matches(self.first[::step], self.second[::step], self.normals[::step])


def match_textures(first: ClipTexture, second: ClipTexture) -> Matches:
    """Texels of two maps of one size that show the same skin."""
    dense = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    one, two = first.contrast(), second.contrast()
    there, back = dense.calc(one, two, None), dense.calc(two, one, None)
    row, column = np.mgrid[: len(one), : len(one)].astype(np.float32) + 0.5
    target = np.stack([column, row], axis=-1) + there
    error = np.linalg.norm(there + sample(back, target, outside=np.nan), axis=-1)
    alike = likeness(one, sample(two, target), WINDOW_TEXELS * len(one) / 256)
    here, found = first.places(), sample_places(second.places(), target)
    same = (error < RETURN_TEXELS) & (alike > LIKENESS) & np.isfinite(here).all(-1) & np.isfinite(found).all(-1)
    return Matches(here[same][:, :3].astype(float), found[same][:, :3].astype(float), normalised(found[same][:, 3:]))


def sample_places(places: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[S, S, 6] at positions [S, S, 2]; NaN where a neighbour is. places [H, W, 6] mm: places and normals; target
    [S, S, 2] px."""
    return np.concatenate([sample(places[..., k : k + 3], target, outside=np.nan) for k in (0, 3)], axis=-1)


def likeness(one: np.ndarray, two: np.ndarray, sigma: float) -> np.ndarray:
    """[H, W]: correlation of two images, one [H, W] and two [H, W], within Gaussian windows of width sigma, px."""

    def mean(image: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(image, (0, 0), sigma)

    one, two = one.astype(np.float32), two.astype(np.float32)
    first, second = mean(one), mean(two)
    variance = (mean(one * one) - first * first) * (mean(two * two) - second * second)
    return (mean(one * two) - first * second) / np.sqrt(np.maximum(variance, 1.0))
