"""What tells skin from hair and cloth at a mesh's vertices: colour, texture, reduced chi-square over a clip's frames.

All three are measured beside what typical skin would show at the same place in the same frame, so that light and
shade cancel: how bright each channel is, how strongly the picture varies within a millimetre or two (strands, weave),
and how far frames contradict each other about the place. Hair stands off the surface and shines otherwise than skin, a
collar does not move with the head: seen as a rigid surface, both change from frame to frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from shared.appearance.texture import Noise
from shared.compute.run_context import SILENT, RunContext
from shared.imaging.frame_index import spread_frames
from shared.imaging.image_sampling import Picture, SurfaceViewer, remap, sample_colours, sample_inside
from shared.imaging.views import Views
from shared.rendering.shading import VertexShading

MOST_FRAMES = 48
TEXTURE_MM, WINDOW_MM = 1.0, 1.5
"""Standard deviations: structure finer than the first is texture, its strength a mean over the second."""
LEAST_RADIANCE = 0.004
"""Added before logarithms are taken: darker than that, cameras show noise."""
MOST_LOG = 4.0
"""Of the ratio to typical skin: more is an error of the light or the place."""


@dataclass(frozen=True)
class SurfaceFeatures:
    """Of V vertices. colour [V, 3]: logarithm of the radiance over that of typical skin, mean over frames; texture [V]:
    logarithm of the standard deviation of the log radiance within some mm of a picture; chi_square [V]: logarithm of
    the reduced chi-square of frames about `colour`; weight [V]: how many frames see it, by view cosine."""

    colour: np.ndarray
    texture: np.ndarray
    chi_square: np.ndarray
    weight: np.ndarray


def surface_features(viewer: SurfaceViewer, shading: VertexShading, views: Views, typical_albedo: np.ndarray,
                     specular: float, context: RunContext = SILENT) -> SurfaceFeatures:
    """Of all vertices of the viewer's mesh; where weight is 0 the others are 0.

    shading: of the same mesh in the same views; typical_albedo [3] and specular: of this person's skin.
    """
    frames = spread_frames(len(views), MOST_FRAMES, views.light_index)
    count, noise = len(viewer.mesh.vertices), Noise()
    total, spread = np.zeros(count), np.zeros(count)
    sums, squares, expected = np.zeros((3, count, 3))
    typical = typical_albedo.astype(np.float32)
    for f in context.progress(frames, "materials"):
        picture, lens = views.picture(f), views.intrinsics[f]
        view = viewer.view(views.camera_from_head[f], lens, picture.inside.shape[::-1])
        rows = np.nonzero(view.weight > 0)[0]
        pixels = view.pixels[rows]
        weight = view.weight[rows] * sample_inside(picture, pixels)
        seen = weight > 0
        rows, pixels, weight = rows[seen], pixels[seen], weight[seen].astype(np.float64)
        skin = typical * shading.irradiance(f)[rows] + np.float32(specular) * shading.reflection(f)[rows]
        radiance = sample_colours(picture, pixels)
        ratio = np.clip(np.log((radiance + LEAST_RADIANCE) / (skin + LEAST_RADIANCE)), -MOST_LOG, MOST_LOG)
        variance = 1.0 / (noise.precision(radiance) * np.square(radiance + LEAST_RADIANCE))
        strength = texture_strength(picture, float(lens[0, 0] / np.median(view.depth)))
        total[rows] += weight
        sums[rows] += weight[:, None] * ratio
        squares[rows] += weight[:, None] * ratio**2
        expected[rows] += weight[:, None] * variance
        spread[rows] += weight * remap(strength, pixels)
    norm = np.maximum(total, 1e-9)[:, None]
    colour = sums / norm
    chi_square = (np.maximum(squares / norm - colour**2, 0.0) / np.maximum(expected / norm, 1e-9)).mean(1)
    seen = total > 0
    return SurfaceFeatures(colour, np.where(seen, spread / norm[:, 0], 0.0),
                           np.where(seen, np.log(chi_square + 1e-2), 0.0), total)


def texture_strength(picture: Picture, px_per_mm: float) -> np.ndarray:
    """[H, W] float32: logarithm of the local standard deviation of the log radiance, structure wider than TEXTURE_MM
    left out."""
    level = np.log(picture.levels[0].mean(-1) + LEAST_RADIANCE)
    fine = level - cv2.GaussianBlur(level, (0, 0), max(TEXTURE_MM * px_per_mm, 0.8))
    power = cv2.GaussianBlur(fine * fine, (0, 0), max(WINDOW_MM * px_per_mm, 0.7))
    return (0.5 * np.log(power + 1e-6)).astype(np.float32)
