"""How much the samples of several lights count against each other, point by point.

Where a light grazes the skin, or hardly reaches it, small errors of normals and bounces are large errors of the
irradiance, the same in all its frames; another light, that does better there, should decide the albedo. So it should
where a cast shadow ends, since the mesh says only about where that is. And where the model follows one light worse than
another (a lamp smaller than a texel of the light), its samples count less everywhere. The light's prior steps back as
its samples do: how well a light is solved depends on its own samples.
"""

from __future__ import annotations

import numpy as np
import torch

from shared.appearance.observations import Capture
from shared.appearance.problem import AppearanceState
from shared.appearance.sample_errors import SampleErrors
from shared.appearance.texture import CORRELATED_FRAMES, IRRADIANCE_ERROR, NORMAL_ERROR
from shared.rendering.irradiance_errors import SHADOW_MM, irradiance_slope, shadow_uncertainty

LEAST_WEIGHT = 0.01
"""Of a sample, against those of the light that knows its point best."""


def weigh_samples(
    capture: Capture,
    state: AppearanceState,
    errors: SampleErrors,
    light_along: torch.Tensor,
    irradiance: torch.Tensor,
    model: torch.Tensor,
) -> tuple[SampleErrors, tuple[float, ...]]:
    """The samples' errors, weighed under a state: light_along [J, F, 3], irradiance and model [3, P, F] are its own.
    And the weight of each light, 1 of the one that the model follows best."""
    error, inactive = errors.errors(model)
    error = error / errors.reliability
    spread = [errors.spread(error, inactive, own) for own in errors.light_frames]
    weights = tuple(max(min(spread) / value, LEAST_WEIGHT) for value in spread)
    albedo = torch.from_numpy(np.ascontiguousarray(state.albedo.T, np.float32))
    plain = errors.precision / errors.reliability
    uncertainty = _shadow_uncertainty(capture, light_along)
    steady = 1.0 / (1.0 + plain * (albedo[..., None] * uncertainty).square())
    base = errors.view_weight * plain * steady * ~inactive
    shares = []
    for own, follows in zip(errors.light_frames, weights, strict=True):
        lit = irradiance[..., own]
        mean = lit.mean(2).clamp_min(1e-6)
        slope = irradiance_slope(capture.transfer, capture.points.normals, light_along[:, own].mean(1).numpy(),
                                 capture.directions)
        turned = NORMAL_ERROR * torch.from_numpy(slope.T) / mean
        shared = (IRRADIANCE_ERROR * mean.median(1, keepdim=True).values / mean).square() + turned.square()
        power = (base[..., own] * lit.square()).sum(2)
        shared += (base[..., own] * uncertainty[..., own].square()).sum(2) / power.clamp_min(1e-9)
        precision = power * albedo.square() / CORRELATED_FRAMES
        shares.append(follows / (1.0 + precision * shared))
    shares = torch.stack(shares)
    shares = (shares / shares.max(0).values).clamp_min(LEAST_WEIGHT)
    by_frame = torch.empty_like(irradiance)
    for own, share in zip(errors.light_frames, shares, strict=True):
        by_frame[..., own] = share[..., None] * steady[..., own]
    return errors.with_reliability(by_frame), weights


def _shadow_uncertainty(capture: Capture, along: torch.Tensor) -> torch.Tensor:
    """[3, P, F] standard deviation of the irradiance over pi by the borders of shadows; along [J, F, 3]: the light."""
    lights = along.reshape(len(along), -1).numpy()
    uncertainty = shadow_uncertainty(capture.points, capture.transfer, lights, capture.directions, SHADOW_MM)
    return torch.from_numpy(uncertainty).reshape(len(uncertainty), -1, 3).permute(2, 0, 1)
