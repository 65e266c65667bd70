"""No more model than the scene needs: models of rising cost, tried while held-out frames fit better.

Each part of the model has candidates of its own, from the least to the most:

    light       harmonics_2, sun_sky, harmonics_4, cubemap_8, cubemap_16, cubemap_32
    specular    none, one_value

Shadows and bounces are always there: they have no unknowns that could follow the noise, and cost next to nothing. The
selection starts with the least of all and tries the next candidates of the light on matt skin, each from the solution
before it, then highlights, and with these, which show a lamp that matt skin may not, the light again.

What is judged is the mean absolute error on held-out frames, paired frame by frame, with what the prior on skin says
against the albedo: where no frame tells light from albedo, shading that ends in the albedo would cost nothing. A
candidate must let that fall by a share that is worth its unknowns. Where the fall lies within its standard error of
that share, the frames leave it open, and the fuller model is taken, a fuller light only unless the error rose.
Candidates are not all nested (a sun in the sky is no special case of harmonics), so that the one beyond a candidate
that did not serve is tried, too.

docs/selection.md derives this, and says what of the marginal likelihood it leaves out.

References: [Breiman1984], section 3.4.3 (the standard error of the fall); [Mackay1992], [Schwarz1978] (the marginal
likelihood); [Stone1977] (what held-out samples charge for an unknown).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from shared.appearance.fit import Solution, fit_appearance
from shared.appearance.observations import Capture
from shared.appearance.problem import AppearanceProblem, AppearanceSettings
from shared.rendering.direction_set import concentrated
from shared.rendering.envmap import lamp_solid_angle, lamp_texels
from shared.rendering.shading import light_along

LIGHTS = {
    "harmonics_2": ("harmonics_2", 8),
    "sun_sky": ("sun_sky", 16),
    "harmonics_4": ("harmonics_4", 8),
    "cubemap_8": ("cubemap", 8),
    "cubemap_16": ("cubemap", 16),
    "cubemap_32": ("cubemap", 32),
}
"""Model and resolution of each candidate for the light."""
SPECULARS = ("none", "one_value")
WORTHWHILE = {"light": 0.005, "specular": 0.0}
"""Share by which a candidate must lower the error: one of the light has more unknowns, and the solver leaves as much
when it stops. Highlights are there on any skin, and what is unknown of them their priors nearly say."""
EXISTING = ("specular",)
"""What is there whether or not held-out frames show it: left open, whose sign then is chance, it is taken. So is the
shape of a lamp that a cubemap is too coarse for."""
PARTS = ("light", "specular", "samples", "maps")
"""What can be fixed: these candidates, how much of the clip the light is solved from, and how fine the maps are."""
FEWEST_HELD_OUT = 3
"""Frames, below which differences between them have no standard error."""
SELECTION_STEPS, MOVES = 5, 2
"""Most and fewest steps from one candidate to the next: the first one from a light of another model can be worse."""
SELECTION_PRECISION = (10, 0.03)
"""Of a step of the light while candidates are tried: the chosen model is solved again, with full precision."""
FINE_LIGHTS, FINE_MOVES = ("cubemap_16", "cubemap_32"), 4
"""What these add, the shape of a lamp, only comes out in several steps of the whole solve's precision."""
UNRESOLVED = 5.0
"""Texels of a cubemap, on which a lamp that covers fewer is as wide as its smoothness lets it be: a point of light
covers 2.5 to 4.5, the sun in a sky 5.7, a window or a soft box 12 and more."""
LOOK_AHEAD = 2


class Model(NamedTuple):
    """A candidate of each part."""

    light: str
    specular: str

    def applied(self, settings: AppearanceSettings) -> AppearanceSettings:
        """Settings of this model."""
        light_model, resolution = LIGHTS.get(self.light, (self.light, settings.resolutions[-1]))
        return replace(settings, light_model=light_model, resolutions=(resolution,), specular=self.specular != "none")


def allowed_candidates(
    settings: AppearanceSettings, forced: frozenset[str] = frozenset()
) -> dict[str, tuple[str, ...]]:
    """The candidates of each part up to what the settings say; of forced parts only that."""
    finest = max(settings.resolutions)
    lights = tuple(name for name, (model, resolution) in LIGHTS.items() if model != "cubemap" or resolution <= finest)
    if ("cubemap", finest) not in LIGHTS.values():
        lights += ("cubemap",)  # of the one resolution that the settings name
    candidates = {
        "light": lights if settings.light_model == "cubemap" else (settings.light_model,),
        "specular": SPECULARS[: 1 + settings.specular],
    }
    return {part: names[-1:] if part in forced else names for part, names in candidates.items()}


@dataclass(frozen=True)
class Trial:
    """A model's solution on the small capture, its error in each held-out frame [H] as joint_errors has it, and the
    seconds it took."""

    model: Model
    solution: Solution
    errors: np.ndarray
    seconds: float


def joint_errors(capture: Capture, solution: Solution, independent: float) -> np.ndarray:
    """[H] mean absolute errors of the held-out frames, raised by what the prior on skin says against the albedo, as
    StepReport.judged raises the residual; independent: samples that the clip counts as."""
    found = next(step for step in reversed(solution.iterations)
                 if (step["fitted"], step["held_out"]) == (solution.fitted, solution.held_out))
    against = 2.0 * found["skin_prior"] / ((1.0 - capture.fitted.mean()) * independent)
    return solution.frame_errors[~capture.fitted] * (1.0 + against) ** 0.5


def gain(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """By how much the errors of the same frames, before [H] and after [H], fell in the mean, and the standard error
    of that."""
    falls = before - after
    return float(falls.mean()), float(falls.std(ddof=1) / np.sqrt(len(falls)))


class Decision(Enum):
    """What held-out frames say of a candidate."""

    SERVES = "serves"
    OPEN = "open"
    """They cannot tell: of two models the fuller is taken, since what it lacks would go into the albedo, and what it
    has too much costs time alone."""
    DOES_NOT = "does not serve"

    @property
    def accepted(self) -> bool:
        return self is not Decision.DOES_NOT


def judge(before: np.ndarray, after: np.ndarray, worthwhile: float, exists: bool = False) -> Decision:
    """Whether errors, before [H] and after [H], fell by more than the share worthwhile of them, for certain. One
    that does not let them fall is not taken where they cannot tell, unless what it adds exists on any skin."""
    fall, standard_error = gain(before, after)
    beyond = fall - worthwhile * float(before.mean())
    if (exists or fall > 0.0) and abs(beyond) <= standard_error:
        return Decision.OPEN
    return Decision.SERVES if beyond > 0.0 else Decision.DOES_NOT


class ModelSelection:
    """Selects light and highlights on a small capture of a clip.

    report: receives a record of each candidate that was tried.
    """

    def __init__(
        self,
        capture: Capture,
        settings: AppearanceSettings,
        candidates: Mapping[str, tuple[str, ...]],
        report: Callable[[dict], None] = lambda record: None,
    ):
        self.capture, self.settings, self.candidates, self.report = capture, settings, candidates, report
        self.tried: set[Model] = set()
        self.present: Trial | None = None

    def select(self) -> Trial:
        """The model that no candidate beyond serves better."""
        least = Model(**{part: names[0] for part, names in self.candidates.items()})
        self.present = self._try(least, None)
        self.report(describe("start", ", ".join(least), self.present))
        while any([self._select_part(part) for part in self.candidates]):
            pass
        return self.present

    def _select_part(self, part: str) -> bool:
        """Goes up one part as far as it serves."""
        names, selected, missed = self.candidates[part], False, 0
        for name in names[names.index(getattr(self.present.model, part)) + 1 :]:
            if missed == self._patience(part):
                break
            if (self.present.model.light, name) == ("sun_sky", "harmonics_4"):
                continue  # which cannot show the sun
            if name in FINE_LIGHTS and not self._shows_lamp():
                break
            model = self.present.model._replace(**{part: name})
            if model in self.tried:
                missed += 1
                continue
            exists = part in EXISTING or name in FINE_LIGHTS and self._leaves_lamp_unresolved()
            trial = self._try(model, self.present.solution)
            decision = judge(self.present.errors, trial.errors, 0.0 if exists else WORTHWHILE[part], exists)
            self.report(describe(part, name, trial, self.present, decision))
            if decision.accepted:
                self.present, selected, missed = trial, True, 0
            else:
                missed += 1
        return selected

    def _shows_lamp(self) -> bool:
        """Whether the present light has a lamp, whose shape is all that a finer cubemap could add."""
        capture, light = self.capture, self.present.solution.state.light
        along = light_along(light, capture.directions, capture.world_from_head, capture.light_index)
        return bool(concentrated(along).any())

    def _leaves_lamp_unresolved(self) -> bool:
        """Whether a cubemap is as coarse as the lamp that it shows, so that a finer one's shape of it is there in any
        case. Errors of a mesh that was only tracked hide it: held-out frames may see no more than that they are open.
        """
        state = self.present.solution.state
        if not self.present.model.light.startswith("cubemap"):
            return False
        lights = np.split(state.light, len(self.capture.frames_of_lights))
        return any(lamp_solid_angle(light, lamp_texels(light)) * len(light) < UNRESOLVED * 4.0 * np.pi
                   for light in lights)

    def _patience(self, part: str) -> int:
        """How many candidates in a row may not serve: a cubemap that a finer one does not improve is fine enough."""
        return 1 if part == "light" and self.present.model.light.startswith("cubemap") else LOOK_AHEAD

    def _try(self, model: Model, start: Solution | None) -> Trial:
        begun = time.perf_counter()
        self.tried.add(model)
        settings, capture, keeps_start = model.applied(self.settings), self.capture, start is not None
        fine = model.light in FINE_LIGHTS
        if not fine:
            settings = replace(settings, precision=SELECTION_PRECISION)
        # A cubemap can show what any light before it is; the others can lose the lamp that highlights were found in.
        changed = self.present is not None and model.light != self.present.model.light
        shapes = not keeps_start or changed and not model.light.startswith("cubemap")
        if start is None:
            start = Solution(AppearanceProblem.of(capture, settings).uniform_start(), (), np.inf, np.inf)
        else:
            settings = replace(settings, steps=min(settings.steps, SELECTION_STEPS))
        if changed:  # another light, another chance for highlights
            start = replace(start, highlights_count=True)
        if settings.specular and start.state.specular == 0.0:
            fresh = replace(start.state, specular=settings.specular_prior[0], roughness=settings.roughness)
            start, keeps_start, shapes = replace(start, state=fresh, highlights_count=True), False, True
        solution = fit_appearance(
            capture, settings, start=start, keep_start=keeps_start, least=FINE_MOVES if fine else MOVES,
            shapes=settings.specular and shapes,
        )
        errors = joint_errors(capture, solution, settings.independent)
        return Trial(model, solution, errors, time.perf_counter() - begun)


def describe(
    part: str, candidate: str, trial: Trial, below: Trial | None = None, decision: Decision = Decision.SERVES
) -> dict:
    """A candidate's line of the record; the standard error is that of the fall."""
    fall, standard_error = (None, None) if below is None else gain(below.errors, trial.errors)
    return {
        "part": part,
        "candidate": candidate,
        "held_out": float(trial.errors.mean()),
        "fall": fall,
        "standard_error": standard_error,
        "accepted": decision.accepted,
        "open": decision is Decision.OPEN,
        "seconds": round(trial.seconds, 3),
    }
