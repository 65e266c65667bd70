"""Vertices as the reference solver moves them: preconditioned steps, kept smooth by the Laplacian.

Reference: [Nicolet2021] (u = (I + lambda L) x).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
import torch

from shared.compute.sparse_solve import factorised
from shared.geometry.mesh import graph_laplacian, uniform_laplacian
from shared.published.light import SparseOperator

UNIT_MM = 100.0
"""Lengths in the Laplacian's loss are in these units, so that a head is of order one, as the published weight expects.
"""


class LargeSteps:
    """x = (I + smoothing L)^-1 u with the graph's Laplacian L of a mesh of V vertices."""

    def __init__(self, faces: np.ndarray, count: int, smoothing: float):
        self._matrix = (sparse.identity(count) + smoothing * graph_laplacian(faces, count)).tocsc()
        self._solve = factorised(self._matrix).solve

    def parameters(self, vertices: np.ndarray) -> np.ndarray:
        """[V, 3] -> u [V, 3]."""
        return self._matrix @ vertices

    def vertices(self, parameters: torch.Tensor) -> torch.Tensor:
        """u [V, 3] -> [V, 3]; differentiable."""
        return _Solved.apply(parameters, self._solve)


class _Solved(torch.autograd.Function):
    """The symmetric solve, its own transpose; on the CPU in double precision."""

    @staticmethod
    def forward(ctx, parameters, solve):
        ctx.solve = solve
        return _on_cpu(solve, parameters)

    @staticmethod
    def backward(ctx, gradient):
        return _on_cpu(ctx.solve, gradient), None


def _on_cpu(solve, values: torch.Tensor) -> torch.Tensor:
    solved = solve(values.detach().double().numpy())
    return torch.from_numpy(solved).to(values.dtype)


class LaplacianLoss:
    """Mean squared distance of vertices from the mean of their neighbours, in UNIT_MM."""

    def __init__(self, faces: np.ndarray, count: int):
        self._operator = SparseOperator(uniform_laplacian(faces, count))

    def __call__(self, vertices: torch.Tensor) -> torch.Tensor:
        return (self._operator(vertices) / UNIT_MM).square().sum(1).mean()
