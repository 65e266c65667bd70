"""A textured plane before a camera: where each of its points is seen is known."""

import cv2
import numpy as np
from shapes import grid_plane

from shared.geometry.raycast import RayScene, camera_hits

LENS = np.array([[900.0, 0, 120], [0, 900.0, 120], [0, 0, 1]])
SIZE = 240
PLANE = grid_plane(9, extent=180.0)


def plane_texture(size, scales, contrast):
    """float32 [size, size] codes about 128: noise whose detail begins at each of the scales, in texels."""
    rng = np.random.default_rng(0)
    noise = sum(cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), s) * s for s in scales)
    return (128 + contrast * noise / noise.std()).clip(10, 245).astype(np.float32)


def see_plane(pose, image):
    """What the camera sees of the plane with the image on it, [SIZE, SIZE], and where it sees it."""
    face, bary, _ = camera_hits(RayScene(PLANE.vertices, PLANE.faces), pose, LENS, SIZE, SIZE)
    uv = (PLANE.uvs[PLANE.faces[np.maximum(face, 0)]] * bary[..., None]).sum(2)
    at = (uv * [image.shape[1], -image.shape[0]] + [0, image.shape[0]] - 0.5).astype(np.float32)
    return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR), face >= 0
