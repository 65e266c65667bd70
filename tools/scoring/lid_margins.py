"""How far the borders of a result's lids are from the truth's, as the clip's camera sees them.

What lids leave open of an eyeball is a patch of pixels in the truth and in the result. Both have a signed distance to
their border, and by how much these differ along the true one is how far the lids are off: nothing where the patches are
alike, however coarse the pixels.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from shared.geometry.raycast import RayScene, camera_hits
from tools.scoring.gaze import seen_places
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
    away = np.linalg.norm(seen_places(depth, camera_from_head, intrinsics) - centre, axis=-1)
    return (depth > 0) & (np.abs(away - radius) < ON_BALL_MM)


def opening_of_result(
    scene: RayScene, eyes: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """[H, W] bool: which pixels of a picture of size (width, height) show an eyeball of a mesh; eyes [F] bool: its
    faces; the rest as in opening_of_truth."""
    width, height = size
    face, _, _ = camera_hits(scene, camera_from_head, intrinsics, width, height)
    return (face >= 0) & eyes[face]


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


def _signed_distance(inside: np.ndarray) -> np.ndarray:
    """[H, W] px from each pixel's centre to the border, which runs between pixels; negative outside."""
    to_outside, to_inside = (
        cv2.distanceTransform(some.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for some in (inside, ~inside)
    )
    return np.where(inside, to_outside - 0.5, 0.5 - to_inside)
