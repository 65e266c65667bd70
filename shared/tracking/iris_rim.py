"""The rims of a person's irises, measured in the mean picture of each eye (shared.tracking.iris_texture).

The iris network's circles sit up to a millimetre beside the irises and are up to a tenth too small, by the same in all
frames of a clip. In the mean picture the rim is plain: brightness of iris and white, each a smooth function of the
direction from the iris' centre, with a soft step between them. Both eyes' circles, of one radius, are fitted to it;
what lids hide is left out, and where they leave little the network's circle holds.

The soft step in place of a sharp one follows the limbus, which is some half millimetre wide; circles as places of the
steepest step: [Daugman1993].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.special import ndtr

from shared.compute.robust import ROBUST_SCALE, cauchy_weight

RING_MM, FADING_MM = 2.6, 0.6
"""Samples count that are so near to the rim; the last of it fades."""
LIMBUS_MM, LIMBUS_SIGMA = 0.45, 0.5
"""Deviation of the soft step, and the spread of its logarithm."""
CENTRE_SIGMA_MM, RADIUS_SIGMA, LARGEST = (0.6, 0.4), 0.06, 3.0
"""How far the network's circle may be off across and along the face, and the logarithm of its radius; at most so many
times as far."""
CORRELATED_MM = 1.2
"""Across: so large an area of what the model leaves counts as one sample."""
ROUNDS, OUTLIER, LEAST_NOISE = 10, 2.0, 1.0
"""Times that outliers lose their pull; deviations at which they begin to; deviation of brightness at best, codes."""
RIDGE = 1e-3
"""Of the brightnesses' coefficients, as a share of a sample each: directions of which nothing is seen have no own."""


@dataclass(frozen=True, eq=False)
class MeanPicture:
    """places [N, 2] mm across and up the face, as seen along the gaze, from where the iris' centre was believed to be;
    brightness [N] codes; seen [N] in [0, 1]: how much each counts; spacing_mm between them."""

    places: np.ndarray
    brightness: np.ndarray
    seen: np.ndarray
    spacing_mm: float


def fit_rims(pictures: Sequence[MeanPicture], radius_mm: float) -> tuple[np.ndarray, float]:
    """The circles of E eyes: centres [E, 2] mm, see MeanPicture.places, and their one radius in mm; radius_mm: the
    network's."""
    spread = np.r_[np.tile(CENTRE_SIGMA_MM, len(pictures)), RADIUS_SIGMA, np.full(len(pictures), LIMBUS_SIGMA)]
    found, limits = np.zeros(len(spread)), (-LARGEST * spread, LARGEST * spread)
    pulls = [np.ones(len(picture.places)) for picture in pictures]
    for _ in range(ROUNDS):
        weights, gains = [], []
        for eye, picture in enumerate(pictures):
            centre, radius, limbus = _circle(found, eye, radius_mm)
            ring = _ring(picture, centre, radius)
            left = _left(picture, ring * pulls[eye], centre, radius, limbus)
            near = np.abs(left[ring > 0.5]) if (ring > 0.5).any() else np.zeros(1)
            noise = max(ROBUST_SCALE * float(np.median(near)), LEAST_NOISE)
            pulls[eye] = cauchy_weight(left, OUTLIER * noise)
            weights.append(ring * pulls[eye])
            gains.append(min(picture.spacing_mm / CORRELATED_MM, 1.0) / noise)
        given = pictures, weights, gains, radius_mm, spread
        found = least_squares(_residuals, found, args=given, x_scale=spread, bounds=limits).x
    return found[: 2 * len(pictures)].reshape(-1, 2), radius_mm * float(np.exp(found[2 * len(pictures)]))


def _residuals(
    values: np.ndarray,
    pictures: Sequence[MeanPicture],
    weights: Sequence[np.ndarray],
    gains: Sequence[float],
    radius_mm: float,
    spread: np.ndarray,
) -> np.ndarray:
    """What the circles of values, see _circle, leave of each picture and of what is expected of them, in deviations."""
    parts = [values / spread]
    for eye, (picture, weight, gain) in enumerate(zip(pictures, weights, gains, strict=True)):
        centre, radius, limbus = _circle(values, eye, radius_mm)
        parts.append(gain * np.sqrt(weight) * _left(picture, weight, centre, radius, limbus))
    return np.concatenate(parts)


def _circle(values: np.ndarray, eye: int, radius_mm: float) -> tuple[np.ndarray, float, float]:
    """Centre [2] mm, radius mm and limbus mm of an eye among the unknowns: centres (2 E), the logarithm of the radius'
    growth, logarithms of the limbus' (E)."""
    eyes = len(values) // 3
    grown, softened = np.exp(values[[2 * eyes, 2 * eyes + 1 + eye]])
    return values[2 * eye : 2 * eye + 2], radius_mm * grown, LIMBUS_MM * softened


def _ring(picture: MeanPicture, centre: np.ndarray, radius: float) -> np.ndarray:
    """[N]: how much each sample counts by its distance from the rim and by what is seen of it."""
    off = np.abs(np.linalg.norm(picture.places - centre, axis=1) - radius)
    return picture.seen * np.clip((RING_MM - off) / FADING_MM, 0.0, 1.0)


def _left(picture: MeanPicture, weight: np.ndarray, centre: np.ndarray, radius: float, limbus: float) -> np.ndarray:
    """[N] codes: what the best brightnesses of iris and white leave, by least squares with weight [N]."""
    arm = picture.places - centre
    off = np.linalg.norm(arm, axis=1)
    cosine, sine = (arm / np.maximum(off, 1e-9)[:, None]).T
    white = ndtr((off - radius) / limbus)
    inside = [np.ones_like(off), cosine, sine, cosine**2 - sine**2, off - radius]
    outside = [np.ones_like(off), cosine, sine]
    terms = np.stack([*((1.0 - white) * term for term in inside), *(white * term for term in outside)], axis=1)
    normal = (weight[:, None] * terms).T @ terms + RIDGE * np.eye(terms.shape[1])
    return terms @ np.linalg.solve(normal, terms.T @ (weight * picture.brightness)) - picture.brightness
