"""The whole appearance fit: steps of everything from coarse lights to fine ones, a stop on held-out frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import torch

from shared.appearance.albedo_scale import ResolvedScale
from shared.appearance.light_step import LinearisedFit
from shared.appearance.light_weights import weigh_samples
from shared.appearance.local_roughness import SpecularEquations
from shared.appearance.observations import Capture
from shared.appearance.problem import AppearanceProblem, AppearanceSettings, AppearanceState
from shared.appearance.projection import LARGEST_ROUGHNESS_STEP, SPECULAR_RANGE, changed_roughness
from shared.appearance.sample_errors import SampleErrors
from shared.rendering.near_lamp import NearLamp

_SHAPING_STEPS, _SHAPED = 3, 0.1
"""Without highlights at least as many steps from a uniform light, until one changes the fitted residual by less than
this fraction: in a light that has not found its lamps yet, highlights would be spread as wide as they can be, and lamps
then never found. Likewise in a light that was just made to fit another model, which may have lost them.
"""

_WORTHWHILE, _WORTHWHILE_COARSE = 0.003, 0.03
"""A step that lowers the held-out residual by less than this fraction is the last of its resolution; the first of
several resolutions is left earlier, since what it cannot resolve keeps its residual high."""

_CONVERGED_SCALE = 0.01
"""A resolution goes on while a step changes the light's scale by more than this, in the logarithm: highlights say what
it is, for the roughness of the moment, and the residual hardly feels it. Without highlights the priors alone do."""

_LAST_STEPS = 3
"""At most, of fit_sharper_light."""

_ROUGHNESS_STEPS = 8
"""At most, of the roughness by itself before a step of all."""

_LARGEST_RISE = 1.05
"""A step after which the robust loss on fitted samples is higher by more than this factor is undone, and ends its
resolution: the specular intensity and the scale follow priors as well as samples, and on a clip that contradicts the
model (an expression that changes, a palette of few colours) they can lead away from it."""


class Phase(Enum):
    """What the steps of a resolution are for."""

    SHAPING = "shaping"
    """The light finds its lamps, without highlights."""
    SOLVING = "solving"
    """All unknowns together."""


@dataclass(frozen=True)
class StepReport:
    """What a step found.

    fitted, held_out: residuals; cost: before it; rescaled: see ResolvedFit; skin_prior: what the prior on skin says
    against its albedo; specular_intensity, roughness; light_weights: of several lights, see weigh_samples; rise: by
    what factor the robust loss on fitted samples rose; frame_errors [F]: each frame's mean absolute residual; scale:
    between light and albedo, as it was resolved, None while it waits.
    """

    fitted: float
    held_out: float
    cost: float
    rescaled: float
    skin_prior: float
    specular_intensity: float
    roughness: float
    light_weights: tuple[float, ...]
    rise: float
    frame_errors: np.ndarray
    scale: ResolvedScale | None

    def judged(self, capture: Capture, independent: float) -> float:
        """The residual to judge by, raised by what the prior on skin says against the albedo: of held-out frames, of
        the fitted ones in a clip too short to hold frames out.

        A residual r of count independent samples and a prior's cost p together are as likely as a residual of
        r sqrt(1 + 2 p / count) alone: no frame shows what samples leave open.
        """
        residual, share = self.held_out, 1.0 - capture.fitted.mean()
        if capture.fitted.all():
            residual, share = self.fitted, 1.0
        return residual * (1.0 + 2.0 * self.skin_prior / (share * independent)) ** 0.5

    def record(self, model: str, resolution: int, number: int, phase: Phase) -> dict:
        """The line of solve.json: step number of a phase under a light of a model and resolution."""
        several = {"light_weights": list(self.light_weights)} if self.light_weights else {}
        return several | {
            "fitted": self.fitted,
            "held_out": self.held_out,
            "cost": self.cost,
            "rescaled": self.rescaled,
            "skin_prior": self.skin_prior,
            "specular_intensity": self.specular_intensity,
            "roughness": self.roughness,
            "light": model,
            "resolution": resolution,
            "step": number,
            "shaping": phase is Phase.SHAPING,
        }


@dataclass(frozen=True)
class Solution:
    """The last state of those that are best by held-out residual; iterations: one record per step; fitted and held_out:
    its residuals; local_roughness_fit: where roughness varies over the skin, how, and roughness_record what the
    held-out frames said to that; highlights_count: whether highlights took part to the end; frame_errors [F]: each
    frame's mean absolute residual; light_weights: of several lights, how much samples of each count against those of
    the light that the model follows best; lamp: of the light, where it stands near; scale: between light and albedo,
    with its covariance, None where it was not at rest."""

    state: AppearanceState
    iterations: tuple[dict, ...]
    fitted: float
    held_out: float
    local_roughness_fit: SpecularEquations | None = None
    roughness_record: dict = field(default_factory=dict)
    highlights_count: bool = True
    frame_errors: np.ndarray | None = None
    light_weights: tuple[float, ...] = ()
    lamp: NearLamp | None = None
    scale: ResolvedScale | None = None


@dataclass(frozen=True, eq=False)
class FitState:
    """What a step starts from: the unknowns, and how samples count."""

    appearance: AppearanceState
    errors: SampleErrors


def fit_appearance(
    capture: Capture,
    settings: AppearanceSettings,
    report: Callable[[dict], None] = lambda record: None,
    start: Solution | None = None,
    keep_start: bool = False,
    least: int = 1,
    shapes: bool = False,
) -> Solution:
    """Fits light, albedo, specular intensity and roughness; report receives each step's record. start: the solution of
    a capture much like this one, from which only the last resolution is gone through again; keep_start: its light as it
    is may win, too; least: steps from it before one that serves little may be the last; shapes: the start's light is
    not one to judge highlights by, being of another model, or found without any.

    The first steps, and those after a change of the light's model, only give the light its shape (Phase.SHAPING);
    highlights, which then begin to say something about the scale, take part after those, but not again after
    a step that had to be undone. Only states after the first steps, of the light model asked for, can win, or the one
    that a step was undone to, and none whose scale waits where there is one whose scale is resolved; of those that do
    about as well the last, whose scale has come to rest.
    """
    problem = AppearanceProblem.of(capture, settings)
    records, best, schedule = [], None, settings.light_schedule
    highlights_count, first, last_fitted = settings.specular, 0, np.inf
    state = FitState(problem.uniform_start(), problem.errors)
    if start is not None:
        state = replace(state, appearance=problem.start_from(start.state))
        highlights_count, first = highlights_count and start.highlights_count, len(schedule) - 1
        last_fitted = start.fitted if keep_start else np.inf
    for stage, (model, resolution) in list(enumerate(schedule))[first:]:
        shares = state.errors.light_shares
        state = replace(state, appearance=problem.with_light_model(state.appearance, model, resolution, shares))
        last, shaping_steps = np.inf, _SHAPING_STEPS if start is None and stage == 0 else 1
        worthwhile = _WORTHWHILE if stage == len(schedule) - 1 else _WORTHWHILE_COARSE
        anew = shapes or start is None if stage == first else highlights_count and model != schedule[stage - 1][0]
        phase = Phase.SHAPING if anew and settings.steps > 1 else Phase.SOLVING
        enough = 2 if phase is Phase.SHAPING else least
        kept = None
        for number in range(settings.steps):
            counts = highlights_count and phase is Phase.SOLVING
            state, found = step(problem, state, counts, light_moves=number > 0 or not keep_start)
            record = found.record(model, resolution, number, phase) | {"points": len(capture.points)}
            if kept is not None and found.rise > _LARGEST_RISE:
                state, highlights_count = replace(state, appearance=kept[0]), False
                records.append(record | {"undone": True})
                report(records[-1])
                if best is None and model == settings.light_model:
                    best = (kept[1].judged(capture, settings.independent), kept[1], kept[0])
                break
            kept = state.appearance, found
            records.append(record)
            report(record)
            judged = found.judged(capture, settings.independent)
            if phase is Phase.SOLVING and model == settings.light_model:
                settled = found.scale is not None
                if best is None or settled and best[1].scale is None:
                    best = (judged, found, state.appearance)
                elif (settled or best[1].scale is None) and judged <= best[0] * (1.0 + _WORTHWHILE):
                    best = (min(judged, best[0]), found, state.appearance)
            if phase is Phase.SHAPING:
                change = abs(found.fitted / last_fitted - 1.0)
                if number + 1 >= shaping_steps and change < _SHAPED or number + 2 >= settings.steps:
                    phase, enough = Phase.SOLVING, number + 1 + enough
            elif number >= enough and judged > last * (1.0 - worthwhile):
                if not highlights_count or found.rescaled < _CONVERGED_SCALE:
                    break
            last, last_fitted = judged, found.fitted
    _, found, appearance = best
    return Solution(
        appearance, tuple(records), fitted=found.fitted, held_out=found.held_out, highlights_count=highlights_count,
        frame_errors=found.frame_errors, light_weights=found.light_weights, scale=found.scale,
        lamp=None if capture.lamp is None else capture.lamp.lamp,
    )


def at_mean_scale(solution: Solution) -> Solution:
    """The solution with light, albedo and specular intensity of the scale that is expected in the mean, in place of the
    most likely one: what diffuse skin sends out stays as it is. Unchanged where the scale was not at rest."""
    if solution.scale is None:
        return solution
    state, log_factor = solution.state, solution.scale.beyond[:3]
    state = replace(
        state,
        params=state.light_model.scaled(state.params, log_factor),
        albedo=state.albedo * np.exp(-log_factor),
        node_albedo=state.node_albedo * np.exp(-log_factor),
        specular=float(np.clip(state.specular * np.exp(solution.scale.beyond[3]), *SPECULAR_RANGE)),
    )
    return replace(solution, state=state)


def fit_sharper_light(
    capture: Capture,
    settings: AppearanceSettings,
    solution: Solution,
    report: Callable[[dict], None] = lambda record: None,
) -> Solution:
    """A capture's solution after some last steps under settings.at_last, unless held-out frames are against them; their
    records follow in either case.

    Diffuse skin shows the light's broad part times the albedo, highlights its lamps times their intensity. So a smooth
    prior on the light has a way to flatten lamps that samples hardly oppose: a darker albedo under a brighter light and
    a higher intensity. While shape and poses are being found their errors would pass for lamps without it.
    """
    last = fit_appearance(capture, replace(settings.at_last, steps=_LAST_STEPS), report, start=solution)
    if last.held_out > solution.held_out * (1.0 + _WORTHWHILE):
        return replace(solution, iterations=solution.iterations + last.iterations)
    return _continued(solution, last)


def fit_all_points(
    capture: Capture,
    settings: AppearanceSettings,
    coarse: Solution,
    report: Callable[[dict], None] = lambda record: None,
) -> Solution:
    """The solution of a whole capture from that of some of its points, whose light is at rest: roughness, strength of
    highlights, scale and albedo under that light, then one step of everything, kept where it serves. Its records follow
    the coarse one's, and where its scale still waits what is known of the scale is the coarse one's.

    Unknowns of the light are few beside samples even of a quarter of the points, and Gauss-Newton steps from there
    converge at once; what takes many steps is the way to the first shape of the light, and roughness and scale in turn.
    """
    whole = fit_appearance(capture, replace(settings, steps=2), report, start=coarse, keep_start=True)
    return _continued(coarse, whole)


def _continued(before: Solution, after: Solution) -> Solution:
    """The later solution with the records of both; where its scale waits, what is known of it is the earlier one's."""
    scale = before.scale if after.scale is None else after.scale
    return replace(after, iterations=before.iterations + after.iterations, scale=scale)


def step(
    problem: AppearanceProblem, state: FitState, highlights_count: bool, light_moves: bool = True
) -> tuple[FitState, StepReport]:
    """One step of everything. highlights_count: they say something about the scale and their own strength; light_moves:
    the light changes, and not only its scale."""
    errors = state.errors
    linear = _linearised(problem, state, highlights_count)
    before, spread = errors.loss(linear.radiance)
    params, cost = linear.improved_light() if light_moves else (linear.state.params, 0.0)
    resolved = linear.resolved_scale(params)
    appearance = replace(resolved.state, node_albedo=resolved.state.albedo[problem.node_to_point])
    model = appearance.radiance(resolved.irradiance, resolved.reflection)
    rise = errors.loss(model, spread)[0] / before
    errors = errors.with_reduced_chi_square(model, linear.weight)
    fitted, held_out = errors.residuals(model)
    light_weights = ()
    if len(errors.light_frames) > 1:
        along = torch.from_numpy(resolved.transport.frame_light.along(appearance.light))
        errors, light_weights = weigh_samples(problem.capture, appearance, errors, along, resolved.irradiance, model)
        appearance = replace(appearance, light_model=appearance.light_model.with_shares(errors.light_shares))
    found = StepReport(
        fitted=fitted,
        held_out=held_out,
        cost=cost,
        rescaled=resolved.rescaled,
        skin_prior=linear.unlikely_skin(resolved.albedo),
        specular_intensity=appearance.specular,
        roughness=appearance.roughness,
        light_weights=light_weights,
        rise=rise,
        frame_errors=errors.frame_errors(model),
        scale=resolved.scale,
    )
    return FitState(appearance, errors), found


def _linearised(problem: AppearanceProblem, state: FitState, highlights_count: bool) -> LinearisedFit:
    """The linearised problem, where highlights count at about the roughness that they have in the present light: until
    then they would lead the scale astray."""
    transport = problem.transport(state.appearance)
    linear = LinearisedFit.at(problem, state.appearance, transport, state.errors, highlights_count)
    for _ in range(_ROUGHNESS_STEPS):
        if linear.specular_fit is None or abs(linear.specular_fit.change_of_roughness) < LARGEST_ROUGHNESS_STEP:
            break
        before, change = linear.state, linear.specular_fit.change_of_roughness
        after = replace(before, roughness=changed_roughness(before.roughness, change))
        transport = replace(transport, lobes=None)
        del linear  # and with it the tables of the roughness before
        transport = replace(transport, lobes=problem.lobes_at(after.roughness))
        linear = LinearisedFit.at(problem, after, transport, state.errors, highlights_count)
        if abs(np.log(after.roughness / before.roughness)) < LARGEST_ROUGHNESS_STEP:  # as far as its range goes
            break
    return linear
