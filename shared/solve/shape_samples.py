"""What the frames show of surface points, with the slope of the picture there: where a point moves, it reads what is
beside it.

Pictures are blurred to what the points can resolve, so that colour and slope belong together and noise averages out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from shared.gather import Picture, SurfaceViewer, remap, sample_inside, sample_limits
from shared.mesh import normalised


@dataclass(frozen=True)
class SurfaceSamples:
    """P points in F frames.

    colours [P, F, 3] linear; gradient [P, F, 3, 2] float16, per pixel; pixels_per_mm [P, F, 2, 3]: derivative of the
    pixel by the point's place in head space; weight [P, F] (0: not seen); limits int8 [P, F, 3] as in gather.Samples.
    """

    colours: np.ndarray
    gradient: np.ndarray
    pixels_per_mm: np.ndarray
    weight: np.ndarray
    limits: np.ndarray

    def points(self, index: slice | np.ndarray) -> SurfaceSamples:
        """The samples of some points."""
        arrays = (self.colours, self.gradient, self.pixels_per_mm, self.weight, self.limits)
        return SurfaceSamples(*(array[index] for array in arrays))


def tangent_frames(normals: np.ndarray) -> np.ndarray:
    """[P, 3] unit normals -> [P, 2, 3]: two unit tangents at right angles to each other."""
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = normalised(np.cross(normals, axis))
    return np.stack([first, np.cross(normals, first)], axis=1)


def projection_slope(points: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """[P, 2, 3]: derivative of the pixels by the points [P, 3] in head space, pose [4, 4]."""
    in_camera = points @ camera_from_head[:3, :3].T + camera_from_head[:3, 3]
    depth = in_camera[:, 2:]
    focal = intrinsics[[0, 1], [0, 1]]
    slope = np.zeros((len(points), 2, 3))
    slope[:, 0, 0], slope[:, 1, 1] = focal[0] / depth[:, 0], focal[1] / depth[:, 0]
    slope[:, :, 2] = -focal * in_camera[:, :2] / depth**2
    return slope @ camera_from_head[:3, :3]


def picture_and_gradient(picture: Picture, sigma_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The blurred picture and its derivatives along x and along y per pixel, each [H, W, 3] float32."""
    image = picture.levels[0]
    if sigma_px > 0.3:
        image = cv2.GaussianBlur(image, (0, 0), sigma_px)
    # Central differences see what linear interpolation between the pixels will.
    along_x = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    along_y = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    return image, along_x, along_y


def gather_surface(
    viewer: SurfaceViewer,
    index: np.ndarray,
    pictures: Iterable[Picture],
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    blur_mm: float,
) -> SurfaceSamples:
    """Samples of the vertices index [P] in F frames.

    pictures: F, read once in order; camera_from_head [F, 4, 4]; intrinsics [3, 3] or [F, 3, 3]; blur_mm: standard
    width of the blur on the surface.
    """
    shape = (len(index), len(camera_from_head))
    intrinsics = np.broadcast_to(intrinsics, (len(camera_from_head), 3, 3))
    colours, limits = np.zeros(shape + (3,), np.float32), np.zeros(shape + (3,), np.int8)
    gradient = np.zeros(shape + (3, 2), np.float16)
    slope, weight = np.zeros(shape + (2, 3), np.float32), np.zeros(shape, np.float32)
    for f, picture in enumerate(pictures):
        pose, lens = camera_from_head[f], intrinsics[f]
        view = viewer.view(pose, lens, picture.inside.shape[::-1])
        seen = np.nonzero(view.weight[index] > 0)[0]
        if len(seen) == 0:
            continue
        pixels = view.pixels[index[seen]]
        sigma = blur_mm * float(lens[0, 0]) / float(np.median(view.depth[index[seen]]))
        colour, along_x, along_y = (remap(image, pixels) for image in picture_and_gradient(picture, sigma))
        colours[seen, f] = np.maximum(colour, 0.0)
        gradient[seen, f] = np.stack([along_x, along_y], axis=-1)
        slope[seen, f] = projection_slope(viewer.mesh.vertices[index[seen]], pose, lens)
        limits[seen, f] = sample_limits(picture, pixels)
        weight[seen, f] = view.weight[index[seen]] * sample_inside(picture, pixels)
    return SurfaceSamples(colours, gradient, slope, weight, limits)
