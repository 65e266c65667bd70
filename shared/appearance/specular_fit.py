"""Specular intensity and roughness as samples and priors together have them, under some light, albedo projected out.

With the roughness linearised both are linear: highlights are x0 S + x1 (s S'), with S the reflection at intensity 1 and
S' its derivative by the logarithm of the roughness at the present roughness, s the present intensity, x0 the new one
and x1 the change of the log roughness. Each has a normal prior.
"""

from __future__ import annotations

import numpy as np
import torch

from shared.appearance.solver import ROUGHNESS_SPREAD, AppearanceSettings, AppearanceSolver, AppearanceState


class SpecularFit:
    """Under irradiance and reflection [3, P, F], and slope, S', None where the roughness is not sought; weight
    [3, P, F] of the samples, evidence: see SampleErrors."""

    def __init__(
        self,
        solver: AppearanceSolver,
        irradiance: torch.Tensor,
        reflection: torch.Tensor,
        slope: torch.Tensor | None,
        weight: torch.Tensor,
        evidence: float,
    ):
        self._weight, self._evidence = weight, evidence
        shown = [reflection] if slope is None else [reflection, solver.state.specular * slope]
        mean, precision = (values[: len(shown)] for values in _prior(solver.settings, solver.state))
        self._pure = [solver.project_off_albedo(one, irradiance, weight) for one in shown]
        curvature, moment = np.array([self._moments(one) for one in shown]), self._moments(solver.colours)
        self._known = evidence * curvature + np.diag(precision)
        self.best = np.linalg.solve(self._known, evidence * moment + precision * mean)
        self.unlikely = 0.5 * float((precision * np.square(self.best - mean)).sum())
        self.highlights = sum(float(x) * one for x, one in zip(self.best, shown, strict=True))

    def _moments(self, values: torch.Tensor) -> np.ndarray:
        return np.array([float((self._weight * pure * values).sum()) for pure in self._pure])

    def off(self, values: torch.Tensor) -> torch.Tensor:
        """values [3, P, F], free of albedo, minus what a change of intensity and roughness would absorb."""
        along = np.linalg.solve(self._known / self._evidence, self._moments(values))
        return values - sum(float(x) * pure for x, pure in zip(along, self._pure, strict=True))

    @property
    def change_of_roughness(self) -> float:
        """Of its logarithm; 0 where it is not sought."""
        return float(self.best[1]) if len(self.best) > 1 else 0.0


def _prior(settings: AppearanceSettings, state: AppearanceState) -> tuple[np.ndarray, np.ndarray]:
    """Mean and precision, each [2], of the specular intensity and of the change of the log roughness."""
    mean, sigma = settings.specular_prior
    back = np.log(settings.roughness / state.roughness)
    return np.array([mean, back]), np.array([(mean * sigma) ** -2, ROUGHNESS_SPREAD**-2])
