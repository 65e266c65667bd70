"""One Gauss-Newton step of the light's parameters with the albedo projected out, and the loop around it.

The step solves (J^T W J + priors) d = -gradient by conjugate gradients. J is never formed: its product with a change
of light renders that change for all points and frames and removes what a change of albedo, and once highlights count
of the specular intensity and the roughness under their priors, would absorb. That makes J^T W J a Schur complement: its
transpose needs no second projection. A light a little too blurred and a lobe a little too narrow show nearly the same,
so that steps of the light and of the roughness in turn would creep.

References: [Golub1973] and [Kaufman1975] (variable projection).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from shared.appearance.albedo_scale import resolve_scale
from shared.appearance.products import per_channel, per_channel_transposed, reflect, reflect_transposed
from shared.appearance.skin_prior import SkinPull
from shared.appearance.solver import ALBEDO_PULL, LARGEST_ROUGHNESS_STEP, AppearanceSolver
from shared.appearance.specular_fit import SpecularFit

_LARGEST_RISE, _LARGEST_FALL = 1.5, 4.0
"""Bounds on a step of the log light, each texel by itself: the linearisation of exp holds for a rise of this size; a
texel that wants to go dark may fall further, and must not slow the others down."""

_CONVERGED = 0.03
"""The scale follows the highlights once a step changes the log roughness by no more."""

PRECISION_OF_SEVERAL = (60, 0.002)
"""Settings.precision where there are several lights. One light's errors against another's, with an albedo between them,
are what the samples tell least of, and come last: steps that stop before leave them in the albedo."""


def conjugate_gradients(
    product: Callable, right: np.ndarray, count: int, tolerance: float = 0.02
) -> np.ndarray:
    """Approximate solution of product(x) = right by conjugate gradients, at most count products.

    Ends when the residual has fallen by the tolerance. Ended long before, what remains hangs on roundings: 1e-7 in
    products of single precision comes out as 1e-2.
    """
    x, residual = np.zeros_like(right), right.copy()
    direction, power = residual.copy(), float((residual * residual).sum())
    first = power
    for _ in range(count):
        image = product(direction)
        curvature = float((direction * image).sum())
        if curvature <= 0.0:
            break
        length = power / curvature
        x += length * direction
        residual -= length * image
        power, last = float((residual * residual).sum()), power
        if power <= tolerance**2 * first:
            break
        direction = residual + (power / last) * direction
    return x


class LightStep:
    """The linearised problem at the solver's present state."""

    def __init__(self, solver: AppearanceSolver):
        self.solver = solver
        self.model = solver.state.light_model
        self.light = solver.state.light
        self.seeks_roughness = solver.trust_highlights and solver.settings.fit_roughness
        if self.seeks_roughness and solver.slopes is None:
            solver.bake_slopes()
        self.irradiance, self.reflection = solver.forward(self.light)
        self.weight = solver.weights(solver.model(self.irradiance, self.reflection)) * solver.fitted
        self.evidence = solver.evidence(self.weight)
        self.before = 0.0
        self.specular_fit = self._fit_specular(self.light, self.irradiance, self.reflection)
        self.highlights = self._highlights(self.specular_fit, self.reflection)
        self._fit_points(self.highlights)
        self.skin = self._skin_pull()

    def _fit_specular(self, light: np.ndarray, irradiance: torch.Tensor,
                      reflection: torch.Tensor) -> SpecularFit | None:
        """Intensity and roughness for a light, once highlights count."""
        if not self.solver.trust_highlights:
            return None
        slope = self.solver.forward_slope(light, irradiance) if self.seeks_roughness else None
        return SpecularFit(self.solver, irradiance, reflection, slope, self.weight, self.evidence)

    def _highlights(self, specular_fit: SpecularFit | None, reflection: torch.Tensor) -> torch.Tensor:
        return self.solver.state.specular * reflection if specular_fit is None else specular_fit.highlights

    def _fit_points(self, highlights: torch.Tensor) -> None:
        solver = self.solver
        self.albedo = solver.best_albedo(self.irradiance, highlights, self.weight)
        solver.state.albedo = self.albedo[..., 0].T.double().numpy()

    @property
    def radiance(self) -> torch.Tensor:
        """The model [3, P, F] that is linearised, all that is projected out at its best."""
        return self.albedo * self.irradiance + self.highlights

    def _skin_pull(self) -> SkinPull | None:
        """The prior on skin near the present albedo; points count as far as the samples determine them."""
        if self.solver.skin_prior is None:
            return None
        curvature = (self.weight * self.irradiance.square()).sum(2)
        self.per_albedo = self.weight * self.irradiance / (curvature + ALBEDO_PULL)[..., None] / self.albedo
        known = (curvature / (curvature + ALBEDO_PULL)).min(0).values
        return self.solver.skin_prior.at(_log_of(self.albedo), known.double().numpy())

    def resolve_scale(self) -> float:
        """Roughness, specular intensity, the light's scale and the albedo for the present light, weights as they were
        -> by how much the scale changed at most, in the logarithm; while the roughness moves the scale waits, and the
        roughness's change is returned."""
        solver, settings = self.solver, self.solver.settings
        self.irradiance, self.reflection = solver.forward(solver.state.light)
        roughness_step = self._update_roughness()
        if roughness_step > _CONVERGED:
            specular_fit = SpecularFit(solver, self.irradiance, self.reflection, None, self.weight, self.evidence)
            solver.state.specular = max(float(specular_fit.best[0]), 0.0)
            self._fit_points(specular_fit.highlights)
            return roughness_step
        self._fit_points(solver.state.specular * self.reflection)
        log_albedo, log_irradiance, _ = solver.mean_on_skin(self.albedo, self.irradiance)
        highlights = None
        if solver.trust_highlights:
            highlights = solver.highlights(self.irradiance, self.reflection, self.weight)
        relative = solver.relative_light(self.irradiance)
        chart = solver.capture.chart
        if chart is not None:
            light = np.split(solver.state.light, len(relative))[chart.light]
            chart = chart.log_factor(light, np.exp(log_albedo + log_irradiance + relative[chart.light]))
        log_factor, specular = resolve_scale(
            log_albedo, log_irradiance, highlights, settings.specular_prior, settings.white_sigma, chart, relative
        )
        factor = torch.from_numpy(np.exp(log_factor).astype(np.float32))[:, None, None]
        solver.state.params = self.model.scaled(solver.state.params, log_factor)
        solver.state.specular = specular if settings.specular else 0.0
        self.irradiance, self.reflection = self.irradiance * factor, self.reflection * factor
        solver.state.albedo = solver.state.albedo * np.exp(-log_factor)  # what points of few samples are pulled to
        self._fit_points(solver.state.specular * self.reflection)
        return float(np.abs(log_factor).max())

    def _update_roughness(self) -> float:
        """Moves the roughness, where it is sought, to where highlights in the present light have it -> by how much."""
        solver = self.solver
        if not self.seeks_roughness:
            return 0.0
        change = self._fit_specular(solver.state.light, self.irradiance, self.reflection).change_of_roughness
        roughness_step = solver.update_roughness(change)
        self.irradiance, self.reflection = solver.forward(solver.state.light)
        return roughness_step

    def cost(self, params: np.ndarray) -> float:
        """Data and priors with albedo and, once highlights count, specular terms projected out; weights held."""
        return self._judge(params)[0]

    def _judge(self, params: np.ndarray) -> tuple[float, float]:
        """That, and the change of the log roughness with which it is reached."""
        solver, light = self.solver, self.model.radiance(params)
        irradiance, reflection = solver.forward(light)
        specular_fit = self._fit_specular(light, irradiance, reflection)
        highlights = self._highlights(specular_fit, reflection)
        albedo = solver.best_albedo(irradiance, highlights, self.weight)
        error = albedo * irradiance + highlights - solver.colours
        data = 0.5 * self.evidence * float((self.weight * error.square()).sum())
        known = self.unlikely_skin(albedo) + self.model.prior(params, solver.settings.priors)[0]
        return (data + known, 0.0) if specular_fit is None else (data + known + specular_fit.unlikely,
                                                                 specular_fit.change_of_roughness)

    def unlikely_skin(self, albedo: torch.Tensor) -> float:
        """What the prior on skin costs for an albedo [3, P, 1]."""
        return 0.0 if self.skin is None else self.skin.cost(_log_of(albedo))

    def _render(self, change: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Change of the model [3, P, F] with the parameters [M, 3], and of it what is out of the eliminated unknowns'
        reach."""
        solver = self.solver
        along = torch.from_numpy(solver.frame_light.along(self.model.tangent(solver.state.params, change)))
        result = self.albedo * per_channel(solver.baked, along.permute(2, 0, 1))
        if solver.settings.specular:
            result += solver.state.specular * reflect(solver.lobes, along)
        pure = solver.project_off_albedo(result, self.irradiance, self.weight)
        return result, pure if self.specular_fit is None else self.specular_fit.off(pure)

    def _pull_of_skin(self, log_albedo: np.ndarray) -> torch.Tensor:
        """Derivative [3, P, F] of the prior on skin at log_albedo [3, P] by the model, whose rise the albedo that is
        fitted to it turns into a fall of its own."""
        return self.per_albedo * torch.from_numpy(-self.skin(log_albedo)).float()[..., None]

    def _adjoint(self, values: torch.Tensor, specular: float, slope: float = 0.0) -> np.ndarray:
        """Transpose of the unprojected rendering, with highlights specular S + slope S': [3, P, F] -> [M, 3]."""
        solver = self.solver
        along = per_channel_transposed(solver.baked, self.albedo * values).permute(1, 2, 0)
        if solver.settings.specular:
            along = along + specular * reflect_transposed(solver.lobes, values)
        if slope:
            along = along + slope * reflect_transposed(solver.slopes, values)
        return self.model.adjoint(solver.state.params, solver.frame_light.adjoint(along.contiguous().numpy()))

    def gradient(self) -> np.ndarray:
        """[M, 3] derivative of cost by the parameters."""
        solver, state = self.solver, self.solver.state
        values = self.evidence * self.weight * (self.radiance - solver.colours)
        if self.skin is not None:
            values = values + self._pull_of_skin(_log_of(self.albedo))
        specular_fit = (state.specular,) if self.specular_fit is None else (
            float(self.specular_fit.best[0]), state.specular * self.specular_fit.change_of_roughness)
        _, prior, self.prior_product = self.model.prior(state.params, solver.settings.priors)
        return self._adjoint(values, *specular_fit) + prior

    def product(self, change: np.ndarray) -> np.ndarray:
        """Gauss-Newton Hessian times a change [M, 3]."""
        whole, pure = self._render(change)
        values = self.evidence * self.weight * pure
        if self.skin is not None:
            fall = -(self.per_albedo * whole).sum(2)
            values = values + self._pull_of_skin(fall.double().numpy())
        return self._adjoint(values, self.solver.state.specular) + self.prior_product(change)

    def update(self) -> None:
        """Moves the solver's light at constant mean irradiance per channel; halved until the cost falls.

        Within the bounds by cutting off what single texels want too much, or by a shorter step as a whole, whichever
        costs less: the one lets a lamp form, the other keeps the direction where many small wishes make up one pattern.

        The scale is left to resolve_scale: steps x are taken as Q x with Q = 1 - u g', where u raises the log light by
        one and g is the derivative of the log mean irradiance (g' u = 1), so that g' Q x = 0.
        """
        state = self.solver.state
        gauge = self.model.adjoint(state.params, self.solver.mean_on_skin(self.albedo, self.irradiance)[2])
        gauge[self.model.moving_rows] = 0.0
        unit = self.model.unit

        def level(change: np.ndarray) -> np.ndarray:
            return change - unit * (gauge * change).sum(0)

        def level_transposed(change: np.ndarray) -> np.ndarray:
            return change - gauge * (unit * change).sum(0)

        right = -level_transposed(self.gradient())
        several = len(self.solver.light_frames) > 1
        count, tolerance = PRECISION_OF_SEVERAL if several else self.solver.settings.precision
        solved = conjugate_gradients(
            lambda x: level_transposed(self.product(level(x))), right, count, tolerance
        )
        whole = level(solved)
        longest = max(whole.max() / _LARGEST_RISE, -whole.min() / _LARGEST_FALL, 1.0)
        steps = [whole]
        if longest > 1.0:
            steps = [level(np.clip(whole, -_LARGEST_FALL, _LARGEST_RISE)), whole / longest]
        self.before = self.cost(state.params)
        for halving in 0.5 ** np.arange(6):
            costs, changes = zip(*(self._judge(state.params + halving * step) for step in steps), strict=True)
            best = int(np.argmin(costs))
            if costs[best] < self.before:
                shorter = min(1.0, LARGEST_ROUGHNESS_STEP / max(abs(changes[best]), 1e-9))
                state.params = state.params + shorter * halving * steps[best]
                break


def _log_of(albedo: torch.Tensor) -> np.ndarray:
    """[3, P, 1] -> its logarithm [3, P]."""
    return torch.log(albedo[..., 0]).double().numpy()
