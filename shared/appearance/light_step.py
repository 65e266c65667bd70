"""One Gauss-Newton step of the light's parameters with albedo and specular terms projected out, and the scale after it.

The step solves (J^T W J + priors) d = -gradient by conjugate gradients. J is never formed: its product with a change
of light renders that change for all points and frames and removes what a change of albedo, and once highlights count
of the specular intensity and the roughness under their priors, would absorb. That makes J^T W J a Schur complement: its
transpose needs no second projection. A light a little too blurred and a lobe a little too narrow show nearly the same,
so that steps of the light and of the roughness in turn would creep.

References: [Golub1973] and [Kaufman1975] (variable projection).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse.linalg import LinearOperator, cg

from shared.appearance.albedo_scale import ResolvedScale, resolve_scale
from shared.appearance.preconditioner import MOST_TEXELS, LightPreconditioner, curvature_of_some
from shared.appearance.problem import AppearanceProblem, AppearanceState
from shared.appearance.projection import (
    ALBEDO_PULL,
    LARGEST_ROUGHNESS_STEP,
    SPECULAR_RANGE,
    SpecularFit,
    best_albedo,
    changed_roughness,
    measure_highlights,
    project_off_albedo,
)
from shared.appearance.sample_errors import SampleErrors
from shared.appearance.skin_prior import SkinPull
from shared.appearance.transport import LobeSlopes, Transport

_LARGEST_RISE, _LARGEST_FALL = 1.5, 4.0
"""Bounds on a step of the log light, each texel by itself: the linearisation of exp holds for a rise of this size; a
texel that wants to go dark may fall further, and must not slow the others down."""

_CONVERGED = 0.03
"""The scale follows the highlights once a step changes the log roughness by no more."""

PRECISION_OF_SEVERAL = (60, 0.002)
"""Settings.precision where there are several lights. One light's errors against another's, with an albedo between them,
are what the samples tell least of, and come last: steps that stop before leave them in the albedo."""


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """The problem at a state, whose albedo and, once highlights count, specular intensity are the best under its light,
    and what does not change while the light does.

    transport, errors: the state's; highlights_count: whether highlights say something about the light and the scale;
    slopes: of the lobes, None where the roughness is not sought; irradiance, reflection [3, P, F]: the forward model;
    weight [3, P, F]: of the fitted samples; evidence: see SampleErrors; specular_fit: what intensity and roughness
    highlights have, None while they don't count; highlights [3, P, F]; albedo [3, P, 1]; skin: the prior on skin near
    that albedo, or None, and albedo_slope [3, P, F]: derivative of the log albedo by the samples; prior_gradient
    [M, 3] and prior_product: of the light's regularisers.
    """

    problem: AppearanceProblem
    state: AppearanceState
    transport: Transport
    errors: SampleErrors
    highlights_count: bool
    slopes: LobeSlopes | None
    irradiance: torch.Tensor
    reflection: torch.Tensor
    weight: torch.Tensor
    evidence: float
    specular_fit: SpecularFit | None
    highlights: torch.Tensor
    albedo: torch.Tensor
    skin: SkinPull | None
    albedo_slope: torch.Tensor | None
    prior_gradient: np.ndarray
    prior_product: Callable[[np.ndarray], np.ndarray]

    @classmethod
    def at(
        cls, problem: AppearanceProblem, state: AppearanceState, transport: Transport, errors: SampleErrors,
        highlights_count: bool,
    ) -> LinearisedFit:
        """Of a state; the arguments are those of the class."""
        settings, light = problem.settings, state.light
        slopes = transport.lobes.slopes() if highlights_count and settings.fit_roughness else None
        irradiance, reflection = transport.forward(light)
        weight = errors.weights(state.radiance(irradiance, reflection), highlights_count) * errors.fitted
        evidence = errors.evidence(weight)
        specular_fit, highlights = None, state.specular * reflection
        if highlights_count:
            slope = None if slopes is None else transport.roughness_slope(slopes, light, irradiance)
            specular_fit = SpecularFit(settings, state, errors, irradiance, reflection, slope, weight, evidence)
            specular_fit = specular_fit.weighed_by_patches(errors, irradiance, problem.patches)
            highlights = specular_fit.highlights
            state = replace(state, specular=specular_fit.intensity)
        albedo = best_albedo(errors, irradiance, highlights, weight, problem.typical_albedo(state))
        skin, albedo_slope = None, None
        if problem.skin_prior is not None:
            curvature = (weight * irradiance.square()).sum(2)
            albedo_slope = weight * irradiance / (curvature + ALBEDO_PULL)[..., None] / albedo
            known = (curvature / (curvature + ALBEDO_PULL)).min(0).values
            skin = problem.skin_prior.at(_log_of(albedo), known.double().numpy())
        _, prior_gradient, prior_product = state.light_model.prior(state.params, settings.priors)
        return cls(
            problem=problem,
            state=_with_albedo(state, albedo),
            transport=transport,
            errors=errors,
            highlights_count=highlights_count,
            slopes=slopes,
            irradiance=irradiance,
            reflection=reflection,
            weight=weight,
            evidence=evidence,
            specular_fit=specular_fit,
            highlights=highlights,
            albedo=albedo,
            skin=skin,
            albedo_slope=albedo_slope,
            prior_gradient=prior_gradient,
            prior_product=prior_product,
        )

    @property
    def radiance(self) -> torch.Tensor:
        """The model [3, P, F] that is linearised, all that is projected out at its best."""
        return self.albedo * self.irradiance + self.highlights

    def fit_specular(
        self, light: np.ndarray, irradiance: torch.Tensor, reflection: torch.Tensor
    ) -> SpecularFit | None:
        """Intensity and roughness, once highlights count, for another light [6 n^2, 3], which gives irradiance and
        reflection [3, P, F]."""
        if not self.highlights_count:
            return None
        slope = None if self.slopes is None else self.transport.roughness_slope(self.slopes, light, irradiance)
        return SpecularFit(self.problem.settings, self.state, self.errors, irradiance, reflection, slope, self.weight,
                           self.evidence, self.specular_fit.design_effect)

    def cost(self, params: np.ndarray) -> float:
        """Data and priors of a light of parameters [M, 3], albedo and, once highlights count, specular terms projected
        out; weights held."""
        return self.judge(params)[0]

    def judge(self, params: np.ndarray) -> tuple[float, float]:
        """The cost of parameters [M, 3], and the change of the log roughness with which it is reached."""
        state, light = self.state, self.state.light_model.radiance(params)
        irradiance, reflection = self.transport.forward(light)
        specular_fit = self.fit_specular(light, irradiance, reflection)
        highlights = state.specular * reflection if specular_fit is None else specular_fit.highlights
        albedo = self._albedo(state, irradiance, highlights)
        error = albedo * irradiance + highlights - self.errors.colours
        data = 0.5 * self.evidence * float((self.weight * error.square()).sum())
        prior = state.light_model.prior(params, self.problem.settings.priors)[0]
        known = self.unlikely_skin(albedo) + prior
        return (data + known, 0.0) if specular_fit is None else (data + known + specular_fit.unlikely,
                                                                 specular_fit.change_of_roughness)

    def unlikely_skin(self, albedo: torch.Tensor) -> float:
        """What the prior on skin costs for an albedo [3, P, 1]."""
        return 0.0 if self.skin is None else self.skin.cost(_log_of(albedo))

    def gradient(self) -> np.ndarray:
        """[M, 3] derivative of cost by the parameters."""
        values = self.evidence * self.weight * (self.radiance - self.errors.colours)
        if self.skin is not None:
            values = values + self._pull_of_skin(_log_of(self.albedo))
        specular, slope = self.state.specular, 0.0
        if self.specular_fit is not None:
            slope = specular * self.specular_fit.change_of_roughness
            specular = float(self.specular_fit.best[0])
        if slope:
            light = self.transport.render_adjoint_with_slopes(values, self.albedo, specular, self.slopes, slope)
        else:
            light = self.transport.render_adjoint(values, self.albedo, specular)
        return self.state.light_model.adjoint(self.state.params, light) + self.prior_gradient

    def product(self, change: np.ndarray) -> np.ndarray:
        """Gauss-Newton Hessian times a change [M, 3]."""
        state = self.state
        light = state.light_model.tangent(state.params, change)
        whole = self.transport.render(light, self.albedo, state.specular)
        pure = project_off_albedo(whole, self.irradiance, self.weight)
        if self.specular_fit is not None:
            pure = self.specular_fit.project_off(pure)
        values = self.evidence * self.weight * pure
        if self.skin is not None:
            fall = -(self.albedo_slope * whole).sum(2)
            values = values + self._pull_of_skin(fall.double().numpy())
        light = self.transport.render_adjoint(values, self.albedo, state.specular)
        return state.light_model.adjoint(state.params, light) + self.prior_product(change)

    def _pull_of_skin(self, log_albedo: np.ndarray) -> torch.Tensor:
        """Derivative [3, P, F] of the prior on skin at log_albedo [3, P] by the model, whose rise the albedo that is
        fitted to it turns into a fall of its own."""
        return self.albedo_slope * torch.from_numpy(-self.skin(log_albedo)).float()[..., None]

    def improved_light(self) -> tuple[np.ndarray, float]:
        """Parameters [M, 3] of a light of the same mean irradiance per channel after a step, halved until the cost
        falls, and the cost before it.

        Within the bounds by cutting off what single texels want too much, or by a shorter step as a whole, whichever
        costs less: the one lets a lamp form, the other keeps the direction where many small wishes make up one pattern.

        The scale is left to resolved_scale: steps x are taken as Q x with Q = 1 - u g', where u raises the log light by
        one and g is the derivative of the log mean irradiance (g' u = 1), so that g' Q x = 0.
        """
        params, model = self.state.params, self.state.light_model
        gauge = model.adjoint(params, self.problem.mean_on_skin(self.albedo, self.irradiance, self.transport)[2])
        gauge[model.moving_rows] = 0.0
        unit = model.unit

        def level(change: np.ndarray) -> np.ndarray:
            return change - unit * (gauge * change).sum(0)

        def level_transposed(change: np.ndarray) -> np.ndarray:
            return change - gauge * (unit * change).sum(0)

        several = len(self.errors.light_frames) > 1
        count, tolerance = PRECISION_OF_SEVERAL if several else self.problem.settings.precision
        hessian = LinearOperator(
            (params.size, params.size), dtype=np.float64,
            matvec=lambda x: level_transposed(self.product(level(x.reshape(params.shape)))).ravel(),
        )
        # Ended long before, what remains hangs on roundings: 1e-7 in products of single precision comes out as 1e-2.
        solved, _ = cg(hessian, -level_transposed(self.gradient()).ravel(), rtol=tolerance, atol=0.0, maxiter=count,
                       M=self._preconditioner())
        whole = level(solved.reshape(params.shape))
        longest = max(whole.max() / _LARGEST_RISE, -whole.min() / _LARGEST_FALL, 1.0)
        steps = [whole]
        if longest > 1.0:
            steps = [level(np.clip(whole, -_LARGEST_FALL, _LARGEST_RISE)), whole / longest]
        before = self.cost(params)
        for halving in 0.5 ** np.arange(6):
            costs, changes = zip(*(self.judge(params + halving * step) for step in steps), strict=True)
            best = int(np.argmin(costs))
            if costs[best] < before:
                shorter = min(1.0, LARGEST_ROUGHNESS_STEP / max(abs(changes[best]), 1e-9))
                return params + shorter * halving * steps[best], before
        return params, before

    def _preconditioner(self) -> LinearOperator | None:
        """Of the step's system, [3 M, 3 M]; None where the light's parameters are no texels, or too many."""
        state, params = self.state, self.state.params
        prior = state.light_model.prior_curvature(params, self.problem.settings.priors)
        if prior is None or len(params) > MOST_TEXELS:
            return None
        curvature = curvature_of_some(self.transport, self.albedo, state.specular, self.irradiance,
                                      self.evidence * self.weight)
        solve = LightPreconditioner(curvature, state.light, prior)
        return LinearOperator((params.size, params.size), dtype=np.float64,
                              matvec=lambda x: solve(x.reshape(params.shape)).ravel())

    def resolved_scale(self, params: np.ndarray) -> ResolvedFit:
        """Roughness, specular intensity, the light's scale and the albedo for a light of parameters [M, 3], weights as
        they were. While the roughness moves the scale waits."""
        problem, settings = self.problem, self.problem.settings
        state, transport = replace(self.state, params=params), self.transport
        irradiance, reflection = transport.forward(state.light)
        changed = 0.0
        if self.slopes is not None:
            change = self.fit_specular(state.light, irradiance, reflection).change_of_roughness
            before, state = state.roughness, replace(state, roughness=changed_roughness(state.roughness, change))
            changed = abs(float(np.log(state.roughness / before)))
            transport = replace(transport, lobes=problem.lobes_at(state.roughness))
            irradiance, reflection = transport.forward(state.light)
        if changed > _CONVERGED:
            specular_fit = SpecularFit(settings, state, self.errors, irradiance, reflection, None, self.weight,
                                       self.evidence, self.specular_fit.design_effect)
            albedo = self._albedo(state, irradiance, specular_fit.highlights)
            state = replace(_with_albedo(state, albedo), specular=specular_fit.intensity)
            return ResolvedFit(state, transport, irradiance, reflection, albedo, changed)
        albedo = self._albedo(state, irradiance, state.specular * reflection)
        log_albedo, log_irradiance, _ = problem.mean_on_skin(albedo, irradiance, transport)
        highlights, shine = None, None
        if self.highlights_count:
            highlights = measure_highlights(self.errors, irradiance, reflection, self.weight,
                                            self.specular_fit.design_effect)
        elif settings.specular:
            shine = problem.shine_on_skin(albedo * irradiance, state.specular * reflection)
        relative = problem.relative_light(irradiance)
        chart = problem.capture.chart
        if chart is not None:
            light = np.split(state.light, len(relative))[chart.light]
            chart = chart.log_factor(light, np.exp(log_albedo + log_irradiance + relative[chart.light]))
        scale = resolve_scale(
            log_albedo, log_irradiance, highlights, settings.specular_prior, settings.white_sigma, chart=chart,
            relative_light=relative, log_brightest=problem.brightest_skin(albedo), whites=problem.said_by_whites(state),
            tints=settings.tints, shine=shine,
        )
        log_factor = scale.log_factor
        factor = torch.from_numpy(np.exp(log_factor).astype(np.float32))[:, None, None]
        irradiance, reflection = irradiance * factor, reflection * factor
        state = replace(
            _with_albedo(state, albedo),
            params=state.light_model.scaled(state.params, log_factor),
            specular=float(np.clip(scale.specular, *SPECULAR_RANGE)) if settings.specular else 0.0,
        )
        # What points of few samples are pulled to has the new scale, too.
        state = replace(state, albedo=state.albedo * np.exp(-log_factor))
        albedo = self._albedo(state, irradiance, state.specular * reflection)
        changed = float(np.abs(log_factor).max())
        return ResolvedFit(_with_albedo(state, albedo), transport, irradiance, reflection, albedo, changed, scale)

    def _albedo(self, state: AppearanceState, irradiance: torch.Tensor, highlights: torch.Tensor) -> torch.Tensor:
        typical = self.problem.typical_albedo(state)
        return best_albedo(self.errors, irradiance, highlights, self.weight, typical)


@dataclass(frozen=True, eq=False)
class ResolvedFit:
    """A state whose scale is resolved, its transport, irradiance and reflection [3, P, F] and albedo [3, P, 1];
    rescaled: by how much the scale changed at most, in the logarithm, or the roughness while it moves; scale: as it was
    resolved, None while it waits."""

    state: AppearanceState
    transport: Transport
    irradiance: torch.Tensor
    reflection: torch.Tensor
    albedo: torch.Tensor
    rescaled: float
    scale: ResolvedScale | None = None


def _with_albedo(state: AppearanceState, albedo: torch.Tensor) -> AppearanceState:
    """The state with an albedo [3, P, 1]."""
    return replace(state, albedo=albedo[..., 0].T.double().numpy())


def _log_of(albedo: torch.Tensor) -> np.ndarray:
    """albedo [3, P, 1] -> its logarithm [3, P]."""
    return torch.log(albedo[..., 0]).double().numpy()
