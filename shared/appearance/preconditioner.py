"""An approximate inverse of the light step's Gauss-Newton Hessian, from some of the points.

Conjugate gradients multiply with the whole clip in every iteration, and need as many as the Hessian has scales: texels
that all points see beside texels behind the head, of which the priors alone say something. The Hessian of some hundred
points, formed as a matrix and factorised, has nearly the same scales:

    H ~ L sum_p [ sum_f w r r' - u u' / sum_f w E^2 ] L + prior,     u = sum_f w E r,

for each channel, with r the row of a sample (its derivative by the texels' radiance), w its weight, u what the albedo
of its point absorbs and L the derivative of the texels by their logarithm. What couples the channels (strength and
width of highlights, the priors on skin and on grey light) is left to the iterations: eight where there were sixty.

References: [Golub1973] (the projection); [Saad2003], section 9.2.1 (preconditioned conjugate gradients).
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse as sparse
import torch

from shared.appearance.transport import Transport
from shared.compute.threads import share_out

POINTS, FRAMES = 128, 24
"""Twice as many points save one iteration of eight, half of them cost three; half of the frames cost three as well."""
MOST_TEXELS = 3072
"""Of two lights, or a cubemap of 22: beyond, forming and factorising take longer than the iterations that they save."""
_POINTS_AT_A_TIME = 32


class LightPreconditioner:
    """Solves with the Hessian of some of the points. curvature [3, K, K]: of their samples, by the radiance of the
    light's K texels; light [K, 3]: that radiance; prior: the light's priors, a sparse [K, K] for each channel."""

    def __init__(self, curvature: np.ndarray, light: np.ndarray, prior: list[sparse.csr_matrix]):
        self._factors: list = [None] * len(curvature)

        def factorise(c: int) -> None:
            radiance = light[:, c]
            matrix = radiance[:, None] * curvature[c] * radiance + prior[c].toarray()
            self._factors[c] = scipy.linalg.cho_factor(matrix, overwrite_a=True, check_finite=False)

        share_out(len(curvature), factorise)

    def __call__(self, change: np.ndarray) -> np.ndarray:
        """[K, 3] -> [K, 3]."""
        solved = [scipy.linalg.cho_solve(own, change[:, c], check_finite=False) for c, own in enumerate(self._factors)]
        return np.stack(solved, axis=1)


def curvature_of_some(
    transport: Transport,
    albedo: torch.Tensor,
    specular: float,
    irradiance: torch.Tensor,
    weight: torch.Tensor,
    count: int = POINTS,
) -> np.ndarray:
    """[3, K, K]: the second derivatives of half the weighted squared errors by the texels' radiance, albedo projected
    out, as count points that are spread over all have them, scaled to all.

    albedo [3, P, 1], specular intensity, irradiance [3, P, F]: what the transport is linearised at; weight [3, P, F] of
    the samples.
    """
    points = np.unique(np.linspace(0, irradiance.shape[1] - 1, count).astype(int))
    chosen = torch.from_numpy(points)
    counted = np.nonzero(weight.sum((0, 1)).numpy() > 0)[0]
    frames = counted[np.unique(np.linspace(0, len(counted) - 1, FRAMES).astype(int))]
    part, lit = (values[:, chosen][..., frames].numpy() for values in (weight, irradiance))
    part = part * np.float32(float(weight.sum()) / float(part.sum()))

    def of_half(k: int) -> np.ndarray:
        c, half, total = k // 2, k % 2, np.float32(0.0)
        for first in range(half * _POINTS_AT_A_TIME, len(points), 2 * _POINTS_AT_A_TIME):
            own = slice(first, first + _POINTS_AT_A_TIME)
            rows = np.stack([transport.rows(f, points[own], albedo, specular, c) for f in frames])
            w, e = part[c, own].T[..., None], lit[c, own].T[..., None]
            absorbed = (w * e * rows).sum(0) / np.maximum((w * e * e).sum(0), 1e-6)
            rows = (np.sqrt(w) * (rows - e * absorbed)).reshape(-1, rows.shape[2])
            total = total + rows.T @ rows
        return total

    halves = share_out(6, of_half)  # three channels alone leave one of two threads idle for a quarter of the time
    return np.stack([halves[2 * c] + halves[2 * c + 1] for c in range(3)])
