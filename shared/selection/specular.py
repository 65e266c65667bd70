"""Model selection's upper candidates: specular intensity and roughness that vary over the skin, by face segment or
locally.

Under the light that was found, the points' specular equations (local_roughness) are summed over all of the skin, over a
face segment, or over a neighbourhood. Albedo is projected out anew each time; held-out frames decide as on every
candidate.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from shared.appearance.fit import Solution
from shared.appearance.local_roughness import SpecularEquations, specular_equations_of
from shared.appearance.observations import Capture
from shared.appearance.problem import AppearanceProblem, AppearanceSettings
from shared.appearance.projection import best_albedo
from shared.selection.candidates import LOOK_AHEAD, Trial, describe, serves

VARIATIONS = ("one_value", "by_segment", "local")
POOLING = {"one_value": (np.inf,), "by_segment": (np.inf,), "local": (1 / 16, 1 / 64)}
"""Widths, relative to the map, over which texels share their specular intensity."""


@dataclass(frozen=True)
class SegmentSpecular(SpecularEquations):
    """Equations summed over face segments; segment [P] of each point."""

    segment: np.ndarray | None = None

    def _pooled(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Curvature and moment [N, R] of the segments of positions [N, 3], with the intensity's prior."""
        own = self.segment[cKDTree(self.positions).query(positions)[1]]
        mean, precision = self.specular
        curvature, moment = (
            np.stack([np.bincount(self.segment, row) for row in values], axis=1)[own]
            for values in (self.curvature, self.moment)
        )
        return curvature + precision, moment + precision * mean


@dataclass(frozen=True)
class SpecularVariation:
    """How specular intensity and roughness vary: the candidates, and the equations behind them (None: one value)."""

    specular: str = "one_value"
    roughness: str = "one_value"
    specular_equations: SpecularEquations | None = None
    roughness_equations: SpecularEquations | None = None

    def worn_by(self, solution: Solution) -> Solution:
        """A solution of the same model, with roughness and specular intensity that vary about its own values."""
        state = solution.state

        def about(equations: SpecularEquations | None) -> SpecularEquations | None:
            if equations is None:
                return None
            logs = equations.logs - equations.logs.mean() + np.log(state.roughness)
            return replace(equations, logs=logs, specular=(state.specular, equations.specular[1]))

        return replace(
            solution, roughness_record={"chosen": self.roughness},
            local_roughness_fit=about(self.roughness_equations), local_specular=about(self.specular_equations),
        )


class SpecularSelection:
    """Selects the variation of specular terms under a solution that has highlights.

    segment [P] of the capture's points, or None; candidates: of "specular" and "roughness"; report: receives the
    records.
    """

    def __init__(
        self,
        capture: Capture,
        settings: AppearanceSettings,
        trial: Trial,
        segment: np.ndarray | None,
        candidates: Mapping[str, tuple[str, ...]],
        report: Callable[[dict], None],
    ):
        self.problem, self.state = AppearanceProblem.of(capture, settings), trial.solution.state
        transport = self.problem.transport(self.state)
        self.irradiance, self.reflection = transport.forward(self.state.light)
        model = self.state.radiance(self.irradiance, self.reflection)
        self.weight = self.problem.errors.weights(model)
        errors = self.problem.errors.with_reduced_chi_square(model, self.weight)
        self.transport = replace(transport, lobes=None)
        local = specular_equations_of(
            self.problem, self.state, self.transport, errors, self.irradiance, self.weight * errors.fitted
        )
        self.pools: dict[str, SpecularEquations | None] = {"one_value": None, "local": local}
        if segment is not None:
            by_segment = SegmentSpecular(**vars(local), segment=segment)
            self.pools["by_segment"] = by_segment.centred()
        self.trial, self.candidates, self.report = trial, candidates, report

    def select(self) -> SpecularVariation:
        """The variation that no candidate beyond serves better."""
        chosen = {"specular": "one_value", "roughness": "one_value"}
        present = self._try(chosen)
        for part in chosen:
            missed = 0
            for candidate in [name for name in self.candidates[part][1:] if name in self.pools]:
                trial = self._try(chosen | {part: candidate})
                better = serves(present.errors, trial.errors)
                self.report(describe(part, candidate, trial, present, better))
                if better:
                    chosen, present, missed = chosen | {part: candidate}, trial, 0
                else:
                    missed += 1
                if missed == LOOK_AHEAD:
                    break
        specular, roughness = chosen["specular"], chosen["roughness"]
        return SpecularVariation(specular, roughness, self.pools[specular], self.pools[roughness])

    def _try(self, chosen: Mapping[str, str]) -> Trial:
        begun, problem, state = time.perf_counter(), self.problem, self.state
        specular, roughness = (self.pools[chosen[part]] for part in ("specular", "roughness"))
        positions, reflection = problem.capture.points.positions, self.reflection
        if roughness is not None:
            each = np.maximum(roughness.roughness(positions), problem.table.narrowest)
            reflection = replace(self.transport, lobes=problem.lobes_of_each(each)).forward(state.light)[1]
        intensity = state.specular if specular is None else specular.specular_at(positions)
        intensity = np.broadcast_to(intensity, len(positions)).astype(np.float32)
        shown = reflection * torch.from_numpy(intensity)[None, :, None]
        albedo = best_albedo(problem.errors, self.irradiance, shown, self.weight, problem.typical_albedo(state))
        errors = problem.errors.frame_errors(albedo * self.irradiance + shown)[~problem.capture.fitted]
        return replace(self.trial, errors=errors, seconds=time.perf_counter() - begun)
