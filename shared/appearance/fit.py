"""The whole appearance fit: light steps from coarse to fine, a stop on held-out frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from shared.appearance.light_step import LightStep
from shared.appearance.light_weights import weigh_samples
from shared.appearance.local_roughness import SpecularEquations, local_roughness
from shared.appearance.observations import Capture
from shared.appearance.solver import LARGEST_ROUGHNESS_STEP, AppearanceSettings, AppearanceSolver, AppearanceState

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

_ROUGHNESS_STEPS = 8
"""At most, of the roughness by itself before a step of all."""

_LARGEST_RISE = 1.05
"""A step after which the robust loss on fitted samples is higher by more than this factor is undone, and ends its
resolution: the specular intensity and the scale follow priors as well as samples, and on a clip that contradicts the
model (an expression that changes, a palette of few colours) they can lead away from it."""


@dataclass(frozen=True)
class Solution:
    """The last State of those that are best by held-out residual; iterations: one record per step; fitted and held_out:
    its residuals; local_roughness_fit: where roughness varies over the skin, how, and roughness_record what the
    held-out frames said to that; trusted: whether highlights took part to the end; frame_errors [F]: each frame's mean
    absolute residual; local_specular: where the specular intensity varies with the face's segments, how; light_weights:
    of several lights, how much samples of each count against those of the light that the model follows best."""

    state: AppearanceState
    iterations: tuple[dict, ...]
    fitted: float
    held_out: float
    local_roughness_fit: SpecularEquations | None = None
    roughness_record: dict = field(default_factory=dict)
    trusted: bool = True
    frame_errors: np.ndarray | None = None
    local_specular: SpecularEquations | None = None
    light_weights: tuple[float, ...] = ()


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

    The first steps, and those after a change of the light's model, only give the light its shape ("shaping" in their
    records); highlights, which then begin to say something about the scale, take part after those, but not again after
    a step that had to be undone. Only states after the first steps, of the light model asked for, can win, or the one
    that a step was undone to; of those that do about as well the last, whose scale has come to rest.
    """
    solver = AppearanceSolver(capture, settings)
    # A clip too short to hold frames out is judged by the fitted ones.
    name, share = ("fitted", 1.0) if capture.fitted.all() else ("held_out", 1.0 - capture.fitted.mean())
    judge = partial(_judged, name=name, count=share * settings.independent)
    records, best, schedule = [], None, settings.light_schedule
    trusts, first, last_fitted = settings.specular, 0, np.inf
    if start is not None:
        solver.start_from(start.state)
        trusts, first = trusts and start.trusted, len(schedule) - 1
        last_fitted = start.fitted if keep_start else np.inf
    for stage, (model, resolution) in list(enumerate(schedule))[first:]:
        solver.set_light((model, resolution))
        last, shaping_steps = np.inf, _SHAPING_STEPS if start is None and stage == 0 else 1
        worthwhile = _WORTHWHILE if stage == len(schedule) - 1 else _WORTHWHILE_COARSE
        anew = shapes or start is None if stage == first else trusts and model != schedule[stage - 1][0]
        shaping = anew and settings.steps > 1
        enough = 2 if shaping else least
        kept = None
        for number in range(settings.steps):
            moves = number > 0 or not keep_start
            record, rise, by_frame = _step(solver, settings, trusts and not shaping, moves)
            record |= {"light": model, "resolution": resolution, "step": number, "shaping": shaping}
            if kept is not None and rise > _LARGEST_RISE:
                solver.state, solver.lobes, trusts = kept[1], None, False
                records.append(record | {"undone": True})
                report(records[-1])
                if best is None and model == settings.light_model:
                    best = (judge(kept[0]), kept[0], _copy(solver.state), kept[2])
                break
            kept = record, _copy(solver.state), by_frame
            records.append(record)
            report(record)
            judged = judge(record)
            if not shaping and model == settings.light_model:
                lowest = judged if best is None else min(judged, best[0])
                if best is None or judged <= lowest * (1.0 + _WORTHWHILE):
                    best = (lowest, record, _copy(solver.state), by_frame)
            if shaping:
                change = abs(record["fitted"] / last_fitted - 1.0)
                if number + 1 >= shaping_steps and change < _SHAPED or number + 2 >= settings.steps:
                    shaping, enough = False, number + 1 + enough
            elif number >= enough and judged > last * (1.0 - worthwhile):
                if not trusts or record["rescaled"] < _CONVERGED_SCALE:
                    break
            last, last_fitted = judged, record["fitted"]
    _, record, state, by_frame = best
    return Solution(
        state, tuple(records), fitted=record["fitted"], held_out=record["held_out"], trusted=trusts,
        frame_errors=by_frame,
        light_weights=tuple(record.get("light_trust", ())),
    )


def _judged(record: dict, name: str, count: float) -> float:
    """The residual of a step, raised by what the prior on skin says against its albedo.

    A residual r of count independent samples and a prior's cost p together are as likely as a residual of
    r sqrt(1 + 2 p / count) alone: no frame shows what samples leave open.
    """
    return record[name] * (1.0 + 2.0 * record["skin_prior"] / count) ** 0.5


def with_local_roughness(solver: AppearanceSolver, solution: Solution) -> Solution:
    """The solution that the solver, baked, stands at, with roughness that varies over the skin where that serves."""
    if not (solver.settings.specular and solver.settings.local_roughness):
        return solution
    local_roughness_fit, said = local_roughness(solver)
    return replace(solution, local_roughness_fit=local_roughness_fit, roughness_record=said)


def _step(
    solver: AppearanceSolver, settings: AppearanceSettings, trusts: bool, moves: bool = True
) -> tuple[dict, float, np.ndarray]:
    """One step of everything -> its record, by what factor the robust loss rose, and the error of each frame [F];
    trusts: highlights say something about the scale and their own strength; moves: the light changes, and not only its
    scale."""
    solver.trust_highlights = trusts
    solver.bake()
    if settings.specular and solver.lobes is None:
        solver.bake_lobes()
    step = _linearised(solver)
    before, spread = solver.loss(step.radiance)
    if moves:
        step.update()
    rescaled = step.resolve_scale()
    state = solver.state
    state.node_albedo = state.albedo[solver.node_to_point]
    model = solver.model(step.irradiance, step.reflection)
    rise = solver.loss(model, spread)[0] / before
    solver.measure_reduced_chi_square(model, step.weight)
    fitted, held_out = solver.residuals(model)
    several = {}
    if len(solver.light_frames) > 1:
        several = {"light_trust": weigh_samples(solver, step.irradiance, model)}
    return several | {
        "fitted": fitted,
        "held_out": held_out,
        "cost": step.before,
        "rescaled": rescaled,
        "skin_prior": step.unlikely_skin(step.albedo),
        "specular_intensity": state.specular,
        "roughness": state.roughness,
    }, rise, solver.frame_errors(model)


def _linearised(solver: AppearanceSolver) -> LightStep:
    """The linearised problem, where highlights count at about the roughness that they have in the present light: until
    then they would lead the scale astray."""
    step = LightStep(solver)
    for _ in range(_ROUGHNESS_STEPS):
        if step.specular_fit is None or abs(step.specular_fit.change_of_roughness) < LARGEST_ROUGHNESS_STEP:
            break
        roughness_step = solver.update_roughness(step.specular_fit.change_of_roughness)
        step = LightStep(solver)
        if roughness_step < LARGEST_ROUGHNESS_STEP:  # as far as its range goes
            break
    return step


def _copy(state: AppearanceState) -> AppearanceState:
    return replace(state, params=state.params.copy(), albedo=state.albedo.copy())
