"""How far the borders of a result's lids are from the truth's, as the clip's camera sees them.

What lids leave open of an eyeball is a patch of pixels in the truth and in the result. The area between their borders,
over the length of the true one, is how far the lids are off, in each of some sectors about the patch's middle: nothing
where the patches are alike, and fractions of a pixel where they hardly differ, since a border a third of a pixel away
leaves out a third of the pixels' middles along it.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from shared.geometry.raycast import RayScene, camera_hits
from tools.scoring.gaze import seen_places
from tools.scoring.measures import summary

ON_BALL_MM = 0.3
"""Surface so close to the true eyeball is its own: depth is stored in steps of half a millimetre."""
LEAST_PIXELS = 12
"""Of an opening: fewer show no border."""
SECTORS, STEPS = 16, 32
"""Parts of a border whose offsets are told apart, and steps of each in which its length is summed up."""


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


def border_offsets(truth: np.ndarray, found: np.ndarray) -> np.ndarray:
    """[SECTORS] px: how far apart the borders of two openings [H, W] bool are, around the true one. Its border is as
    long as that of the ellipse with its second moments, whose axes also make the sectors equal."""
    row, column = np.nonzero(truth)
    middle = np.array([column.mean(), row.mean()])
    spread, axes = np.linalg.eigh(np.cov(np.stack([column, row]), bias=True))
    half = 2.0 * np.sqrt(spread)
    row, column = np.nonzero(truth ^ found)
    around = (np.stack([column, row], axis=1) - middle) @ axes / half
    turn = np.arctan2(around[:, 1], around[:, 0]) / (2.0 * np.pi) + 0.5
    area = np.bincount(np.minimum((SECTORS * turn).astype(int), SECTORS - 1), minlength=SECTORS)
    angle = 2.0 * np.pi * (np.arange(SECTORS * STEPS + 1) / (SECTORS * STEPS) - 0.5)
    border = np.stack([half[0] * np.cos(angle), half[1] * np.sin(angle)], axis=1)
    return area / np.linalg.norm(np.diff(border, axis=0), axis=1).reshape(SECTORS, STEPS).sum(1)


def lid_margin_errors(pairs: Iterable[tuple[np.ndarray, np.ndarray, float]]) -> dict | None:
    """summary of the offsets, mm, over pairs of openings [H, W] bool and the size of a pixel there, mm; None where no
    pair shows a border."""
    apart = [border_offsets(truth, found) * pixel_mm for truth, found, pixel_mm in pairs
             if min(truth.sum(), found.sum()) >= LEAST_PIXELS]
    return {"openings": len(apart), **summary(np.concatenate(apart))} if apart else None
