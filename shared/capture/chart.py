"""A 24-patch colour chart (ColorChecker Classic): what its patches reflect, and the light they say falls on it.

The grid counts in patch pitches: x from 0 to 6 along the rows, y from 0 to 4 down, patch k fills column k % 6 and row
k // 6 (dark skin first, black last). Reflectances are those that X-Rite states for charts made after November 2014,
adapted to D65 by Bradford's transform and expressed in linear Rec.709, so that a perfect white diffuser is (1, 1, 1):
the convention of our albedo, in which the colour of the light belongs to the light.

Reference: [Mccamy1976] (the chart).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from shared.compute.robust import cauchy_weight
from shared.imaging.color import XYZ_FROM_REC709

COLUMNS, ROWS = 6, 4
PATCHES = COLUMNS * ROWS
NEUTRAL = np.arange(PATCHES) >= 18
"""The lower row: white to black."""
CORNERS = np.array([[0, 0], [COLUMNS, 0], [COLUMNS, ROWS], [0, ROWS]], float)
"""The grid's corners, beside dark skin, bluish green, black and white, in that order."""

NEUTRAL_SIGMA, COLOURED_SIGMA = 0.03, 0.15
"""Relative deviation of a patch from its stated reflectance: wear and uneven light; and for the coloured ones that a
camera's primaries and the light's spectrum are not those of the table."""
FLOOR = 0.004
"""Deviation that no patch goes below, relative to a white diffuser: what glare and noise leave on dark patches."""
GLARE_SIGMA = 0.02
"""Expected constant part of all patches (specular reflection, flare of the lens), relative to a white diffuser."""
SLOPE_SIGMA = 0.3
"""Expected change of the light from the chart's middle to its edge, relative: a head beside it takes that much."""
LEAST_SIGMA = 0.01
LARGEST_NEUTRAL_ERROR, LARGEST_COLOURED_ERROR = 0.1, 0.4
FEWEST_NEUTRALS = 3


@dataclass(frozen=True)
class ChartFit:
    """white [3]: radiance that a white diffuser in the middle of the chart would have, which is the irradiance over pi;
    sigma [3]: standard deviation of its logarithm; glare [3]: the constant part; weight [24] in 0 .. 1: how well each
    patch agrees with the others; neutral_error, coloured_error: relative deviation (root mean square) of the neutral
    and of the coloured patches; fault: why it should not be used, or empty."""

    white: np.ndarray
    sigma: np.ndarray
    glare: np.ndarray
    weight: np.ndarray
    neutral_error: float
    coloured_error: float
    fault: str = ""


@dataclass(frozen=True)
class ChartObservation:
    """A chart in one frame. corners [4, 2] px of the pictures; values [24, 3]: the patches' linear values; weight
    [24, 3]: their inverse variance relative to a white diffuser's value squared, 0 where they say nothing; white [3]:
    irradiance over pi in the middle; log_sigma [3]: of the patches' word on that; frame: of the poses, the one that
    the chart was seen in, or the nearest; frame_index: of the source."""

    corners: np.ndarray
    values: np.ndarray
    weight: np.ndarray
    white: np.ndarray
    log_sigma: np.ndarray
    frame: int
    frame_index: int

    def over(self, gain: np.ndarray) -> ChartObservation:
        """The same once a gain [3] of the frame is taken out."""
        return replace(self, values=self.values / gain, white=self.white / gain)

    @classmethod
    def from_record(cls, record: dict, crop: tuple[float, float, float], frame_index: np.ndarray) -> ChartObservation:
        """From chart_watch.ChartWatch.record; crop: (x0, y0, scale) of the pictures; frame_index [F] of the poses."""
        clipped, robust = np.array(record["clipped"], bool), np.array(record["weight"])[:, None]
        return cls(
            corners=(np.array(record["corners"]) - crop[:2]) * crop[2],
            values=np.array(record["patches"]),
            weight=usable(clipped) * robust / patch_sigma() ** 2,
            white=np.array(record["white"]),
            log_sigma=np.array(record["log_sigma"]),
            frame=int(np.abs(np.asarray(frame_index) - record["frame_index"]).argmin()),
            frame_index=int(record["frame_index"]),
        )


@lru_cache(maxsize=1)
def reflectances() -> np.ndarray:
    """[24, 3] linear Rec.709 reflectance factors; cyan lies outside the gamut (its red is negative)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses matplotlib, which only its plots need
        import colour

        chart = colour.CCS_COLOURCHECKERS["ColorChecker24 - After November 2014"]
        xyz = colour.xyY_to_XYZ(np.array(list(chart.data.values())))
        whites = [colour.xy_to_XYZ(white) for white in (chart.illuminant, (0.3127, 0.3290))]
        adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(*whites, transform="Bradford")
    return xyz @ adapt.T @ np.linalg.inv(XYZ_FROM_REC709).T


def patch_sigma() -> np.ndarray:
    """[24, 3] standard deviation of a patch's value relative to a white diffuser's."""
    relative = np.where(NEUTRAL, NEUTRAL_SIGMA, COLOURED_SIGMA)[:, None] * np.abs(reflectances())
    return np.sqrt(relative**2 + FLOOR**2)


def usable(clipped: np.ndarray) -> np.ndarray:
    """[24, 3] bool: values that say something; clipped [24, 3] bool and dark coloured ones do not."""
    return ~clipped & (NEUTRAL[:, None] | (reflectances() > 0.03))


def fit_chart(patches: np.ndarray, clipped: np.ndarray) -> ChartFit:
    """The light on the chart, from the patches' mean linear values.

    patches [24, 3]; clipped [24, 3] bool: values that only say "at least". Per channel value = reflectance * (white +
    slope . place) + glare by weighted least squares, reweighted against outliers (Cauchy).
    """
    used = usable(clipped)
    channels = [_fit_channel(patches[:, c], reflectances()[:, c], patch_sigma()[:, c], used[:, c]) for c in range(3)]
    white, sigma, glare, robust, residual = (np.stack(values, -1) for values in zip(*channels, strict=True))
    neutral, coloured = (_rms(residual[used & rows[:, None]]) for rows in (NEUTRAL, ~NEUTRAL))
    fault = ""
    if used[NEUTRAL].sum(0).min() < FEWEST_NEUTRALS:
        fault = "its grey patches are overexposed: expose darker"
    elif not (white > 0).all():
        fault = "its patches do not follow their reflectances"
    elif neutral > LARGEST_NEUTRAL_ERROR:
        fault = (f"its grey patches deviate by {neutral:.0%} from their reflectances: it is shaded in part, or "
                 "colour.transfer is wrong")
    elif coloured > LARGEST_COLOURED_ERROR:
        fault = f"its coloured patches deviate by {coloured:.0%} from their reflectances"
    return ChartFit(white, np.maximum(sigma, LEAST_SIGMA), glare, robust.min(1), neutral, coloured, fault)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _fit_channel(values: np.ndarray, reference: np.ndarray, spread: np.ndarray, used: np.ndarray) -> tuple:
    """White, the deviation of its logarithm, glare, robust weights [24] and the patches' residuals relative to what
    they should be [24]."""
    neutral = used & NEUTRAL
    white = max(float(np.median((values / np.maximum(reference, 0.02))[neutral])), 1e-6) if neutral.any() else 1.0
    place = np.stack(np.divmod(np.arange(PATCHES), COLUMNS)[::-1], 1) + 0.5
    place = place / [COLUMNS / 2, ROWS / 2] - 1.0
    design = np.column_stack([reference, np.ones(PATCHES), reference[:, None] * place])
    prior = np.array([1e6, GLARE_SIGMA, SLOPE_SIGMA, SLOPE_SIGMA])
    robust = np.ones(PATCHES)
    for _ in range(8):
        weight = used * robust / (spread * white) ** 2
        inverse = np.linalg.inv(design.T @ (weight[:, None] * design) + np.diag((prior * white) ** -2.0))
        solved = inverse @ (design.T @ (weight * values))
        error = (values - design @ solved) / (spread * white)
        robust = cauchy_weight(error, 2.5)
        white = max(float(solved[0]), 1e-6)
    freedom = max(used.sum() - len(prior), 1)
    variance_inflation = max(1.0, float((used * robust * error**2).sum()) / freedom)
    residual = (values - design @ solved) / (white * (np.abs(reference) + 0.02))
    deviation = float(np.sqrt(inverse[0, 0] * variance_inflation))
    return float(solved[0]), deviation / white, float(solved[1]), robust, residual
