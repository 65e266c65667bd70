"""No more model than the scene needs: models of rising cost, tried while held-out frames fit better.

Each part of the model has candidates of its own, from the least to the most:

    visibility  off, on, bounces
    light       harmonics_2, sun_sky, harmonics_4, cubemap_8, cubemap_16, cubemap_32
    specular    none, one_value; by_segment, local (selection/specular.py)
    geometry    tracked, refined, subdivided (inverse/model_selection.py)
    roughness   one_value; by_segment, local (selection/specular.py)

The selection starts with the least of all and tries the next candidate of one part after the other, each from the
solution before it, until no part gains any more. A candidate is accepted if the mean absolute error on held-out frames,
paired frame by frame, falls by more than its standard error; where a candidate brings unknowns, also by more than a
step of the solver that is worth while. Candidates are not all nested (a sun in the sky is no special case of
harmonics), so that the one beyond a candidate that did not serve is tried, too, and where the selection ends without
shadows, all parts at once.

Reference: [Breiman1984], section 3.4.3 (the one-standard-error rule).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from shared.appearance.fit import Solution, fit_appearance
from shared.appearance.observations import Capture
from shared.appearance.problem import AppearanceProblem, AppearanceSettings

LIGHTS = {
    "harmonics_2": ("harmonics_2", 8),
    "sun_sky": ("sun_sky", 16),
    "harmonics_4": ("harmonics_4", 8),
    "cubemap_8": ("cubemap", 8),
    "cubemap_16": ("cubemap", 16),
    "cubemap_32": ("cubemap", 32),
}
"""Model and resolution of each candidate for the light."""
VISIBILITIES = ("off", "on", "bounces")
SPECULARS = ("none", "one_value")
WORTHWHILE = 0.005
"""A candidate with more unknowns must lower the error by this share, too: as much as the solver leaves when it
stops."""
WORTHWHILE_SPECULAR = 0.02
"""The same for the first highlights, which cost most: three quarters of a fit's time."""
PARTS = ("visibility", "specular", "light", "geometry", "roughness")
"""What can be fixed."""
FEWEST_HELD_OUT = 3
"""Frames, below which differences between them have no standard error."""
SELECTION_STEPS, MOVES = 8, 2
"""Most and fewest steps from one candidate to the next: the first one from a light of another model can be worse."""
SELECTION_PRECISION = (10, 0.03)
"""Of a step of the light while candidates are tried: the chosen model is solved again, with full precision."""
FINE_LIGHTS, FINE_MOVES = ("cubemap_16", "cubemap_32"), 4
"""What these add, the shape of a lamp, only comes out in several steps of the whole solve's precision."""
LOOK_AHEAD = 2


class Model(NamedTuple):
    """A candidate of each part."""

    visibility: str
    specular: str
    light: str

    def applied(self, settings: AppearanceSettings) -> AppearanceSettings:
        """Settings of this model."""
        light_model, resolution = LIGHTS.get(self.light, (self.light, settings.resolutions[-1]))
        return replace(
            settings,
            light_model=light_model,
            resolutions=(resolution,),
            visibility=self.visibility != "off",
            bounce=self.visibility == "bounces",
            specular=self.specular != "none",
        )


def allowed_candidates(
    settings: AppearanceSettings, forced: frozenset[str] = frozenset()
) -> dict[str, tuple[str, ...]]:
    """The candidates of each part up to what the settings say; of forced parts only that."""
    finest = max(settings.resolutions)
    lights = tuple(name for name, (model, resolution) in LIGHTS.items() if model != "cubemap" or resolution <= finest)
    if ("cubemap", finest) not in LIGHTS.values():
        lights += ("cubemap",)  # of the one resolution that the settings name
    visibility = 1 + settings.visibility + (settings.visibility and settings.bounce)
    candidates = {
        "visibility": VISIBILITIES[:visibility],
        "light": lights if settings.light_model == "cubemap" else (settings.light_model,),
        "specular": SPECULARS[: 1 + settings.specular],  # last: with highlights a candidate costs ten times as much
    }
    return {part: names[-1:] if part in forced else names for part, names in candidates.items()}


@dataclass(frozen=True)
class Trial:
    """A model's solution on the small capture, its error in each held-out frame [H], and the seconds it took."""

    model: Model
    solution: Solution
    errors: np.ndarray
    seconds: float


def gain(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """By how much the errors of the same frames, before [H] and after [H], fell in the mean, and the standard error
    of that."""
    falls = before - after
    return float(falls.mean()), float(falls.std(ddof=1) / np.sqrt(len(falls)))


def serves(before: np.ndarray, after: np.ndarray, worthwhile: float = WORTHWHILE) -> bool:
    """Whether errors, before [H] and after [H], fell by more than chance, and by more than a share of them.
    worthwhile: that share."""
    fall, standard_error = gain(before, after)
    return fall > max(standard_error, worthwhile * float(before.mean()))


class ModelSelection:
    """Selects the appearance's parts on small captures of a clip.

    captures: with visibility (True) and without; report: receives a record of each candidate that was tried.
    """

    def __init__(
        self,
        captures: Mapping[bool, Capture],
        settings: AppearanceSettings,
        candidates: Mapping[str, tuple[str, ...]],
        report: Callable[[dict], None] = lambda record: None,
    ):
        self.captures, self.candidates, self.report = captures, candidates, report
        self.settings = settings
        self.tried: set[Model] = set()
        self.present: Trial | None = None

    def select(self) -> Trial:
        """The model that no candidate beyond serves better."""
        if self.present is None:
            self.begin(Model(**{part: names[0] for part, names in self.candidates.items()}))
            self.report(describe("start", ", ".join(self.present.model), self.present))
        self._select_parts()
        shadows_did_not_serve = self.present.model.visibility == "off" and self.candidates["visibility"][-1] != "off"
        if shadows_did_not_serve and self._leap():
            self._select_parts()
        return self.present

    def _select_parts(self) -> None:
        while any([self._select_part(part) for part in self.candidates]):
            pass

    def _leap(self) -> bool:
        """All parts at once, from a uniform light: shadows that cost nothing and yet do not serve mean that the
        selection stands where no single part leads out, as under one hard lamp."""
        lights = self.candidates["light"]
        model = Model(self.candidates["visibility"][-1], self.candidates["specular"][-1],
                      next((name for name in lights if name.startswith("cubemap")), lights[-1]))
        if model in self.tried:
            return False
        self.tried.add(model)
        trial = self._try(model, None)
        more_specular = model.specular != self.present.model.specular
        better = serves(self.present.errors, trial.errors, WORTHWHILE_SPECULAR if more_specular else WORTHWHILE)
        self.report(describe("leap", ", ".join(model), trial, self.present, better))
        if better:
            self.present = trial
        return better

    def begin(self, model: Model, start: Solution | None = None) -> None:
        """Solves a model to start from, from a solution or from a uniform light."""
        self.present = self._try(model, start)
        self.tried.add(model)

    def _capture(self, model: Model) -> Capture:
        return self.captures[model.visibility != "off"]

    def _select_part(self, part: str) -> bool:
        """Goes up one part as far as it serves."""
        names, selected, missed = self.candidates[part], False, 0
        place = names.index(getattr(self.present.model, part))
        while missed < self._patience(part) and place + 1 < len(names):
            place += 1
            if (self.present.model.light, names[place]) == ("sun_sky", "harmonics_4"):
                continue  # which cannot show the sun
            model = self.present.model._replace(**{part: names[place]})
            # What a finer cubemap did not show of matt skin it does not show of glossy skin either, on the same mesh.
            finer = part == "light" and self.present.model.light.startswith("cubemap")
            if model in self.tried or finer and model._replace(specular="none") in self.tried:
                missed += 1
                continue
            self.tried.add(model)
            trial = self._try(model, self.present.solution)
            if part == "visibility" and self._at_bottom():
                # What fits without shadows can be a long way from what fits with them.
                trial = min(trial, self._try(model, None), key=lambda trial: trial.errors.mean())
            # Shadows and bounces bring no unknowns that could follow the noise, and cost next to nothing.
            worthwhile = {"visibility": 0.0, "specular": WORTHWHILE_SPECULAR}.get(part, WORTHWHILE)
            better = serves(self.present.errors, trial.errors, worthwhile)
            self.report(describe(part, names[place], trial, self.present, better))
            if better:
                self.present, selected, missed = trial, True, 0
            else:
                missed += 1
        return selected

    def _patience(self, part: str) -> int:
        """How many candidates in a row may not serve: a cubemap that a finer one does not improve is fine enough."""
        return 1 if part == "light" and self.present.model.light.startswith("cubemap") else LOOK_AHEAD

    def _at_bottom(self) -> bool:
        """Whether nothing but the visibility has gained."""
        return all(getattr(self.present.model, part) == self.candidates[part][0] for part in ("specular", "light"))

    def _try(self, model: Model, start: Solution | None) -> Trial:
        begun = time.perf_counter()
        settings, capture, keeps_start = model.applied(self.settings), self._capture(model), start is not None
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
        errors = solution.frame_errors[~capture.fitted]
        return Trial(model, solution, errors, time.perf_counter() - begun)


def describe(part: str, candidate: str, trial: Trial, below: Trial | None = None, selected: bool = True) -> dict:
    """A candidate's line of the record; the standard error is that of the fall."""
    fall, standard_error = (None, None) if below is None else gain(below.errors, trial.errors)
    return {
        "part": part,
        "candidate": candidate,
        "held_out": float(trial.errors.mean()),
        "fall": fall,
        "standard_error": standard_error,
        "accepted": selected,
        "seconds": round(trial.seconds, 3),
    }
