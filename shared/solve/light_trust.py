"""How much the samples of several lights count against each other, point by point.

Where a light grazes the skin, or hardly reaches it, small errors of normals and bounces are large errors of the
irradiance, the same in all its frames; another light, that does better there, should decide the albedo. And where the
model follows one light worse than another (a lamp smaller than a texel of the light), its samples count less
everywhere. The light's prior steps back as its samples do: how well a light is solved depends on its own samples.
"""

from __future__ import annotations

import numpy as np
import torch

from shared.shading import irradiance_slope
from shared.solve.appearance import AppearanceSolver
from shared.solve.texture import CORRELATED_FRAMES, IRRADIANCE_ERROR, NORMAL_ERROR

LEAST_TRUST = 0.01
"""Of a sample, against those of the light that knows its point best."""


def weigh_samples(solver: AppearanceSolver, irradiance: torch.Tensor, model: torch.Tensor) -> list[float]:
    """Weighs the solver's samples under its present state; irradiance, model [3, P, F] -> trust in each light, 1 in the
    one that the model follows best."""
    error, silent = solver.errors(model)
    error = error / solver.reliability
    spread = [solver.spread(error, silent, own) for own in solver.light_frames]
    trust = [max(min(spread) / value, LEAST_TRUST) for value in spread]
    along = torch.from_numpy(solver.frame_light.along(solver.state.light))
    albedo = torch.from_numpy(np.ascontiguousarray(solver.state.albedo.T, np.float32))
    base = solver.trust * solver.precision / solver.reliability * ~silent
    shares = []
    for own, follows in zip(solver.light_frames, trust, strict=True):
        lit = irradiance[..., own]
        mean = lit.mean(2).clamp_min(1e-6)
        slope = irradiance_slope(solver.capture.transfer, solver.capture.points.normals, along[:, own].mean(1).numpy(),
                                 solver.capture.directions)
        turned = NORMAL_ERROR * torch.from_numpy(slope.T) / mean
        shared = (IRRADIANCE_ERROR * mean.median(1, keepdim=True).values / mean).square() + turned.square()
        precision = (base[..., own] * lit.square()).sum(2) * albedo.square() / CORRELATED_FRAMES
        shares.append(follows / (1.0 + precision * shared))
    shares = torch.stack(shares)
    shares = (shares / shares.max(0).values).clamp_min(LEAST_TRUST)
    by_frame = torch.empty_like(irradiance)
    for own, share in zip(solver.light_frames, shares, strict=True):
        by_frame[..., own] = share[..., None]
    solver.weigh(by_frame)
    return trust
