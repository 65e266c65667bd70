"""Relaxes a flat layout of a triangle mesh under the symmetric Dirichlet energy, without ever folding a
triangle.

    E = sum_t w_t A_t (|J_t|^2 + |J_t^-1|^2)

J_t is the Jacobian from triangle t at rest (laid flat, scaled) to its layout; E is smallest, 4 per unit
of weight, where every triangle keeps its shape and size [Smith2015]. Minimised by Newton's method with
each triangle's Hessian made positive semidefinite in closed form [Smith2019]; the line search never
steps to where a triangle would flip.
"""

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

ITERATIONS = 60
TOLERANCE = 1e-5


def relax(
    start: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    density: np.ndarray,
    importance: np.ndarray,
    fixed: np.ndarray,
) -> np.ndarray:
    """[N, 2] relaxed layout of start [N, 2], a valid (unfolded) layout.

    vertices [N, 3] and density [F] (wished scale relative to others) give the triangles at rest; their total
    area is brought to the layout's. importance [F] weights. fixed [N, 2] bool: coordinates that must not
    move.
    """
    rest, area = _rest_gradients(vertices, faces, density, _signed_area(start, faces).sum())
    weight = area * importance
    weight /= weight.sum()
    place = start.copy()
    energy = _energy(place, faces, rest, weight)
    for _ in range(ITERATIONS):
        gradient, hessian = _derivatives(place, faces, rest, weight)
        step = _newton_step(gradient, hessian, fixed)
        last = energy
        place, energy = _line_search(place, step, energy, gradient, faces, rest, weight)
        if last - energy < TOLERANCE * energy:
            break
    return place


def _signed_area(place: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (place[faces[:, k]] for k in range(3))
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def _rest_gradients(
    vertices: np.ndarray, faces: np.ndarray, density: np.ndarray, total: float
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of the corners' hat functions on each triangle at rest [F, 3, 2], and rest areas [F]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    length = np.linalg.norm(b - a, axis=1)
    x_axis = (b - a) / length[:, None]
    x = ((c - a) * x_axis).sum(1)
    y = np.linalg.norm((c - a) - x[:, None] * x_axis, axis=1)
    area = length * y / 2 * density**2
    scale = density * np.sqrt(total / area.sum())
    length, x, y = length * scale, x * scale, np.maximum(y, 1e-3 * length) * scale
    # Corners (0, 0), (length, 0), (x, y).
    zero = np.zeros_like(x)
    gradient_b = np.stack([1 / length, -x / (length * y)], axis=1)
    gradient_c = np.stack([zero, 1 / y], axis=1)
    return np.stack([-gradient_b - gradient_c, gradient_b, gradient_c], axis=1), length * y / 2


def _jacobians(place: np.ndarray, faces: np.ndarray, rest: np.ndarray) -> np.ndarray:
    return np.einsum("fki,fkj->fij", place[faces], rest)


def _energy(place: np.ndarray, faces: np.ndarray, rest: np.ndarray, weight: np.ndarray) -> float:
    """The energy; infinite where a triangle is folded."""
    jacobian = _jacobians(place, faces, rest)
    determinant = np.linalg.det(jacobian)
    if determinant.min() <= 0:
        return np.inf
    # |J^-1|^2 = |J|^2 / det^2 for 2 x 2 matrices.
    return float((weight * (jacobian**2).sum((1, 2)) * (1 + determinant**-2)).sum())


def _derivatives(
    place: np.ndarray, faces: np.ndarray, rest: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, sparse.csc_matrix]:
    """Gradient [2 N] (u and v of a vertex side by side) and positive semidefinite Hessian [2 N, 2 N]."""
    left, sigma, right = np.linalg.svd(_jacobians(place, faces, rest))
    slope = 2 * sigma - 2 * sigma**-3
    s1, s2 = sigma.T
    eigenvalues = np.stack(
        [
            2 + 6 * s1**-4,
            2 + 6 * s2**-4,
            np.maximum(slope.sum(1) / (s1 + s2), 0),
            2 + 2 * (s1**2 + s1 * s2 + s2**2) / (s1 * s2) ** 3,
        ],
        axis=1,
    )
    half = np.sqrt(0.5)
    modes = np.array([[[1, 0], [0, 0]], [[0, 0], [0, 1]], [[0, -half], [half, 0]], [[0, half], [half, 0]]])
    modes = np.einsum("fij,mjk,fkl->fmil", left, modes, right)
    at_corners = np.einsum("fmij,fkj->fmki", modes, rest).reshape(len(faces), 4, 6)
    index = (2 * faces[:, :, None] + np.arange(2)).reshape(len(faces), 6)
    first = np.einsum("f,fm,fmc->fc", weight, slope, at_corners[:, :2])
    second = np.einsum("f,fm,fmc,fmd->fcd", weight, eigenvalues, at_corners, at_corners)
    size = 2 * len(place)
    gradient = np.bincount(index.ravel(), first.ravel(), size)
    rows, columns = np.repeat(index, 6, axis=1).ravel(), np.tile(index, (1, 6)).ravel()
    return gradient, sparse.coo_matrix((second.ravel(), (rows, columns)), shape=(size, size)).tocsc()


def _newton_step(gradient: np.ndarray, hessian: sparse.csc_matrix, fixed: np.ndarray) -> np.ndarray:
    """[N, 2] -H^-1 g over the free coordinates."""
    free = np.nonzero(~fixed.ravel())[0]
    step = np.zeros(fixed.size)
    reduced = hessian[free][:, free] + sparse.identity(len(free)) * (1e-9 * hessian.diagonal().mean())
    step[free] = -splu(reduced.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
        gradient[free]
    )
    return step.reshape(fixed.shape)


def _line_search(
    place: np.ndarray,
    step: np.ndarray,
    energy: float,
    gradient: np.ndarray,
    faces: np.ndarray,
    rest: np.ndarray,
    weight: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Backtracking to a sufficient decrease: the new place and energy, or the old where there is none."""
    slope = float(gradient @ step.ravel())
    length = min(1.0, 0.9 * _largest_step(place, step, faces))
    for _ in range(30):
        candidate = place + length * step
        candidate_energy = _energy(candidate, faces, rest, weight)
        if candidate_energy <= energy + 1e-4 * length * slope:
            return candidate, candidate_energy
        length /= 2
    return place, energy


def _largest_step(place: np.ndarray, step: np.ndarray, faces: np.ndarray) -> float:
    """The step length at which the first triangle's area falls to zero (a quadratic in the length)."""
    p, d = place[faces[:, 1:]] - place[faces[:, :1]], step[faces[:, 1:]] - step[faces[:, :1]]
    cross = lambda a, b: a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]  # noqa: E731
    constant, square = cross(p[:, 0], p[:, 1]), cross(d[:, 0], d[:, 1])
    linear = cross(p[:, 0], d[:, 1]) + cross(d[:, 0], p[:, 1])
    discriminant = np.sqrt(np.maximum(linear**2 - 4 * square * constant, 0))
    # The root written so that it stays exact where the quadratic term vanishes.
    denominator = -linear + np.where(linear < 0, discriminant, -discriminant)
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.stack([2 * constant / denominator, denominator / (2 * square)])
    real = linear**2 >= 4 * square * constant
    positive = roots[:, real][(roots[:, real] > 0) & np.isfinite(roots[:, real])]
    return float(positive.min(initial=np.inf))
