"""Sparse symmetric systems, solved directly, and many that are alike, from the factors of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import SuperLU, splu

_ACCURACY = 1e-8
_STEPS = 40
"""More steps than these take longer than new factors."""


@dataclass(frozen=True)
class Factors:
    """Those of a matrix in its precision. Several threads may solve by them, but none may ask SuperLU for its L or U,
    which it makes when first asked, and crashes where two threads ask at once."""

    superlu: SuperLU
    precision: np.dtype

    def solve(self, right: np.ndarray) -> np.ndarray:
        """x of matrix x = right, right [n] or [n, k], in the matrix's precision."""
        return self.superlu.solve(right.astype(self.precision, copy=False))


def factorised(matrix: sparse.spmatrix) -> Factors:
    """The factors of a symmetric positive definite matrix [n, n].

    Ordered by the matrix plus its transpose and without pivots: half the entries and time of the library's default,
    which is for matrices of any kind. RuntimeError for a singular one.
    """
    superlu = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return Factors(superlu, matrix.dtype)


def solved_by_factors_of_another(
    matrix: sparse.spmatrix, right: np.ndarray, factors: Factors, accuracy: float = _ACCURACY
) -> np.ndarray:
    """x [n, k] of matrix x = right [n, k], matrix [n, n] symmetric positive definite, by conjugate gradients that the
    factors of a similar one precondition: side by side, a step length for each column.

    Ends where no entry of the preconditioned residual, which is an error's estimate, exceeds accuracy times the
    column's largest; where steps do not get there (the matrices are not alike) the matrix is factorised itself. Factors
    in single precision do as well and are half as much to read, which is what a step takes.
    Reference: [Saad2003], algorithm 9.1.
    """
    rows = matrix.tocsr()
    found, residual = np.zeros_like(right, np.float64), right.astype(np.float64)
    towards = factors.solve(residual).astype(np.float64)
    direction, slope = towards.copy(), (residual * towards).sum(0)
    for _ in range(_STEPS):
        if (np.abs(towards).max(0) <= accuracy * np.abs(found).max(0)).all():
            return found
        across = rows @ direction
        length = slope / np.maximum((direction * across).sum(0), np.finfo(float).tiny)
        found += length * direction
        residual -= length * across
        towards = factors.solve(residual).astype(np.float64)
        slope, before = (residual * towards).sum(0), slope
        direction = towards + slope / np.maximum(before, np.finfo(float).tiny) * direction
    return factorised(matrix).solve(right)
