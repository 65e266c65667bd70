"""How skin varies over a face: the prior that keeps a room's colours out of the albedo.

What a light does to a face is smooth over its surface. Where each side of the face has its own side of the light in all
frames (a small turn, or a camera that moves around a still head) the samples cannot tell that from an albedo that
varies likewise, and albedo free at every point takes all of it: the light then becomes as smooth and grey as its own
priors like it. But the skin of one face is known far better than the walls of a room.

Log albedo is a Gaussian field over the skin, its mean free in each channel, in brightness (the mean of the channels)
and in colour (what is left). Its covariance is exp(-d^2 / 2 length^2) at distance d, split into what both sides of the
face share and, smaller, what tells them apart:

    C(x, y) = even^2 (k(x, y) + k(x, y')) / 2 + odd^2 (k(x, y) - k(x, y')) / 2        y' mirrored in the plane x = 0

Finer texture is independent between patches of the skin. What the samples determine they go on determining: all of this
weighs as much as some ten observations.

Reference: [Rasmussen2006], section 2.7 (a free mean).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from shared.rendering.transfer import spread_vertices

PATCHES = 150
_OUTLYING = 2.0
"""Points so many textures away from their patch's mean, and patches so far off the smooth field, count a quarter, and
those further away soon nothing [Geman1985]: hair, beards, what a wrong shape or a shadow's edge spoils."""
_REWEIGHTED = 3


@dataclass(frozen=True)
class SkinVariation:
    """Standard deviations of log albedo over one face's skin: brightness and colour (per channel, about their mean) of
    what both sides share; odd: share of it by which they differ; texture: of a patch's mean about the smooth field;
    length_mm: distance over which the field is alike."""

    brightness: float = 0.2
    colour: float = 0.1
    odd: float = 0.5
    brightness_texture: float = 0.16
    colour_texture: float = 0.06
    length_mm: float = 35.0


class SkinPrior:
    """The prior for points at positions [P, 3] of head space, mm; skin [P] bool: those that it concerns."""

    def __init__(self, positions: np.ndarray, skin: np.ndarray, variation: SkinVariation):
        self.variation, self.points = variation, np.nonzero(skin)[0]
        own = positions[self.points]
        centres = own[spread_vertices(own, PATCHES)]
        self.patch, self.count = cKDTree(centres).query(own)[1], len(centres)
        here, across = (_alike(centres, centres * side, variation.length_mm) for side in (1.0, [-1.0, 1.0, 1.0]))
        even, odd = 0.5 * (here + across), 0.5 * (here - across)
        self.covariance = even + variation.odd**2 * odd

    def at(self, log_albedo: np.ndarray, weight: np.ndarray) -> SkinPull:
        """The prior near log_albedo [3, P], its points weighted by weight [P] in 0 .. 1 and by how far they lie from
        their patch."""
        weight, brightness = weight[self.points], log_albedo[:, self.points].mean(0)
        middle = self._mean(weight)[0] @ brightness
        away = (brightness - middle[self.patch]) / self.variation.brightness_texture
        mean, open_share = self._mean(weight / _variance_inflation(away**2))
        average = mean @ sparse.csr_matrix(
            (np.ones(len(self.points)), (np.arange(len(self.points)), self.points)),
            (len(self.points), log_albedo.shape[1]),
        )
        means = average @ log_albedo.T
        bright = means.mean(1, keepdims=True)
        own = self.variation
        return SkinPull(
            average,
            self._precision(own.brightness, own.brightness_texture, bright, open_share),
            self._precision(own.colour, own.colour_texture, means - bright, open_share),
        )

    def _precision(self, sigma: float, texture: float, values: np.ndarray, share: np.ndarray) -> np.ndarray:
        """[K, K] precision of patches' values [K, C], of which a share [K] of the points is known."""
        noise = texture**2 / np.maximum(share, 1e-3)
        outlying = np.ones(len(noise))
        for _ in range(_REWEIGHTED):
            precision = _free_mean(sigma**2 * self.covariance + np.diag(noise * outlying))
            off = noise[:, None] * outlying[:, None] * (precision @ values) / texture
            outlying = _variance_inflation(np.square(off).mean(1))
        return _free_mean(sigma**2 * self.covariance + np.diag(noise * outlying))

    def _mean(self, weight: np.ndarray) -> tuple[sparse.csr_matrix, np.ndarray]:
        """[K, P'] weighted means over the patches, and [K] the mean weight."""
        entries = self.patch, np.arange(len(weight))
        total = np.maximum(np.bincount(self.patch, weight, self.count), 1e-9)
        size = np.bincount(self.patch, minlength=self.count)
        return sparse.csr_matrix((weight / total[self.patch], entries), (self.count, len(weight))), total / size


@dataclass(frozen=True)
class SkinPull:
    """The prior as a quadratic form in log albedo [3, P]: average [K, P] takes patches' means, brightness and colour
    [K, K] are their precisions."""

    average: sparse.csr_matrix
    brightness: np.ndarray
    colour: np.ndarray

    def __call__(self, log_albedo: np.ndarray) -> np.ndarray:
        """The cost's gradient [3, P], linear in log_albedo [3, P]."""
        means = self.average @ log_albedo.T
        bright = means.mean(1, keepdims=True)
        pull = self.brightness @ bright / 3.0 + self.colour @ (means - bright)
        return (self.average.T @ pull).T

    def cost(self, log_albedo: np.ndarray) -> float:
        """Half the squared deviations of log_albedo [3, P]."""
        return 0.5 * float((log_albedo * self(log_albedo)).sum())


def _variance_inflation(squared: np.ndarray) -> np.ndarray:
    """Factor on the variance of what lies so many textures off, squared."""
    return np.square(1.0 + squared / _OUTLYING**2)


def _alike(a: np.ndarray, b: np.ndarray, length: float) -> np.ndarray:
    squared = np.square(a[:, None] - b[None]).sum(2)
    return np.exp(-0.5 * squared / length**2)


def _free_mean(covariance: np.ndarray) -> np.ndarray:
    """The precision of values [K] of some covariance about a mean of which nothing is known."""
    precision = np.linalg.inv(covariance)
    total = precision.sum(1)
    return precision - np.outer(total, total) / total.sum()
