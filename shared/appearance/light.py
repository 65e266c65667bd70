"""How each frame sees the light, and the regularisers on its logarithm.

Looking the cubemap up along the head-space directions of every frame is one sparse matrix; the solver needs only
products with it and with its transpose. What is unknown of the light is the business of shared.appearance.light_models.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from shared.rendering.envmap import (
    cube_directions,
    cube_lookup,
    cube_resolution,
    cube_smoothness,
    cube_solid_angles,
    frame_lookup,
)


@dataclass(frozen=True)
class LightPriors:
    """Weights of the regularisers: smooth on the squared gradient of the log light per steradian's worth of sphere,
    white on the squared deviation of a texel's log colour from grey (mean over the sphere); edge: log step from which
    on a difference counts linearly instead of squared, so that lamps keep their edges."""

    smooth: float = 1.0
    white: float = 1.0
    edge: float = 0.5


class FrameLight:
    """A cubemap light of a resolution, seen along directions [J, 3] of head space in F frames.

    world_from_head [F, 3, 3] turns head-space directions into the space in which the light stands still; light_index
    [F]: which of several lights, one below the other, each frame stands in; None: there is one. near [n]: texels that
    reach the head in another way and do not count here, see shared.rendering.near_lamp.
    """

    def __init__(
        self,
        resolution: int,
        directions: np.ndarray,
        world_from_head: np.ndarray,
        light_index: np.ndarray | None = None,
        near: np.ndarray | None = None,
    ):
        self.resolution, self.shape = resolution, (len(directions), len(world_from_head))
        self._lookup = frame_lookup(directions, world_from_head, resolution, light_index).astype(np.float32)
        if near is not None:
            far = np.ones(self._lookup.shape[1], np.float32)
            far[near] = 0.0
            self._lookup = (self._lookup @ sparse.diags(far)).tocsr()
        self._transposed = self._lookup.T.tocsr()

    def of_frame(self, frame: int) -> sparse.csr_matrix:
        """[J, K]: the texels' radiance along each direction in a frame."""
        return self._lookup[frame :: self.shape[1]]

    def along(self, light: np.ndarray) -> np.ndarray:
        """Radiance of the texels [K, C] -> along each direction in each frame [J, F, C] float32."""
        return (self._lookup @ light.astype(np.float32)).reshape(self.shape + (light.shape[1],))

    def adjoint(self, values: np.ndarray) -> np.ndarray:
        """The transpose of along: [J, F, C] -> [K, C] float64."""
        return (self._transposed @ values.reshape(-1, values.shape[-1])).astype(np.float64)


class LogPrior:
    """Regularisers of a cubemap's log radiance: smooth with room for edges, and grey."""

    def __init__(self, resolution: int):
        self._differences = cube_smoothness(resolution)
        self._solid = cube_solid_angles(resolution) / (4.0 * np.pi)

    def __call__(self, log_light: np.ndarray, priors: LightPriors) -> tuple[float, np.ndarray, Callable]:
        """Cost, gradient [K, C] and Hessian product (a function) at log_light [K, C].

        Pseudo-Huber on neighbour differences, its weights held for the Hessian (iteratively reweighted squares).
        """
        step = self._differences @ log_light
        root = np.sqrt(1.0 + (step / priors.edge) ** 2)
        weight = priors.smooth / root
        chroma = log_light - log_light.mean(1, keepdims=True)
        white = priors.white * self._solid[:, None]

        def product(change: np.ndarray) -> np.ndarray:
            smooth = self._differences.T @ (weight * (self._differences @ change))
            return smooth + white * (change - change.mean(1, keepdims=True))

        cost = priors.smooth * priors.edge**2 * float((root - 1.0).sum()) + 0.5 * float((white * chroma**2).sum())
        return cost, self._differences.T @ (weight * step) + white * chroma, product

    def curvature(self, log_light: np.ndarray, priors: LightPriors) -> list[sparse.csr_matrix]:
        """The Hessian's blocks [K, K] of each channel by itself at log_light [K, C]."""
        step, channels = self._differences @ log_light, log_light.shape[1]
        weight = priors.smooth / np.sqrt(1.0 + (step / priors.edge) ** 2)
        white = sparse.diags(priors.white * self._solid * (1.0 - 1.0 / channels))
        return [(self._differences.T @ sparse.diags(own) @ self._differences + white).tocsr() for own in weight.T]


def resample_light(light: np.ndarray, resolution: int) -> np.ndarray:
    """The light [6 n^2, C] on a cubemap of another resolution, interpolated bilinearly as FrameLight does, so that
    surfaces receive the same: between logarithms a lamp of one texel would lose most of its light."""
    source = cube_resolution(light)
    return cube_lookup(cube_directions(resolution), source) @ light
