"""How far a model of the clip is from its samples: their noise, trust, robust weights and what they count as evidence.

Weights are robust (Cauchy, by reweighting), and clipped or crushed samples only push when the model violates what they
say (censored data).
"""

from __future__ import annotations

import numpy as np
import torch

from shared.imaging.image_sampling import Samples, is_inactive

CAUCHY = 6.0
"""Squared errors of so many times their spread get half the weight of small ones."""


def channel_first(array: np.ndarray) -> torch.Tensor:
    """[P, F, 3] -> contiguous [3, P, F]."""
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(array, -1, 0)))


class SampleErrors:
    """Judges models [3, P, F], channel first, by the samples of P points in F frames.

    fitted [F] bool: the other frames are held out; light_frames: of each light, the indices of its frames; noise:
    absolute and relative standard deviation of a sample; independent: how many of each light's samples count as
    independent evidence against the priors.
    """

    def __init__(
        self,
        samples: Samples,
        fitted: np.ndarray,
        light_frames: list[np.ndarray],
        noise: tuple[float, float],
        independent: float,
    ):
        self.colours = channel_first(samples.colours)
        self.saturation = channel_first(samples.saturation)
        self.trust = torch.from_numpy(samples.weight)[None]
        sigma = noise[0] + noise[1] * self.colours
        self.precision = 1.0 / (sigma * sigma)
        self.fitted = torch.from_numpy(fitted.astype(np.float32))
        self.light_frames, self.independent = light_frames, independent
        self.reliability, self.reduced_chi_square = torch.ones(1, 1, 1), 1.0

    def weights(self, model: torch.Tensor | None) -> torch.Tensor:
        """[3, P, F] inverse variances: trust, robust loss, and zero where a censored sample 's bound is inactive."""
        weight = self.trust * self.precision
        if model is None:
            return weight * (self.saturation == 0)
        error, inactive = self.errors(model)
        return weight * (~inactive) / (1.0 + error / (CAUCHY * self.spread(error, inactive)))

    def errors(self, model: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Squared errors over the assumed noise's variance, and where a censored sample 's bound is inactive; [3, P,
        F]."""
        error = model - self.colours
        return error.square() * self.precision, is_inactive(self.saturation, error)

    def spread(self, error: torch.Tensor, inactive: torch.Tensor, frames: slice | np.ndarray = slice(None)) -> float:
        """Variance of the errors over the assumed noise's, by their median, in all frames or in some."""
        used = ((self.trust > 0) & ~inactive)[..., frames]
        return max(float(error[..., frames][used].median()), 0.05) / 0.4549

    def weigh(self, reliability: torch.Tensor) -> None:
        """How much samples of several lights count against each other, [3, P, F]: 1 in full."""
        self.precision = self.precision * (reliability / self.reliability)
        self.reliability = reliability

    def loss(self, model: torch.Tensor, spread: float | None = None) -> tuple[float, float]:
        """Mean Cauchy loss of the fitted samples, of errors of this spread (None: their own), and that spread.

        What the steps lower: unlike a mean square it does not rise when many samples fit better and a few worse.
        """
        error, inactive = self.errors(model)
        spread = self.spread(error, inactive) if spread is None else spread
        weight = self.trust * self.fitted
        loss = torch.log1p(error * (~inactive) / (CAUCHY * spread))
        return float((weight * loss).sum() / (3.0 * weight.sum())), spread

    def evidence(self, weight: torch.Tensor) -> float:
        """Scales the data term so that each light's samples count as independent ones of the variance found."""
        count = float((weight * self.fitted > 0).sum()) / 3.0
        return len(self.light_frames) * self.independent / (max(count, 1.0) * self.reduced_chi_square)

    def measure_reduced_chi_square(self, model: torch.Tensor, weight: torch.Tensor) -> None:
        """Variance of the residuals over the assumed noise's, at least 1: where the model cannot follow the clip, the
        samples say that much less against the priors."""
        used = weight * self.fitted
        squared = float((used * (model - self.colours).square()).sum()) / max(float((used > 0).sum()), 1.0)
        self.reduced_chi_square = max(1.0, squared)

    def residuals(self, model: torch.Tensor) -> tuple[float, float]:
        """Root mean square residual (linear, trust-weighted, censored) on fitted and on held-out frames, of the mean
        over the lights."""
        squared = (model - self.colours).square() * (~self.errors(model)[1])
        result = []
        for chosen in (self.fitted, 1.0 - self.fitted):
            weight = self.trust * chosen
            means = [(weight * squared)[..., own].sum() / (3.0 * weight[..., own].sum()).clamp_min(1e-9)
                     for own in self.light_frames]
            result.append(float((sum(means) / len(means)).sqrt()))
        return result[0], result[1]

    def frame_errors(self, model: torch.Tensor) -> np.ndarray:
        """[F] mean absolute residual of each frame, weighted and censored likewise: unlike a mean square not ruled by
        the few samples that a wrong shape or a shadow's edge spoils."""
        error = (model - self.colours).abs() * (~self.errors(model)[1])
        total = (3.0 * self.trust.sum((0, 1))).clamp_min(1e-9)
        return ((self.trust * error).sum((0, 1)) / total).double().numpy()
