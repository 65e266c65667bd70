"""What the frames show of surface points, with the slope of the picture there: where a point moves, it reads what is
beside it.

Pictures are blurred to what the points can resolve, so that colour and slope belong together and noise averages out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from shared.compute.read_ahead import read_ahead
from shared.compute.run_context import RunContext
from shared.geometry.transforms import project, projection_slope
from shared.imaging.image_sampling import Picture, SurfaceViewer, remap, sample_inside, sample_saturation
from shared.imaging.views import Views

LEAST_BLUR_PX = 0.3
MARGIN_PX = 8
"""Around the part of a picture that shows the points: farther no step moves them."""


@dataclass(frozen=True)
class SurfaceSamples:
    """P points in F frames.

    colours [P, F, 3] linear; gradient [P, F, 3, 2] float16, per pixel; pixels_per_mm [P, F, 2, 3]: derivative of the
    pixel by the point's place in head space; weight [P, F] (0: not seen); saturation int8 [P, F, 3] as in Samples.
    """

    colours: np.ndarray
    gradient: np.ndarray
    pixels_per_mm: np.ndarray
    weight: np.ndarray
    saturation: np.ndarray

    def points(self, index: slice | np.ndarray) -> SurfaceSamples:
        """The samples of some points."""
        arrays = (self.colours, self.gradient, self.pixels_per_mm, self.weight, self.saturation)
        return SurfaceSamples(*(array[index] for array in arrays))


@dataclass(frozen=True)
class SurfaceView:
    """What P points need of a frame: the part of the picture that shows them, blurred and in half floats, whose first
    pixel is at origin (x, y); weight [P] (0: not seen)."""

    picture: Picture
    origin: tuple[int, int]
    weight: np.ndarray


def look_at_surface(
    viewer: SurfaceViewer, index: np.ndarray, views: Views, blur_mm: float, context: RunContext
) -> list[SurfaceView]:
    """The vertices index [P] in F views, as often as they are then sampled after small moves.

    Pictures are read once, in order; blur_mm: standard width of the blur on the surface.
    """
    found = []
    viewer, index = viewer.limited_to(index)
    pictures = read_ahead(map(views.picture, context.progress(range(len(views)), "shape, sampling")))
    for pose, lens, picture in zip(views.camera_from_head, views.intrinsics, pictures, strict=True):
        view = viewer.view(pose, lens, picture.inside.shape[::-1])
        weight = view.weight[index]
        seen = index[weight > 0]
        if len(seen) == 0:
            found.append(SurfaceView(picture, (0, 0), weight))
            continue
        sigma = blur_mm * float(lens[0, 0]) / float(np.median(view.depth[seen]))
        low = np.maximum(np.floor(view.pixels[seen].min(0)).astype(int) - MARGIN_PX, 0)
        high = np.ceil(view.pixels[seen].max(0)).astype(int) + MARGIN_PX
        part = slice(low[1], high[1]), slice(low[0], high[0])
        image = picture.levels[0]
        if sigma > LEAST_BLUR_PX:
            image = cv2.GaussianBlur(image, (0, 0), sigma)
        cut = Picture((image[part].astype(np.float16),), picture.saturation[part].copy(), picture.inside[part].copy())
        found.append(SurfaceView(cut, (int(low[0]), int(low[1])), weight))
    return found


def sample_surface(
    positions: np.ndarray, views: list[SurfaceView], camera_from_head: np.ndarray, intrinsics: np.ndarray
) -> SurfaceSamples:
    """Samples of P points at positions [P, 3] mm in the views of F frames, camera_from_head [F, 4, 4] and intrinsics
    [F, 3, 3] px."""
    shape = (len(positions), len(camera_from_head))
    colours, saturation = np.zeros(shape + (3,), np.float32), np.zeros(shape + (3,), np.int8)
    gradient = np.zeros(shape + (3, 2), np.float16)
    slope, weight = np.zeros(shape + (2, 3), np.float32), np.zeros(shape, np.float32)
    for f, (view, pose, lens) in enumerate(zip(views, camera_from_head, intrinsics, strict=True)):
        seen = np.nonzero(view.weight > 0)[0]
        if len(seen) == 0:
            continue
        points, image = positions[seen], view.picture.levels[0].astype(np.float32)
        pixels = project(points, pose, lens)[0] - view.origin
        # Central differences see what linear interpolation between the pixels will.
        along_x = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
        along_y = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
        colours[seen, f] = np.maximum(remap(image, pixels), 0.0)
        gradient[seen, f] = np.stack([remap(along_x, pixels), remap(along_y, pixels)], axis=-1)
        slope[seen, f] = projection_slope(points, pose, lens)
        saturation[seen, f] = sample_saturation(view.picture.saturation, pixels)
        weight[seen, f] = view.weight[seen] * sample_inside(view.picture, pixels)
    return SurfaceSamples(colours, gradient, slope, weight, saturation)
