"""How far the lids are open in each frame, and the frames in which they are shut.

The lids' margins come from the iris network, which follows a blink; the face mesh's landmarks hardly do. What stays
when the head's pose is taken out is compared with the clip's own open eyes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.compute.robust import ROBUST_SCALE
from shared.geometry.transforms import projection_slope
from shared.tracking.expression import turn_basis

SHUT_READS = 0.1, 0.45
"""Of an eye's open aperture: what the network still reports when it is shut, the more the darker its lashes are. Where
the eye blinks, its own lowest value between these is it."""
SHUT = 0.5
"""Of the aperture of open eyes: lids that leave less are more than half closed."""
LEAST_OPEN = 0.165
"""Of the eye's width: what is no farther open in most frames is shut throughout. Eyes that squint have 0.21, of shut
ones the network reports up to 0.16 in hard light."""
OTHER_EYE = 1.0 / 3.0
"""Lids move together: share that the other eye has in what is said of one."""
UPPER, LOWER, CORNERS = slice(10, 15), slice(2, 7), (0, 8)
"""Of the lids' sixteen points: the middle of both margins, and the outer and inner corner."""
LATE, SLACK = 0.2, 0.25
"""Of the way from shut to open: up to here lids are shut already, see _apertures; and from open on, since apertures of
open eyes wander by that with the pose and the network's noise."""
ROUNDS, NOT_OPEN = 8, 0.8
BIAS_PRIOR, LEAST_LEVEL = 0.3, 0.75
"""Ridge on what of the aperture may follow the pose, a share of the evidence, and the least that it may leave of it: a
blink while the head nods is none of it."""


@dataclass(frozen=True)
class Lids:
    """openness [F, 2]: aperture over that of open eyes, NaN where the eye is not seen; shut [F, 2] bool: lids more than
    half closed; open_mm [2]: apertures of open eyes. Right, then left eye."""

    openness: np.ndarray
    shut: np.ndarray
    open_mm: np.ndarray


def lids_of(lids_px: np.ndarray, centres: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray) -> Lids:
    """lids_px [F, 2, 16, 2] px (shared.capture.iris), NaN where an eye is not seen; centres [2, 3] mm of the eyeballs;
    camera_from_head [F, 4, 4]; intrinsics [3, 3]."""
    apertures, widths = lid_apertures(lids_px, centres, camera_from_head, intrinsics)
    basis = turn_basis(camera_from_head)
    openness, open_mm, opening = np.full(apertures.shape, np.nan), np.full(2, np.nan), np.full((1, 2), np.nan)
    for eye in range(2):
        seen = np.isfinite(apertures[:, eye])
        if seen.any():
            level, open_mm[eye] = _of_open_eyes(apertures[seen, eye], basis[seen])
            openness[seen, eye] = apertures[seen, eye] / level
            opening[0, eye] = open_mm[eye] / np.median(widths[seen, eye])
    shut = _apertures(openness) < SHUT
    always_shut = _together(opening) < LEAST_OPEN
    return Lids(openness, shut | (always_shut & np.isfinite(openness)), open_mm)


def from_shut(openness: np.ndarray) -> np.ndarray:
    """openness [F, 2] of lids -> the same, 0 where it is what the network reads of shut ones, 1 where they are open."""
    lowest = np.min(openness, axis=0, initial=1.0, where=np.isfinite(openness))
    reads = np.where(lowest > SHUT_READS[1], SHUT_READS[0], np.maximum(lowest, SHUT_READS[0]))
    return (openness - reads) / (1.0 - reads)


def _apertures(openness: np.ndarray) -> np.ndarray:
    """openness [F, 2] of lids -> the true apertures, [F, 2]: 0 shut, 1 as the clip's open eyes. The network sees lids
    come down late and open again early: on four synthetic clips that blink the eye is open by the square of what it
    reads, and shut where that is LATE."""
    return _together(np.square(np.clip((from_shut(openness) - LATE) / (1.0 - LATE), 0.0, 1.0)))


def closures(openness: np.ndarray, shut: np.ndarray) -> np.ndarray:
    """openness [F, 2] of lids and shut [F, 2] bool, see Lids -> how far each eye is shut, [F, 2]: 0 as the clip's open
    eyes are, 1 shut. Where an eye is not seen its lids do as the other one's, where neither is, as in the frames before
    and after. Eyes that are shut throughout have no others than themselves: 0."""
    apart = np.where(np.isfinite(openness), openness, openness[:, ::-1])
    known = np.nonzero(np.isfinite(apart).all(1))[0]
    if not len(known):
        return np.zeros_like(openness)
    closed = np.clip((1.0 - _apertures(apart[known]) - SLACK) / (1.0 - SLACK), 0.0, 1.0)
    closed[:, shut[known].all(0)] = 0.0
    return np.stack([np.interp(np.arange(len(openness)), known, own) for own in closed.T], axis=1)


def _together(values: np.ndarray) -> np.ndarray:
    """Values [N, 2] of both eyes, each with a share of the other's where that is known."""
    other = np.where(np.isfinite(values[:, ::-1]), values[:, ::-1], values)
    return (1.0 - OTHER_EYE) * values + OTHER_EYE * other


def lid_apertures(
    lids_px: np.ndarray, centres: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Between the margins' middles along the head's y, and between the corners, each [F, 2] mm at the eyeballs' depth.
    lids_px [F, 2, 16, 2] px, centres [2, 3] mm and the rest as in lids_of."""
    slopes = np.stack([projection_slope(centres, pose, intrinsics) for pose in camera_from_head])
    down, across = slopes[..., 1], slopes[..., 0]
    between = lids_px[:, :, UPPER].mean(2) - lids_px[:, :, LOWER].mean(2)
    corners = lids_px[:, :, CORNERS[1]] - lids_px[:, :, CORNERS[0]]
    return _along(between, down), np.abs(_along(corners, across))


def _along(vectors: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Vectors [..., 2] px in units of a slope [..., 2] px/mm."""
    return (vectors * slope).sum(-1) / np.square(slope).sum(-1)


def _of_open_eyes(apertures: np.ndarray, basis: np.ndarray) -> tuple[np.ndarray, float]:
    """What apertures [F] mm of open eyes are in each pose, [F], and in the middle; basis [F, B]: see turn_basis. Frames
    with lids on their way down count little, shut ones not at all."""
    ridge = BIAS_PRIOR * len(apertures) * np.eye(basis.shape[1])
    ridge[0, 0] = 0.0
    level = np.full(len(apertures), np.percentile(apertures, 70.0))
    for _ in range(ROUNDS):
        spread = max(ROBUST_SCALE * float(np.median(np.abs(apertures - level))), 0.02 * float(np.median(level)))
        below = np.clip((NOT_OPEN * level - apertures) / spread, 0.0, None)
        weight = (1.0 / (1.0 + below**2))[:, None]
        fit = np.linalg.solve(basis.T @ (weight * basis) + ridge, basis.T @ (weight[:, 0] * apertures))
        level = np.maximum(basis @ fit, LEAST_LEVEL * max(fit[0], 1e-6))
    return level, float(fit[0])
