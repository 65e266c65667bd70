"""How far the borders of a result's lids are from the truth's, as the clip's camera sees them.

What lids leave open of an eyeball is a patch of pixels in the truth and in the result. Both have a signed distance to
their border, and by how much these differ along the true one is how far the lids are off: nothing where the patches are
alike, however coarse the pixels.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from shared.geometry.raycast import RayScene
from shared.geometry.surface import Surface
from shared.geometry.transforms import camera_centres
from tools.scoring.measures import summary

ON_BALL_MM = 0.3
"""Surface so close to the true eyeball is its own: depth is stored in steps of half a millimetre."""
LEAST_PIXELS = 12
"""Of an opening: fewer show no border."""


def opening_of_truth(
    depth: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray, centre: np.ndarray, radius: float
) -> np.ndarray:
    """[H, W] bool: pixels that show an eyeball of centre [3] and radius, mm; depth [H, W] mm of the true surface, 0
    beside it; camera_from_head [4, 4], intrinsics [3, 3]."""
    place = _rays(depth.shape, intrinsics) * depth[..., None]
    arm = (place - camera_from_head[:3, 3]) @ camera_from_head[:3, :3] - centre
    return (depth > 0) & (np.abs(np.linalg.norm(arm, axis=-1) - radius) < ON_BALL_MM)


def opening_of_result(
    surface: Surface, near: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """[H, W] bool: which of the pixels near [H, W] bool show an eyeball of the surface; the rest as in
    opening_of_truth."""
    directions = _rays(near.shape, intrinsics)[near] @ camera_from_head[:3, :3]
    origins = np.broadcast_to(camera_centres(camera_from_head[None])[0], directions.shape)
    face, _, _ = RayScene(surface.mesh.vertices, surface.mesh.faces).intersect(origins, directions)
    found = np.zeros(near.shape, bool)
    found[near] = (face >= 0) & surface.faces_of(("eyes",))[face]
    return found


def border_distances(truth: np.ndarray, found: np.ndarray) -> np.ndarray:
    """[n] px: how far apart the borders of two openings [H, W] bool are, at pixels on both sides of the true one."""
    true, other = _signed_distance(truth), _signed_distance(found)
    return np.abs(other - true)[np.abs(true) < 1.0]


def lid_margin_errors(pairs: Iterable[tuple[np.ndarray, np.ndarray, float]]) -> dict | None:
    """summary of the distances, mm, over pairs of openings [H, W] bool and the size of a pixel there, mm; None where no
    pair shows a border."""
    apart = [border_distances(truth, found) * pixel_mm for truth, found, pixel_mm in pairs
             if min(truth.sum(), found.sum()) >= LEAST_PIXELS]
    return {"openings": len(apart), **summary(np.concatenate(apart))} if apart else None


def _rays(shape: tuple[int, int], intrinsics: np.ndarray) -> np.ndarray:
    """[H, W, 3]: directions through the pixels' centres, 1 along the camera's axis."""
    row, column = np.indices(shape)
    across = (np.stack([column, row], -1) + 0.5 - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]]
    return np.concatenate([across, np.ones((*shape, 1))], -1)


def _signed_distance(inside: np.ndarray) -> np.ndarray:
    """[H, W] px from each pixel's centre to the border, which runs between pixels; negative outside."""
    to_outside, to_inside = (
        cv2.distanceTransform(some.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for some in (inside, ~inside)
    )
    return np.where(inside, to_outside - 0.5, 0.5 - to_inside)
