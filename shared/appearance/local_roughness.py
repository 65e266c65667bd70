"""Roughness that varies over the skin, where highlights passed and held-out frames fit better for it.

For a few roughnesses around the clip's one, each point's samples give the curvature and the moment of its specular
intensity with its albedo projected out. Summed over a neighbourhood they give a cost per roughness, intensity
eliminated under its prior, and the parabola through the three lowest values gives the neighbourhood's roughness. Where
no highlight passed the prior wins: the clip's roughness. Neighbourhoods and not face segments, since segments would
leave their borders in the map.

The light was solved for one roughness and has taken up part of what another one would explain, so that all
neighbourhoods lean to the same side: only their differences count, the mean stays the clip's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from shared.appearance.problem import AppearanceProblem, AppearanceState
from shared.appearance.projection import ROUGHNESS_RANGE, best_albedo, project_off_albedo
from shared.appearance.sample_errors import SampleErrors
from shared.appearance.transport import Lobes, Transport

FACTOR, STEPS = 1.18, 2
"""Ratio of neighbouring roughnesses that are tried, and how many to each side."""
WIDTH_MM, REACH = 8.0, 3.0
"""Standard deviation of a neighbourhood, and where it ends in units of that."""
SPREAD = 0.2
"""Standard deviation of the logarithm of a neighbourhood's roughness about the clip's."""
WORTHWHILE = 0.002
"""Held-out residual must fall by this share: below is what chance gives."""


@dataclass(frozen=True)
class SpecularEquations:
    """Evidence on the specular terms of P points at R roughnesses: curvature and moment [R, P] of the specular
    intensity.

    positions [P, 3] mm; logs [R]: log roughness, the clip's in the middle; specular: mean and precision of the
    intensity; shift: what log roughness is off by in the mean, to be taken away.
    """

    positions: np.ndarray
    logs: np.ndarray
    curvature: np.ndarray
    moment: np.ndarray
    specular: tuple[float, float]
    shift: float = 0.0

    def roughness(self, positions: np.ndarray) -> np.ndarray:
        """[N] around positions [N, 3] mm; the clip's where no point is near."""
        offset, informed = self._offsets(*self._pooled(positions))
        return np.exp(np.clip(self.logs[STEPS] + offset - informed * self.shift, *np.log(ROUGHNESS_RANGE)))

    def specular_at(self, positions: np.ndarray) -> np.ndarray:
        """Specular intensity [N] around positions under the clip's roughness."""
        curvature, moment = self._pooled(positions)
        return (moment / curvature)[:, STEPS]

    def centred(self) -> SpecularEquations:
        """The same with the shift that keeps the points' mean."""
        offset, informed = self._offsets(*self._pooled(self.positions))
        return replace(self, shift=float(offset.sum() / max(informed.sum(), 1e-12)))

    def _pooled(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Curvature and moment [N, R] of neighbourhoods, with the intensity's prior."""
        near = cKDTree(positions).sparse_distance_matrix(
            cKDTree(self.positions), REACH * WIDTH_MM, output_type="coo_matrix"
        )
        near.data = np.exp(-0.5 * np.square(near.data / WIDTH_MM))
        mean, precision = self.specular
        return near @ self.curvature.T + precision, near @ self.moment.T + precision * mean

    def _offsets(self, curvature: np.ndarray, moment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[N] log roughness relative to the clip's, and the share of the cost's bend that is not the prior's."""
        relative = self.logs - self.logs[STEPS]
        cost = -0.5 * moment**2 / curvature + 0.5 * np.square(relative / SPREAD)
        rows, least = np.arange(len(cost)), np.clip(cost.argmin(1), 1, len(relative) - 2)
        below, lowest, above = (cost[rows, least + step] for step in (-1, 0, 1))
        bend = np.maximum(below - 2.0 * lowest + above, 1e-12)
        step = np.log(FACTOR)
        offset = relative[least] + np.clip(0.5 * (below - above) / bend, -1.0, 1.0) * step
        return offset, np.clip(1.0 - np.square(step / SPREAD) / bend, 0.0, 1.0)


def local_roughness(
    problem: AppearanceProblem, state: AppearanceState
) -> tuple[SpecularEquations | None, dict]:
    """What the samples say of the roughness around each point under a solved state, and a record; None instead where
    one value serves as well."""
    transport = problem.transport(state)
    irradiance, reflection = transport.forward(state.light)
    model = state.radiance(irradiance, reflection)
    weight = problem.errors.weights(model, glossy=True)
    errors = problem.errors.with_reduced_chi_square(model, weight)
    transport = replace(transport, lobes=None)
    equations = specular_equations_of(problem, state, transport, errors, irradiance, weight * errors.fitted)
    specular = torch.from_numpy(equations.specular_at(equations.positions).astype(np.float32))[None, :, None]
    local = np.maximum(equations.roughness(equations.positions), problem.table.narrowest)
    residuals = {}
    for name, tried in (("one", state.roughness), ("local", local)):
        shown = reflection_by(transport, problem.lobes_of_each(tried), state.light) * specular
        albedo = best_albedo(errors, irradiance, shown, weight, problem.typical_albedo(state))
        held_out = weight * (1.0 - errors.fitted)
        squared = held_out * (albedo * irradiance + shown - errors.colours).square()
        residuals[name] = float((squared.sum() / held_out.sum().clamp_min(1e-9)).sqrt())
    kept = residuals["local"] < (1.0 - WORTHWHILE) * residuals["one"]
    low, high = np.percentile(local, [5, 95])
    record = {
        "held_out": {name: round(value, 6) for name, value in residuals.items()},
        "chosen": "local" if kept else "one",
        "found_range": [round(float(low), 4), round(float(high), 4)],
    }
    return (equations if kept else None), record


def reflection_by(transport: Transport, lobes: Lobes, light: np.ndarray) -> torch.Tensor:
    """Reflection [3, P, F] of a light [K, 3] by these lobes. A table of them is the greatest thing in memory: here one
    is gone before the next is made."""
    return replace(transport, lobes=lobes).forward(light)[1]


def specular_equations_of(
    problem: AppearanceProblem,
    state: AppearanceState,
    transport: Transport,
    errors: SampleErrors,
    irradiance: torch.Tensor,
    weight: torch.Tensor,
) -> SpecularEquations:
    """The equations under a state's light, albedo projected out; transport: the state's; irradiance [3, P, F]: the
    light's; errors, weight [3, P, F]: of the samples that take part."""
    mean, spread = problem.settings.specular_prior
    logs = np.log(state.roughness) + np.log(FACTOR) * np.arange(-STEPS, STEPS + 1)
    evidence, sums = errors.evidence(weight), []
    for log in logs:
        reflection = reflection_by(transport, problem.lobes_at(float(np.exp(log))), state.light)
        pure = project_off_albedo(reflection, irradiance, weight)
        sums.append([(weight * pure * seen).sum((0, 2)).double().numpy() for seen in (reflection, errors.colours)])
    curvature, moment = evidence * np.moveaxis(np.array(sums), 1, 0)
    positions = np.asarray(problem.capture.points.positions, np.float64)
    precision = (mean * spread) ** -2
    return SpecularEquations(positions, logs, curvature, moment, (state.specular, precision)).centred()
