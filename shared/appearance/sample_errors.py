"""How far a model of the clip is from its samples: their noise, their weights and what they count as evidence.

Weights are robust (Cauchy, by reweighting), and clipped or crushed samples only push when the model violates what they
say (censored data). Once a model has highlights, a sample's variance is that of the radiance which the model expects,
not the sample's own: else what is brighter than expected weighs less than what is darker, and highlights of dark skin
come out too weak (quasi-likelihood [Wedderburn1974]). To a matt model highlights are outliers, and best weigh little.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch

from shared.imaging.image_sampling import Samples, is_inactive

CAUCHY = 6.0
"""Squared errors of so many times their spread get half the weight of small ones."""


def channel_first(array: np.ndarray) -> torch.Tensor:
    """array [P, F, 3] -> contiguous [3, P, F]."""
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(array, -1, 0)))


@dataclass(frozen=True, eq=False)
class SampleErrors:
    """Judges models [3, P, F], channel first, by the samples of P points in F frames.

    colours [3, P, F] linear; saturation [3, P, F] as in Samples; view_weight [1, P, F]: by how well a frame sees a
    point, 0: not at all; precision [3, P, F]: inverse variance of a sample; fitted [F] 1, or 0 for frames held out;
    light_frames: of each light, the indices of its frames; noise: see of; independent: how many of each light's
    samples count as independent evidence against the priors; reliability [3, P, F] or [1, 1, 1]: how much samples of
    several lights count against each other, 1 in full, contained in the precision; light_shares: by how much the prior
    of each light steps back for it, empty: not at all; reduced_chi_square: variance of the residuals over the assumed
    noise's.
    """

    colours: torch.Tensor
    saturation: torch.Tensor
    view_weight: torch.Tensor
    precision: torch.Tensor
    fitted: torch.Tensor
    light_frames: list[np.ndarray]
    noise: tuple[float, float]
    independent: float
    reliability: torch.Tensor = field(default_factory=lambda: torch.ones(1, 1, 1))
    light_shares: tuple[float, ...] = ()
    reduced_chi_square: float = 1.0

    @classmethod
    def of(
        cls,
        samples: Samples,
        fitted: np.ndarray,
        light_frames: list[np.ndarray],
        noise: tuple[float, float],
        independent: float,
    ) -> SampleErrors:
        """Of samples [P, F]; fitted [F] bool: the other frames are held out; noise: absolute (linear) and relative
        standard deviation of a sample."""
        colours = channel_first(samples.colours)
        sigma = noise[0] + noise[1] * colours
        return cls(
            colours=colours,
            saturation=channel_first(samples.saturation),
            view_weight=torch.from_numpy(samples.weight)[None],
            precision=1.0 / (sigma * sigma),
            fitted=torch.from_numpy(fitted.astype(np.float32)),
            light_frames=light_frames,
            noise=noise,
            independent=independent,
        )

    def take(self, index: slice | np.ndarray) -> SampleErrors:
        """Those of some of the points."""
        own = self.reliability if self.reliability.shape[1] == 1 else self.reliability[:, index]
        return replace(
            self, colours=self.colours[:, index], saturation=self.saturation[:, index],
            view_weight=self.view_weight[:, index], precision=self.precision[:, index], reliability=own,
        )

    def weights(self, model: torch.Tensor | None, glossy: bool = False) -> torch.Tensor:
        """[3, P, F] inverse variances under a model [3, P, F], glossy: as expected by one that has highlights. Robust,
        and zero where a censored sample's bound is inactive; without a model, of all samples that are not censored."""
        weight = self.view_weight * self.precision
        if model is None:
            return weight * (self.saturation == 0)
        error, inactive = self.errors(model)
        if glossy:
            absolute, relative = self.noise
            of_sample, of_model = (absolute + relative * one for one in (self.colours, model.clamp_min(0.0)))
            weight, error = (values * (of_sample / of_model).square() for values in (weight, error))
        return weight * (~inactive) / (1.0 + error / (CAUCHY * self.spread(error, inactive)))

    def errors(self, model: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Squared errors of a model [3, P, F] over the assumed noise's variance, and where a censored sample's bound
        is inactive; both [3, P, F]."""
        error = model - self.colours
        return error.square() * self.precision, is_inactive(self.saturation, error)

    def spread(self, error: torch.Tensor, inactive: torch.Tensor, frames: slice | np.ndarray = slice(None)) -> float:
        """Variance of errors [3, P, F] over the assumed noise's, by their median, in all frames or in some; inactive
        [3, P, F] bool: those that don't count. error [3, P, F]."""
        used = ((self.view_weight > 0) & ~inactive)[..., frames]
        return max(float(error[..., frames][used].median()), 0.05) / 0.4549

    def loss(self, model: torch.Tensor, spread: float | None = None) -> tuple[float, float]:
        """Mean Cauchy loss of the fitted samples under a model [3, P, F], of errors of this spread (None: their own),
        and that spread.

        What the steps lower: unlike a mean square it does not rise when many samples fit better and a few worse.
        """
        error, inactive = self.errors(model)
        spread = self.spread(error, inactive) if spread is None else spread
        weight = self.view_weight * self.fitted
        loss = torch.log1p(error * (~inactive) / (CAUCHY * spread))
        return float((weight * loss).sum() / (3.0 * weight.sum())), spread

    def evidence(self, weight: torch.Tensor) -> float:
        """The factor on the data term, samples of weight [3, P, F], by which each light's samples count as independent
        ones of the variance found."""
        count = float((weight * self.fitted > 0).sum()) / 3.0
        return len(self.light_frames) * self.independent / (max(count, 1.0) * self.reduced_chi_square)

    def with_reduced_chi_square(self, model: torch.Tensor, weight: torch.Tensor) -> SampleErrors:
        """The same with the variance of the residuals of model [3, P, F] over the assumed noise's, at least 1, samples
        of weight [3, P, F]: where the model cannot follow the clip, the samples say that much less against the priors.
        """
        used = weight * self.fitted
        squared = float((used * (model - self.colours).square()).sum()) / max(float((used > 0).sum()), 1.0)
        return replace(self, reduced_chi_square=max(1.0, squared))

    def with_reliability(self, reliability: torch.Tensor) -> SampleErrors:
        """The same, samples of several lights counting by reliability [3, P, F] in place of the one before; the prior
        of a light steps back as its samples do."""
        used = self.view_weight.expand_as(reliability)
        shares = tuple(float((used * reliability)[..., own].sum() / used[..., own].sum()) for own in self.light_frames)
        precision = self.precision * (reliability / self.reliability)
        return replace(self, precision=precision, reliability=reliability, light_shares=shares)

    def residuals(self, model: torch.Tensor) -> tuple[float, float]:
        """Root mean square residual of model [3, P, F] (linear, by view weight, censored) on fitted and on held-out
        frames, of the mean over the lights."""
        squared = (model - self.colours).square() * (~self.errors(model)[1])
        result = []
        for chosen in (self.fitted, 1.0 - self.fitted):
            weight = self.view_weight * chosen
            means = [(weight * squared)[..., own].sum() / (3.0 * weight[..., own].sum()).clamp_min(1e-9)
                     for own in self.light_frames]
            result.append(float((sum(means) / len(means)).sqrt()))
        return result[0], result[1]

    def frame_errors(self, model: torch.Tensor) -> np.ndarray:
        """[F] mean absolute residual of model [3, P, F] in each frame, weighted and censored likewise: unlike a mean
        square not ruled by the few samples that a wrong shape or a shadow's edge spoils."""
        error = (model - self.colours).abs() * (~self.errors(model)[1])
        total = (3.0 * self.view_weight.sum((0, 1))).clamp_min(1e-9)
        return ((self.view_weight * error).sum((0, 1)) / total).double().numpy()
