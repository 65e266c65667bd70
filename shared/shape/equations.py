"""What the samples of each surface point say about its place and its normal.

Unknown at a point: its offset h along the normal, mm, and the normal's turn k [2] towards two tangents, radians. The
residual of channel c in frame f, r = a E + s S - I, changes by

    dr/dh = -grad I . (d pixel / dx) n          the point reads another place of the picture (parallax)
    dr/dk = a dE/dk + s dS/dk                   it is lit differently (shading)

with the albedo a eliminated per point and channel (variable projection), so that only what changes from frame to frame
counts and no texture can pass for relief. Errors of light, bounces and pose are smooth over the face: the part of the
residuals that is smooth in each frame is laid to them, relative to the modelled radiance. A motion across the parallax
is none that a place could cause: by how much the samples speak for it louder than their noise allows, all of them count
less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from shared.compute.robust import cauchy_weight
from shared.compute.threads import share_out
from shared.imaging.image_sampling import is_inactive
from shared.rendering.normal_derivatives import ShadingTerms
from shared.rendering.transfer import spread_vertices
from shared.shape.samples import SurfaceSamples
from shared.tracking.depth_noise import PATCH_MM

MINIMUM_ALBEDO, MAXIMUM_ALBEDO, TYPICAL_ALBEDO = 0.003, 1.0, 0.3
CAUCHY_SCALE = 2.5
PATCHES, CHI_SQUARED_MEDIAN_1 = 1000, 0.455
_POINTS_PER_BLOCK = 512
LARGEST_SQUARED_ERROR = 0.01
"""A sample that is off by more than a tenth of full scale shows something else than the surface."""


@dataclass(frozen=True)
class PointEquations:
    """Quadratic models of P points' costs in (h, k1, k2): hessian [P, 3, 3], gradient [P, 3]; rms residuals of fitted
    and of held-out frames."""

    hessian: np.ndarray
    gradient: np.ndarray
    fitted: float
    held_out: float

    @property
    def judged(self) -> float:
        """The residual to judge by: of held-out frames, of the fitted ones where none is held out."""
        return self.held_out or self.fitted


class SmoothField:
    """Smooths values over points [P, 3] with a kernel of standard width width_mm, by way of nodes that far apart."""

    def __init__(self, points: np.ndarray, width_mm: float):
        area = float(np.prod(np.sort(np.ptp(points, axis=0))[1:]))
        nodes = points[spread_vertices(points, max(8, int(2.0 * area / width_mm**2)))]
        distance, near = cKDTree(nodes).query(points, k=min(8, len(nodes)))
        weight = np.exp(-0.5 * (distance / width_mm) ** 2)
        weight /= weight.sum(1, keepdims=True)
        rows = np.repeat(np.arange(len(points)), near.shape[1])
        self.spread = sparse.csr_matrix((weight.ravel(), (rows, near.ravel())), (len(points), len(nodes)))

    def __call__(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """values, weight [P, ...] -> weighted local means, the same shape."""
        flat = weight.reshape(len(weight), -1)
        total = self.spread.T @ flat
        mean = self.spread.T @ (flat * values.reshape(len(values), -1)) / np.maximum(total, 1e-9)
        return (self.spread @ mean).reshape(values.shape)


@dataclass(frozen=True)
class EquationSettings:
    """noise: absolute and relative standard deviation of a sample; smooth_mm: width over which residuals are laid to
    light and pose, 0: none are; shadow_mm: how far off the borders of cast shadows may be."""

    noise: tuple[float, float] = (0.006, 0.03)
    smooth_mm: float = 12.0
    shadow_mm: float = 2.5


def point_equations(
    samples: SurfaceSamples,
    terms: ShadingTerms,
    points: np.ndarray,
    normals: np.ndarray,
    specular: float | np.ndarray,
    fitted: np.ndarray,
    settings: EquationSettings,
) -> PointEquations:
    """Equations of P points [P, 3] with normals [P, 3]; specular: intensity, one or [P]; fitted [F] bool. Points are
    shared out in blocks, whose arrays stay in the cache."""
    specular = np.broadcast_to(np.asarray(specular, np.float32), (len(points),))
    blocks = [slice(first, first + _POINTS_PER_BLOCK) for first in range(0, len(points), _POINTS_PER_BLOCK)]

    def fit(k: int) -> tuple[np.ndarray, ...]:
        own, lit = samples.points(blocks[k]), terms.points(blocks[k])
        highlights = specular[blocks[k], None, None] * lit.reflection
        uncertainty = settings.shadow_mm * lit.shadow_slope
        albedo, weight = _fit_albedo(own, lit.irradiance, highlights, fitted, settings.noise, uncertainty)
        model = albedo[:, None] * lit.irradiance + highlights
        error = model - own.colours
        return albedo, weight * fitted[:, None], np.maximum(model, 1e-3), error, _squared_sums(error, own, fitted)

    albedo, weight, scale, error, sums = zip(*share_out(len(blocks), fit), strict=True)
    albedo, weight, scale, error = (np.concatenate(parts) for parts in (albedo, weight, scale, error))
    if settings.smooth_mm > 0:
        error = error - scale * SmoothField(points, settings.smooth_mm)(error / scale, weight * scale**2)

    def linearise(k: int) -> tuple[np.ndarray, ...]:
        part = blocks[k]
        own, lit, used, off = samples.points(part), terms.points(part), weight[part], error[part]
        gradient = own.gradient.astype(np.float32)
        along = np.einsum("pfix,px->pfi", own.pixels_per_mm, normals[part].astype(np.float32))
        across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
        turn = albedo[part][:, None, :, None] * lit.irradiance_turn
        turn += specular[part, None, None, None] * lit.reflection_turn
        parallax, null = (-np.einsum("pfci,pfi->pfc", gradient, way) for way in (along, across))
        weighted = used * lit.irradiance
        power = np.maximum((weighted * lit.irradiance).sum(1), 1e-9)

        def pure(values: np.ndarray) -> np.ndarray:
            return values - lit.irradiance * ((weighted * values).sum(1) / power)[:, None]

        off, null = pure(off), pure(null)
        rows = np.stack([pure(values) for values in (parallax, turn[..., 0], turn[..., 1])], axis=-1)
        rows = rows.reshape(len(rows), -1, 3)
        scaled = np.swapaxes(rows * used.reshape(len(rows), -1, 1), 1, 2)
        slope = (scaled @ off.reshape(len(rows), -1, 1))[..., 0]
        return scaled @ rows, slope, (used * null * off).sum((1, 2)), (used * null**2).sum((1, 2))

    hessian, gradient, wrong, power = (
        np.concatenate(parts) for parts in zip(*share_out(len(blocks), linearise), strict=True)
    )
    evidence = 1.0 / variance_inflation(points, wrong, power)
    return PointEquations(evidence * hessian.astype(np.float64), evidence * gradient.astype(np.float64),
                          *_rms(np.sum(sums, axis=0)))


def variance_inflation(points: np.ndarray, slope: np.ndarray, power: np.ndarray, radius_mm: float = PATCH_MM) -> float:
    """How many times larger the errors of patches are than their samples' noise: at least 1.

    points [P, 3]; slope, power [P]: gradient and Hessian of the cost by a quantity that is known to be zero everywhere.
    Their sums over a patch, g and H, give g^2 / H, chi-squared with one degree of freedom; its median counts.
    """
    centres = points[spread_vertices(points, min(PATCHES, len(points)))]
    near = cKDTree(points).query_ball_point(centres, radius_mm)
    squared = [slope[patch].sum() ** 2 / max(power[patch].sum(), 1e-12) for patch in near]
    return max(1.0, float(np.median(squared)) / CHI_SQUARED_MEDIAN_1)


def _fit_albedo(samples, irradiance, highlights, fitted, noise, uncertainty) -> tuple[np.ndarray, np.ndarray]:
    """Albedo [P, 3] of the fitted frames and robust, censored weights [P, F, 3] of all; uncertainty [P, F, 3]: standard
    deviation of the irradiance."""
    sigma = np.hypot(noise[0] + noise[1] * samples.colours, TYPICAL_ALBEDO * uncertainty)
    base = samples.weight[..., None] / sigma**2
    weight = base * (samples.saturation == 0)
    for _ in range(3):
        used = weight * fitted[:, None] * irradiance
        albedo = (used * (samples.colours - highlights)).sum(1) / np.maximum((used * irradiance).sum(1), 1e-9)
        albedo = np.clip(albedo, MINIMUM_ALBEDO, MAXIMUM_ALBEDO)
        error = albedo[:, None] * irradiance + highlights - samples.colours
        weight = cauchy_weight(error, CAUCHY_SCALE * sigma, base * ~is_inactive(samples.saturation, error))
    return albedo, weight


def _squared_sums(error: np.ndarray, samples: SurfaceSamples, fitted: np.ndarray) -> np.ndarray:
    """[2, 2]: the sum of squared residuals by view weight, and of the weights, of fitted and of held-out frames."""
    squared = (np.minimum(error**2, LARGEST_SQUARED_ERROR) * ~is_inactive(samples.saturation, error)).sum(2)
    weights = [samples.weight * chosen for chosen in (fitted, ~fitted)]
    return np.array([[(weight * squared).sum(dtype=float), weight.sum(dtype=float)] for weight in weights])


def _rms(sums: np.ndarray) -> list[float]:
    """Root mean square residual of fitted and of held-out frames; sums: as _squared_sums has them."""
    return [float(np.sqrt(squared / max(3.0 * weight, 1e-9))) for squared, weight in sums]
