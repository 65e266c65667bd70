"""What is unknown of the light: parameters behind one interface, from a few numbers to a whole cubemap.

    cubemap        the logarithm of every texel
    harmonics_2    log radiance in spherical harmonics of order 0 to 2, nine numbers per channel; harmonics_4: 25
    sun_sky        one sun (direction and colour free) and a sky of harmonics_2
    camera         one lamp at the camera, in a uniform ambient light

The logarithm keeps radiance positive and makes smoothness relative, so that a lamp a thousand times brighter than the
room costs no more than its edge. Every model gives a cubemap, its derivative along a change of the parameters, and the
transpose of that: all the solver needs.

References: [Ren2006] (radiance as the exponential of harmonics); [Ramamoorthi2001] (order 2 for matte surfaces);
[Wang2009] (spherical Gaussians).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sparse
from scipy.special import sph_harm_y

from shared.appearance.light import LightPriors, LogPrior, resample_light
from shared.rendering.envmap import cube_directions, cube_solid_angles

LAMP_SHARPNESS = 80.0
"""Of the lobe exp(s (d.w - 1)) that stands for a sun or a lamp: 9 degrees to half its peak, as narrow as the direction
set resolves."""
TOWARDS_CAMERA = np.array([0.0, 0.0, 1.0])
"""In camera axes turned to y up, where the camera stands as seen from the head."""


def real_harmonics(directions: np.ndarray, order: int) -> np.ndarray:
    """[N, 3] unit directions -> [N, (order + 1)^2] real orthonormal spherical harmonics, y up; the first is constant.

    Sloan, Stupid spherical harmonics tricks, GDC 2008, appendix A1, up to the signs of odd m.
    """
    polar = np.arccos(np.clip(directions[:, 1], -1.0, 1.0))
    azimuth = np.arctan2(directions[:, 0], directions[:, 2])
    columns = []
    for degree in range(order + 1):
        for m in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(m), polar, azimuth)
            columns.append(value.real if m == 0 else np.sqrt(2.0) * (value.imag if m < 0 else value.real))
    return np.stack(columns, axis=1)


class LogLight:
    """Log radiance = basis @ parameters. basis [6 n^2, M], its first column constant; None: every texel by itself."""

    moving_rows = slice(0, 0)
    """Rows of the parameters that are no logarithm of radiance."""

    def __init__(self, resolution: int, basis: np.ndarray | None = None):
        self.resolution, self.basis, self.log_prior = resolution, basis, LogPrior(resolution)
        count = 6 * resolution**2
        self.unit = np.ones((count, 1)) if basis is None else np.eye(basis.shape[1])[:, :1] / basis[0, 0]
        """[M, 1]: the change of parameters that raises the log radiance by one everywhere."""

    def _log(self, params: np.ndarray) -> np.ndarray:
        return params if self.basis is None else self.basis @ params

    def _log_adjoint(self, values: np.ndarray) -> np.ndarray:
        return values if self.basis is None else self.basis.T @ values

    def radiance(self, params: np.ndarray) -> np.ndarray:
        """[M, 3] -> [6 n^2, 3]."""
        return np.exp(self._log(params))

    def tangent(self, params: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Change of the radiance [6 n^2, 3] with a change of the parameters [M, 3], to first order."""
        return self.radiance(params) * self._log(change)

    def adjoint(self, params: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Transpose of tangent: [6 n^2, 3] -> [M, 3]."""
        return self._log_adjoint(self.radiance(params) * values)

    def scaled(self, params: np.ndarray, log_factor: np.ndarray) -> np.ndarray:
        """Parameters of the same light times exp(log_factor [3])."""
        return params + self.unit * log_factor

    def prior(self, params: np.ndarray, priors: LightPriors) -> tuple[float, np.ndarray, Callable]:
        """Cost, gradient [M, 3] and Hessian product of the regularisers, which act on the log radiance."""
        cost, gradient, product = self.log_prior(self._log(params), priors)
        return cost, self._log_adjoint(gradient), lambda change: self._log_adjoint(product(self._log(change)))

    def prior_curvature(self, params: np.ndarray, priors: LightPriors) -> list[sparse.csr_matrix] | None:
        """Of parameters [M, 3] that are texels: the prior's Hessian [M, M] of each channel by itself; else None."""
        return self.log_prior.curvature(params, priors) if self.basis is None else None

    def fit(self, radiance: np.ndarray) -> np.ndarray:
        """Parameters whose light comes closest to a cubemap radiance [6 m^2, 3] of any resolution, in the logarithm
        -> [M, 3]."""
        log_light = np.log(resample_light(radiance, self.resolution))
        if self.basis is None:
            return log_light
        root = np.sqrt(cube_solid_angles(self.resolution))[:, None]
        return np.linalg.lstsq(self.basis * root, log_light * root, rcond=None)[0]


class LampLight:
    """A lobe on a smooth sky: exp(sky) + exp(lamp) * exp(sharpness (d.w - 1)).

    Parameters [M + 1 (+ 1), 3]: the sky's (a LogLight of some basis), the log colour of the lamp, and, unless the
    direction [3] is given, the direction d itself as the last row, of any length.
    """

    def __init__(self, sky: LogLight, direction: np.ndarray | None = None, sharpness: float = LAMP_SHARPNESS):
        self.sky, self.direction, self.sharpness, self.resolution = sky, direction, sharpness, sky.resolution
        self._texels = cube_directions(sky.resolution)
        self._own = len(sky.unit)
        moving = direction is None
        self.moving_rows = slice(self._own + 1, self._own + 1 + moving)
        self.unit = np.concatenate([sky.unit, np.ones((1, 1)), np.zeros((int(moving), 1))])

    def _lobe(self, params: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The lobe [6 n^2], its unit direction and the length of the direction's row."""
        towards = params[-1] if self.direction is None else self.direction
        length = float(np.linalg.norm(towards))
        unit = towards / length
        return np.exp(self.sharpness * (self._texels @ unit - 1.0)), unit, length

    def radiance(self, params: np.ndarray) -> np.ndarray:
        """[M, 3] -> [6 n^2, 3]."""
        return self.sky.radiance(params[: self._own]) + self._lobe(params)[0][:, None] * np.exp(params[self._own])

    def _turn(self, params: np.ndarray) -> np.ndarray:
        """[6 n^2, 3, 3]: derivative of the lamp's radiance (channel) by the direction's row (axis)."""
        lobe, unit, length = self._lobe(params)
        across = self._texels - (self._texels @ unit)[:, None] * unit
        lamp = self.sharpness / length * lobe[:, None] * np.exp(params[self._own])
        return lamp[:, :, None] * across[:, None, :]

    def tangent(self, params: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Change of the radiance [6 n^2, 3] with a change of the parameters [M, 3], to first order."""
        lamp = self._lobe(params)[0][:, None] * np.exp(params[self._own])
        result = self.sky.tangent(params[: self._own], change[: self._own]) + lamp * change[self._own]
        return result + self._turn(params) @ change[-1] if self.direction is None else result

    def adjoint(self, params: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Transpose of tangent: [6 n^2, 3] -> [M, 3]."""
        lamp = self._lobe(params)[0][:, None] * np.exp(params[self._own])
        rows = [self.sky.adjoint(params[: self._own], values), (lamp * values).sum(0, keepdims=True)]
        if self.direction is None:
            rows.append(np.einsum("kca,kc->a", self._turn(params), values)[None])
        return np.concatenate(rows)

    def scaled(self, params: np.ndarray, log_factor: np.ndarray) -> np.ndarray:
        """Parameters of the same light times exp(log_factor [3])."""
        return params + self.unit * log_factor

    def prior(self, params: np.ndarray, priors: LightPriors) -> tuple[float, np.ndarray, Callable]:
        """The sky's regularisers; the lamp's log colour is pulled to grey as strongly as all of the sky's."""
        cost, gradient, product = self.sky.prior(params[: self._own], priors)
        lamp = params[self._own]
        away = priors.white * (lamp - lamp.mean())
        result = np.zeros_like(params)
        result[: self._own], result[self._own] = gradient, away

        def whole(change: np.ndarray) -> np.ndarray:
            image = np.zeros_like(change)
            image[: self._own] = product(change[: self._own])
            image[self._own] = priors.white * (change[self._own] - change[self._own].mean())
            return image

        return cost + 0.5 * float((away * (lamp - lamp.mean())).sum()), result, whole

    def prior_curvature(self, params: np.ndarray, priors: LightPriors) -> None:
        """None: the parameters are no texels."""
        return None

    def fit(self, radiance: np.ndarray) -> np.ndarray:
        """The lamp takes what exceeds the median of a cubemap around its brightest direction, the sky the rest.
        radiance [6 m^2, 3] linear."""
        fine = resample_light(radiance, self.resolution)
        solid = cube_solid_angles(self.resolution)[:, None]
        median = np.median(fine, axis=0)
        excess = np.maximum(fine - median, 0.0) * solid
        towards = self._texels[excess.sum(1).argmax()] if self.direction is None else self.direction
        near = self._texels @ towards > np.cos(np.radians(25.0))
        lobe = (np.exp(self.sharpness * (self._texels @ towards - 1.0))[:, None] * solid).sum()
        lamp = np.maximum(excess[near].sum(0) / lobe, 0.1 * median)
        sky = np.where(near[:, None], np.minimum(fine, median), fine)
        rows = [self.sky.fit(sky), np.log(lamp)[None]]
        return np.concatenate(rows + [towards[None]] if self.direction is None else rows)


class SeveralLights:
    """Lights of one model, each by itself: their parameters, and their cubemaps, one below the other.

    All raise together: what they are to each other is for the samples to say. shares [L]: weight of each one's prior,
    empty: 1.
    """

    def __init__(self, model: LogLight | LampLight, count: int, shares: Sequence[float] = ()):
        self.model, self.count, self.resolution = model, count, model.resolution
        self.shares = tuple(shares) or (1.0,) * count
        self.unit = np.tile(model.unit, (count, 1))
        own = np.arange(len(model.unit))
        moving = own[model.moving_rows]
        self.moving_rows = (moving + len(own) * np.arange(count)[:, None]).ravel()

    def _each(self, function: Callable, *stacked: np.ndarray) -> np.ndarray:
        parts = zip(*(np.split(array, self.count) for array in stacked), strict=True)
        return np.concatenate([function(*part) for part in parts])

    def radiance(self, params: np.ndarray) -> np.ndarray:
        """[L M, 3] -> [L 6 n^2, 3]."""
        return self._each(self.model.radiance, params)

    def tangent(self, params: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Change of the radiance [L 6 n^2, 3] with a change of the parameters [L M, 3], to first order."""
        return self._each(self.model.tangent, params, change)

    def adjoint(self, params: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Transpose of tangent: [L 6 n^2, 3] -> [L M, 3]."""
        return self._each(self.model.adjoint, params, values)

    def scaled(self, params: np.ndarray, log_factor: np.ndarray) -> np.ndarray:
        """Parameters of the same lights times exp(log_factor [3])."""
        return params + self.unit * log_factor

    def prior(self, params: np.ndarray, priors: LightPriors) -> tuple[float, np.ndarray, Callable]:
        """Sum of the costs, gradient [L M, 3] and Hessian product of the regularisers, of each light times its share.
        """
        each = (self.model.prior(own, priors) for own in np.split(params, self.count))
        costs, gradients, products = zip(*each, strict=True)

        def product(change: np.ndarray) -> np.ndarray:
            parts = zip(products, np.split(change, self.count), strict=True)
            return self._weighted([of_one(part) for of_one, part in parts])

        cost = sum(share * own for share, own in zip(self.shares, costs, strict=True))
        return cost, self._weighted(gradients), product

    def prior_curvature(self, params: np.ndarray, priors: LightPriors) -> list[sparse.csr_matrix] | None:
        """Of parameters [L M, 3] that are texels: the prior's Hessian [L M, L M] of each channel by itself; else None.
        """
        each = [self.model.prior_curvature(own, priors) for own in np.split(params, self.count)]
        if each[0] is None:
            return None
        return [sparse.block_diag(self._scaled(own), format="csr") for own in zip(*each, strict=True)]

    def with_shares(self, shares: Sequence[float]) -> SeveralLights:
        """The same with other weights [L] of their priors."""
        return SeveralLights(self.model, self.count, shares)

    def _weighted(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        return np.concatenate(self._scaled(parts))

    def _scaled(self, parts: Sequence) -> list:
        return [share * part for share, part in zip(self.shares, parts, strict=True)]

    def fit(self, radiance: np.ndarray) -> np.ndarray:
        """Parameters whose lights come closest to cubemaps radiance [L 6 m^2, 3] of any resolution, one below the
        other -> [L M, 3]."""
        return self._each(self.model.fit, radiance)


LightModel = LogLight | LampLight | SeveralLights


def make_light_model(name: str, resolution: int, lights: int = 1, shares: Sequence[float] = ()) -> LightModel:
    """The model of that name (the module's table) on a cubemap of a resolution, for one light or several; shares: see
    SeveralLights."""
    if lights > 1:
        return SeveralLights(make_light_model(name, resolution), lights, shares)
    directions = cube_directions(resolution)
    if name == "cubemap":
        return LogLight(resolution)
    if name == "camera":
        return LampLight(LogLight(resolution, np.ones((len(directions), 1))), TOWARDS_CAMERA)
    order = {"harmonics_2": 2, "harmonics_4": 4, "sun_sky": 2}[name]
    smooth = LogLight(resolution, real_harmonics(directions, order))
    return LampLight(smooth) if name == "sun_sky" else smooth
