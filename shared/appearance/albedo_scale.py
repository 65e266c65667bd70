"""The factor per colour channel between light and albedo: what the clip cannot say, said by stated priors, and by the
whites of the eyes, a grey place or a colour chart where they are in view.

Twice the light on half the albedo gives the same diffuse picture. Three statements fix the factor, each a normal
distribution over logarithms, and the whites of the eyes (eye_whites) and a chart (chart_scale) are others:

- skin's luminance: log Y is normal about the median of measured people with the spread of all tones;
- skin's chroma lies on the locus of measured skins: log R/G and log B/G are linear in log Y, sigma as found there
  (measured_skin);
- the light on the skin is white after the camera's own white balance: log R/G and log B/G ~ N(0, 0.15); or has the
  tint that a grey place shows (light_tint), where one is named.

A fourth only keeps the skin's brightest places from returning more than any skin does.

With u [3] the log of the mean irradiance on the skin and y [3] the log of the mean radiance that it returns, albedo is
exp(y - u) and all of it is one quadratic in u, but for the fourth and for highlights. Steps take the most likely
factor; the solution has the one that is expected in the mean (fit.at_mean_scale).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import norm
from scipy.stats.qmc import Sobol

from shared.appearance.light_tint import LightTint
from shared.appearance.measured_skin import (
    BRIGHTEST_ALBEDO,
    LUMINANCE_SIGMA,
    MEDIAN_LOG_LUMINANCE,
    SKIN_LOCUS,
    TYPICAL_SKIN,
)
from shared.imaging.color import LUMINANCE

WHITE_SIGMA = 0.15
BRIGHTEST, BRIGHTEST_SIGMA = 0.95, 0.05
"""The quantile of the skin's albedo that BRIGHTEST_ALBEDO bounds, and how far beyond, in the logarithm, it may lie."""
HIGHLIGHT_SIGMA = 0.08
"""Relative standard deviation of a specular intensity that the clip shows."""
POINTS, PROPOSAL_WIDTH = 2048, 1.5
"""Of the importance sampling, and by how much it reaches farther than the normal distribution of the same curvature."""
NINE_OF_TEN = 1.645
"""Standard deviations to both sides of a normal distribution's mean that hold nine tenths of it."""
LEAST_LEFT = 0.02
"""Of the diffuse radiance, at least, where highlights grow with the light."""
MODEL_ERROR = 0.003
"""Share of the diffuse radiance that passes for highlights where shape or visibility are a little off."""


@dataclass(frozen=True)
class Highlights:
    """Per channel [3]: the specular intensity that fits best with the light as it is, the precision of that, and the
    diffuse radiance relative to the specular one, by which errors of the diffuse model are magnified."""

    intensity: np.ndarray
    precision: np.ndarray
    diffuse_share: np.ndarray


class ResolvedScale(NamedTuple):
    """The most likely log_factor [3] on the light and the specular intensity; the covariance [3, 3] of the former, of
    all statements together, and prior_covariance [3, 3] of those on skin and light alone, which say something of any
    clip; beyond [4]: from the most likely to the mean, of the log factor and of the log intensity."""

    log_factor: np.ndarray
    specular: float
    covariance: np.ndarray
    prior_covariance: np.ndarray
    beyond: np.ndarray = np.zeros(4)

    def describe(self, skin: np.ndarray) -> dict:
        """What solve.json says of how well skin's albedo [3] is known: deviations of logarithms, the interval that
        holds it nine times of ten, and how much of that is known without the clip, as the precision of the priors on
        skin and light over that of everything."""
        luminance = LUMINANCE * skin / (LUMINANCE @ skin)
        of = {"luminance": luminance, "red_over_green": np.array([1.0, -1.0, 0.0]),
              "blue_over_green": np.array([0.0, -1.0, 1.0])}
        sigma = {name: float(np.sqrt(row @ self.covariance @ row)) for name, row in of.items()}
        reach = np.exp(NINE_OF_TEN * np.sqrt(np.diag(self.covariance)))
        return {
            "log_sigma": {name: round(value, 4) for name, value in sigma.items()},
            "skin_albedo_90": np.round([skin / reach, skin * reach], 4).tolist(),
            "prior_share": round(sigma["luminance"] ** 2 / float(luminance @ self.prior_covariance @ luminance), 4),
        }


def scale_prior(
    log_radiance: np.ndarray,
    white_sigma: float = WHITE_SIGMA,
    relative_light: np.ndarray | None = None,
    tints: Sequence[LightTint | None] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """The priors as residuals A u - b of unit variance in u = log mean irradiance [3], given y = log_radiance [3].

    relative_light [L, 3]: log irradiance of several lights relative to u; each is expected to be white by itself, or to
    have its own tint where that was measured. tints: of the L lights, None where nothing is known; empty: of none.
    Luminance enters linearised: d log Y = sum_c share_c d log a_c, with the shares of a typical skin.
    """
    locus = SKIN_LOCUS
    share = LUMINANCE * TYPICAL_SKIN / (LUMINANCE @ TYPICAL_SKIN)
    constant = float(MEDIAN_LOG_LUMINANCE - share @ np.log(TYPICAL_SKIN))
    ratio = np.array([[1.0, -1.0, 0.0], [0.0, -1.0, 1.0]])
    # Rows act on log albedo q = y - u: value = row @ q + const.
    rows, targets, sigmas = [share], [locus.mean_log_luminance - constant], [LUMINANCE_SIGMA]
    for k in range(2):
        rows.append(ratio[k] - locus.slope[k] * share)
        targets.append(locus.offset[k] + locus.slope[k] * (constant - locus.mean_log_luminance))
        sigmas.append(locus.sigma[k])
    rows, targets, sigmas = np.array(rows), np.array(targets), np.array(sigmas)
    on_skin = -rows / sigmas[:, None]
    right = (targets - rows @ log_radiance) / sigmas
    relative = np.zeros((1, 3)) if relative_light is None else relative_light
    white = LightTint((0.0, 0.0), (white_sigma, white_sigma))
    expected = [tint or white for tint in tints] or [white] * len(relative)
    of_light = [ratio / np.array(tint.sigma)[:, None] for tint in expected]
    wanted = [(tint.log_ratios - ratio @ own) / tint.sigma for tint, own in zip(expected, relative, strict=True)]
    return np.concatenate([on_skin, *of_light]), np.concatenate([right, *wanted])


def most_likely_irradiance(
    log_radiance: np.ndarray,
    white_sigma: float = WHITE_SIGMA,
    relative_light: np.ndarray | None = None,
    tints: Sequence[LightTint | None] = (),
) -> np.ndarray:
    """u [3]: the log mean irradiance that the priors alone prefer for skin of log mean radiance y [3]. log_radiance
    [3]; relative_light [L, 3], tints: see scale_prior."""
    matrix, right = scale_prior(log_radiance, white_sigma, relative_light=relative_light, tints=tints)
    return np.linalg.lstsq(matrix, right, rcond=None)[0]


def resolve_scale(
    log_albedo: np.ndarray,
    log_irradiance: np.ndarray,
    highlights: Highlights | None,
    specular_prior: tuple[float, float],
    white_sigma: float = WHITE_SIGMA,
    chart: tuple[np.ndarray, np.ndarray] | None = None,
    relative_light: np.ndarray | None = None,
    log_brightest: np.ndarray | None = None,
    whites: tuple[np.ndarray, np.ndarray] | None = None,
    tints: Sequence[LightTint | None] = (),
    shine: np.ndarray | None = None,
) -> ResolvedScale:
    """The factor on the light per channel and the specular intensity that are jointly most likely.

    The lobe returns the light's own colour and its strength has a known range, so highlights say something about the
    scale that diffuse skin cannot: with the light multiplied by k, channel c wants s k_c = t_c. log_albedo,
    log_irradiance [3] are the skin's present means; specular_prior: mean of s and standard deviation of its logarithm;
    chart: the log factor [3] on the light that a colour chart asks for, and its covariance [3, 3]; relative_light and
    tints: see scale_prior; log_brightest [3]: log of the skin's present albedo at the quantile BRIGHTEST, None: it is
    not asked; whites: as chart, of the whites of the eyes; shine [3]: radiance, relative to the diffuse one, of
    highlights that the model has but that say nothing, None: it has none. They grow with the light and take what they
    gain from the albedo, which gets darker and redder by it: taken for the tint of darker skin, that would ask for ever
    more light.
    With a chart the highlights give s alone: on the scale their range has little to add, and the model's errors pass
    for highlights.
    -> log k and s, without highlights the prior's mean of s; how far the mean lies from there, with highlights only;
    and the covariance: mean_of_density's where highlights or a bound take part, else the normal distribution's.
    """
    log_radiance = log_albedo + log_irradiance
    matrix, right = scale_prior(log_radiance, white_sigma, relative_light=relative_light)
    prior_covariance = np.linalg.inv(matrix.T @ matrix)
    matrix, right = scale_prior(log_radiance, white_sigma, relative_light=relative_light, tints=tints)
    for wanted, covariance in filter(None, (chart, whites)):
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        matrix = np.concatenate([matrix, whitening])
        right = np.concatenate([right, whitening @ (log_irradiance + wanted)])
    right = right - matrix @ log_irradiance
    mean, sigma = specular_prior
    alone = np.linalg.lstsq(matrix, right, rcond=None)[0]
    spread = None if highlights is None else _highlight_spread(highlights, mean)

    def on_highlights(log_factor: np.ndarray, log_intensity: np.ndarray) -> np.ndarray:
        amplitude = (np.exp(log_intensity + log_factor) - highlights.intensity) / spread
        robust = np.sign(amplitude) * np.sqrt(2.0 * (np.sqrt(1.0 + amplitude**2) - 1.0))
        return np.concatenate([robust, (log_intensity - np.log(mean)) / sigma], axis=-1)

    if chart is not None:
        specular = mean
        if highlights is not None:
            solved = least_squares(lambda x: on_highlights(alone, x), [np.log(mean)], method="lm")
            specular = float(np.exp(solved.x[0]))
        return ResolvedScale(alone, specular, np.linalg.inv(matrix.T @ matrix), prior_covariance)

    def taken(x: np.ndarray) -> np.ndarray:
        if shine is None:
            return np.zeros_like(x[..., :3])
        return np.log(np.maximum(1.0 + shine * (1.0 - np.exp(x[..., :3])), LEAST_LEFT))

    def on_skin(x: np.ndarray) -> np.ndarray:
        said = x[..., :3] @ matrix.T - right
        said[..., :3] -= taken(x) @ matrix[:3].T
        return said

    def too_bright(x: np.ndarray) -> np.ndarray:
        if log_brightest is None:
            return np.zeros((*x.shape[:-1], 3))
        return np.maximum(log_brightest - x[..., :3] + taken(x) - np.log(BRIGHTEST_ALBEDO), 0.0) / BRIGHTEST_SIGMA

    if highlights is None:
        # Measured skins keep to the bound by themselves: it tells nothing new of what they alone expect. But where
        # the mode lies on it, its curvature is not what is known.
        start = alone if shine is None else np.zeros(3)
        mode = least_squares(lambda x: np.concatenate([on_skin(x), too_bright(x)]), start, method="lm").x
        if log_brightest is None:
            covariance = np.linalg.inv(matrix.T @ matrix)
        else:
            _, covariance = mean_of_density(on_skin, too_bright, mode)
        return ResolvedScale(mode, mean, covariance, prior_covariance)

    def stated(x: np.ndarray) -> np.ndarray:
        return np.concatenate([on_skin(x), on_highlights(x[..., :3], x[..., 3:])], axis=-1)

    start = np.append(alone, np.log(mean))
    mode = least_squares(lambda x: np.concatenate([stated(x), too_bright(x)]), start, method="lm").x
    expected, covariance = mean_of_density(stated, too_bright, mode)
    return ResolvedScale(mode[:3], float(np.exp(mode[3])), covariance[:3, :3], prior_covariance, expected - mode)


def mean_of_density(
    stated: Callable[[np.ndarray], np.ndarray], bounding: Callable[[np.ndarray], np.ndarray], mode: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [n] and covariance [n, n] of the density exp(-(|stated(x)|^2 + |bounding(x)|^2) / 2), n up to 4.

    stated, bounding: residuals [..., m] of x [..., n]; the latter are 0 but beyond a bound. mode [n]: of the density.
    Where a bound cuts it, the mode lies on the bound and the curvature there is the bound's own, while most of the
    density lies within: so neither mode nor Laplace's approximation will do. Importance sampling about the mode
    [Geweke1989], with pairs of opposite points, by which the mean of a normal density is exact.
    """
    jacobian = least_squares(stated, mode, method="lm", max_nfev=1).jac
    unbounded = np.linalg.inv(jacobian.T @ jacobian)
    normal = _opposite_points(len(mode))
    x = mode + PROPOSAL_WIDTH * normal @ np.linalg.cholesky(unbounded).T
    log_density = -0.5 * (np.square(stated(x)).sum(1) + np.square(bounding(x)).sum(1))
    log_weight = log_density + 0.5 * np.square(normal).sum(1)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean = weight @ x
    return mean, (weight[:, None] * (x - mean)).T @ (x - mean)


@cache
def _opposite_points(dimensions: int) -> np.ndarray:
    """[2 POINTS, dimensions]: points of a normal distribution, the same each time, each with its opposite."""
    points = norm.ppf(Sobol(dimensions, rng=np.random.default_rng(0)).random(POINTS))
    return np.concatenate([points, -points])


def _highlight_spread(highlights: Highlights, mean_intensity: float) -> np.ndarray:
    """Standard deviation [3] of the intensities: the diffuse model's errors and, where highlights are faint or few,
    what the samples leave open. Beyond it the loss is pseudo-Huber: channels that contradict skin have met something
    else, and yet there is one answer only, which moves by a little where the highlights do.
    """
    relative = HIGHLIGHT_SIGMA * highlights.diffuse_share / highlights.diffuse_share.mean()
    modelled = (relative * np.maximum(highlights.intensity, mean_intensity)) ** 2
    passing = (mean_intensity * MODEL_ERROR * highlights.diffuse_share) ** 2
    return np.sqrt(modelled + 1.0 / highlights.precision + passing)
