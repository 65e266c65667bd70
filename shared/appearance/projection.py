"""The unknowns that are projected out of a step of the light: albedo, and beside it specular intensity and roughness.

Albedo is a weighted least-squares solution per point and channel. With the roughness linearised highlights are
x0 S + x1 (s S'), with S the reflection at intensity 1 and S' its derivative by the logarithm of the roughness at the
present roughness, s the present intensity, x0 the new one and x1 the change of the log roughness: linear in both, each
of which has a normal prior. What the model cannot follow (another lobe than GGX, a light not quite so, hair) is alike
all over a patch of skin and not noise; how much more the patches disagree than samples would is the design effect, by
which the samples count less against the priors.

References: [Golub1973] and [Kaufman1975] (variable projection); [Liang1986] (covariance from the clusters' own sums);
[Kish1965] (design effect).
"""

from __future__ import annotations

from copy import copy

import numpy as np
import torch
from scipy.linalg import eigh

from shared.appearance.albedo_scale import Highlights
from shared.appearance.problem import AppearanceSettings, AppearanceState
from shared.appearance.sample_errors import SampleErrors

MINIMUM_ALBEDO, MAXIMUM_ALBEDO = 0.003, 1.0
ALBEDO_PULL = 25.0
"""Precision of the prior on a point's albedo: a standard deviation of 0.2."""
SPECULAR_RANGE = (0.0, 2.0)
"""Of the specular intensity: at the upper end the reflectance at normal incidence is 0.08, twice skin's."""
ROUGHNESS_RANGE, ROUGHNESS_SPREAD = (0.1, 0.7), 0.15
"""Of skin; the spread is the standard deviation of the prior on its logarithm, about where the fit starts: two of them
reach from 0.33 to 0.61, oily to powdered skin as renderers have it."""
NEAR_END = 0.01
"""Share of its range within which a parameter counts as at the end of it."""
LARGEST_ROUGHNESS_STEP = 0.08
"""Of a step, in the logarithm: lobes are linearised, and their peak goes with the inverse fourth power."""


def best_albedo(
    errors: SampleErrors,
    irradiance: torch.Tensor,
    highlights: torch.Tensor,
    weight: torch.Tensor,
    typical: torch.Tensor,
) -> torch.Tensor:
    """Albedo [3, P, 1] that fits best under irradiance beside highlights, samples of weight (all [3, P, F]), from the
    fitted frames.

    A weak pull to the skin's typical albedo [3, 1, 1] decides where no sample says anything.
    """
    weight = weight * errors.fitted
    moment = (weight * irradiance * (errors.colours - highlights)).sum(2, keepdim=True)
    curvature = (weight * irradiance * irradiance).sum(2, keepdim=True)
    albedo = (moment + ALBEDO_PULL * typical) / (curvature + ALBEDO_PULL)
    return albedo.clamp(MINIMUM_ALBEDO, MAXIMUM_ALBEDO)


def project_off_albedo(values: torch.Tensor, irradiance: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """values [3, P, F] minus the part along irradiance [3, P, F] that a change of albedo would absorb; weight
    [3, P, F] of the samples.

    Exactly orthogonal, without the pull on the albedo: highlights are some percent of the diffuse radiance, and
    the least remainder of that would pass for them.
    """
    along = (weight * irradiance * values).sum(2, keepdim=True)
    return values - irradiance * along / (weight * irradiance * irradiance).sum(2, keepdim=True).clamp_min(1e-6)


def measure_highlights(
    errors: SampleErrors,
    irradiance: torch.Tensor,
    reflection: torch.Tensor,
    weight: torch.Tensor,
    design_effect: float = 1.0,
) -> Highlights:
    """What the samples say about the specular intensity, per channel, with albedo projected out, under irradiance and
    reflection, samples of weight, all [3, P, F]; design_effect: by which they count less, see SpecularFit."""
    weight = weight * errors.fitted
    pure = project_off_albedo(reflection, irradiance, weight)
    moment = (weight * pure * errors.colours).sum((1, 2))
    curvature = (weight * pure * reflection).sum((1, 2))
    share = (weight * errors.colours).sum((1, 2)) / (weight * reflection).sum((1, 2))
    intensity = (moment / curvature.clamp_min(1e-12)).double().numpy()
    precision = curvature.double().numpy() * errors.evidence(weight) / design_effect
    return Highlights(intensity, precision, share.double().numpy())


def changed_roughness(roughness: float, change: float) -> float:
    """The roughness after a change of its logarithm, at most by what lobes may be linearised over and within its range.
    """
    change = np.clip(change, -LARGEST_ROUGHNESS_STEP, LARGEST_ROUGHNESS_STEP)
    return float(np.clip(roughness * np.exp(change), *ROUGHNESS_RANGE))


class SpecularFit:
    """Specular intensity and roughness as samples and priors together have them, under irradiance and reflection, and
    slope, S', all [3, P, F], the last None where the roughness is not sought; state: whose intensity and roughness are
    linearised about; weight [3, P, F] of the samples, evidence: see SampleErrors; design_effect: by which the
    priors count more.

    best: the intensity and, where it is sought, the change of the log roughness; unlikely: what the priors say against
    them, so counted; highlights [3, P, F]: theirs.
    """

    def __init__(
        self,
        settings: AppearanceSettings,
        state: AppearanceState,
        errors: SampleErrors,
        irradiance: torch.Tensor,
        reflection: torch.Tensor,
        slope: torch.Tensor | None,
        weight: torch.Tensor,
        evidence: float,
        design_effect: float = 1.0,
    ):
        self._weight, self._evidence = weight, evidence
        self._shown = [reflection] if slope is None else [reflection, state.specular * slope]
        self._mean, self._precision = (values[: len(self._shown)] for values in _prior(settings, state))
        self._pure = [project_off_albedo(one, irradiance, weight) for one in self._shown]
        self._curvature = evidence * np.array([self._moments(one) for one in self._shown])
        self._moment = evidence * self._moments(errors.colours)
        self._solve(design_effect)

    def _solve(self, design_effect: float) -> None:
        self.design_effect = design_effect
        precision, mean = self._precision * design_effect, self._mean
        self._known = self._curvature + np.diag(precision)
        self.best = np.linalg.solve(self._known, self._moment + precision * mean)
        self.unlikely = 0.5 * float((precision * np.square(self.best - mean)).sum())
        self.highlights = sum(float(x) * one for x, one in zip(self.best, self._shown, strict=True))

    def weighed_by_patches(self, errors: SampleErrors, irradiance: torch.Tensor, patches: np.ndarray) -> SpecularFit:
        """The same with the design effect of patches of skin, patches [P] int; errors and irradiance [3, P, F]: those
        that it was fitted with."""
        fit = copy(self)
        fit._solve(self._design_effect_of(errors, irradiance, patches))
        return fit

    def _design_effect_of(self, errors: SampleErrors, irradiance: torch.Tensor, patches: np.ndarray) -> float:
        """By what factor the patches' pulls at intensity and roughness vary more than independent samples' would, at
        least 1: of that combination of both in which they do most."""
        left = project_off_albedo(errors.colours - self.highlights, irradiance, self._weight)
        pulls = self._evidence * np.stack([(self._weight * pure * left).sum((0, 2)).numpy() for pure in self._pure], 1)
        of_patches = np.stack([np.bincount(patches, own) for own in pulls.T], 1)
        of_patches -= of_patches.mean(0)
        return max(1.0, float(eigh(of_patches.T @ of_patches, self._known, eigvals_only=True)[-1]))

    def _moments(self, values: torch.Tensor) -> np.ndarray:
        return np.array([float((self._weight * pure * values).sum()) for pure in self._pure])

    def project_off(self, values: torch.Tensor) -> torch.Tensor:
        """values [3, P, F], free of albedo, minus what a change of intensity and roughness would absorb."""
        along = np.linalg.solve(self._known / self._evidence, self._moments(values))
        return values - sum(float(x) * pure for x, pure in zip(along, self._pure, strict=True))

    @property
    def intensity(self) -> float:
        """Within its range."""
        return float(np.clip(self.best[0], *SPECULAR_RANGE))

    @property
    def change_of_roughness(self) -> float:
        """Of its logarithm; 0 where it is not sought."""
        return float(self.best[1]) if len(self.best) > 1 else 0.0


def _prior(settings: AppearanceSettings, state: AppearanceState) -> tuple[np.ndarray, np.ndarray]:
    """Mean and precision, each [2], of the specular intensity and of the change of the log roughness."""
    mean, sigma = settings.specular_prior
    back = np.log(settings.roughness / state.roughness)
    return np.array([mean, back]), np.array([(mean * sigma) ** -2, ROUGHNESS_SPREAD**-2])


def reached_end(value: float, allowed: tuple[float, float]) -> str:
    """"lower" or "upper" where a value lies within NEAR_END of that end of its allowed range, else ""."""
    share = (value - allowed[0]) / (allowed[1] - allowed[0])
    if share < NEAR_END:
        return "lower"
    return "upper" if share > 1.0 - NEAR_END else ""
