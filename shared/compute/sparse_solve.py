"""Sparse symmetric systems, solved directly, and many that are alike, from the factors of one."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import SuperLU, splu

_ACCURACY = 1e-8
_STEPS = 40
"""More steps than these take longer than new factors."""


def factorised(matrix: sparse.spmatrix) -> SuperLU:
    """The factors of a symmetric positive definite matrix [n, n], whose `solve` takes right sides [n] or [n, k] of the
    matrix's precision.

    Ordered by the matrix plus its transpose and without pivots: half the entries and time of the library's default,
    which is for matrices of any kind. RuntimeError for a singular one.
    """
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def solved_by_factors_of_another(
    matrix: sparse.spmatrix, right: np.ndarray, factors: SuperLU, accuracy: float = _ACCURACY
) -> np.ndarray:
    """x [n, k] of matrix x = right [n, k], matrix [n, n] symmetric positive definite, by conjugate gradients that the
    factors of a similar one precondition: side by side, a step length for each column.

    Ends where no entry of the preconditioned residual, which is an error's estimate, exceeds accuracy times the
    column's largest; where steps do not get there (the matrices are not alike) the matrix is factorised itself. Factors
    in single precision do as well and are half as much to read, which is what a step takes.
    Reference: [Saad2003], algorithm 9.1.
    """
    rows, kind = matrix.tocsr(), factors.L.dtype
    found, residual = np.zeros_like(right, np.float64), right.astype(np.float64)
    towards = factors.solve(residual.astype(kind)).astype(np.float64)
    direction, slope = towards.copy(), (residual * towards).sum(0)
    for _ in range(_STEPS):
        if (np.abs(towards).max(0) <= accuracy * np.abs(found).max(0)).all():
            return found
        across = rows @ direction
        length = slope / np.maximum((direction * across).sum(0), np.finfo(float).tiny)
        found += length * direction
        residual -= length * across
        towards = factors.solve(residual.astype(kind)).astype(np.float64)
        slope, before = (residual * towards).sum(0), slope
        direction = towards + slope / np.maximum(before, np.finfo(float).tiny) * direction
    return factorised(matrix).solve(right.astype(np.float64))
