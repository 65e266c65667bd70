"""How far track points may be wrong in depth, measured on the tracks themselves.

Depth shows as a motion of the track along the parallax of the clip. What pushes a track along the parallax without any
depth (skin that moves, shading that slides, windows that overlap) pushes it across the parallax as well, where no depth
can take it up: the same profile over the frames, turned by a right angle, is fitted to the residuals, and what it finds
is error only. Its scatter is the scatter of the depth's errors, for noise that has no preferred direction. Neighbours
share errors: patches tell how many of them count as one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from shared.compute.robust import ROBUST_SCALE, cauchy_weight
from shared.geometry.mesh import normalised
from shared.geometry.transforms import camera_centres, projection_slope
from shared.tracking.bundle import BundleSolution

PATCH_MM = 10.0
"""Radius of the patches: tracks farther apart share no errors."""
CLIP = 3.0
CAUCHY = 2.5
LEAST_INFORMATION = 1e-6


@dataclass(frozen=True)
class DepthNoise:
    """Of N track points, in the unit of the points: sigma [N], the standard deviation of each depth with which points
    count as independent; single: that of a typical point by itself."""

    sigma: np.ndarray
    single: float

    def of_mean(self, count: float) -> float:
        """Standard deviation of what all points say together, had they been so many of them."""
        return float(np.median(self.sigma) * np.sqrt(count / len(self.sigma)))


def depth_noise(solution: BundleSolution, reliable: np.ndarray, intrinsics: np.ndarray) -> DepthNoise:
    """From the residuals in the reliable frames [F] bool; points in mm, or nearly so."""
    residual = solution.residuals_px[reliable]
    poses, points = solution.camera_from_points[reliable], solution.points
    error = np.linalg.norm(residual, axis=-1)
    weight = cauchy_weight(np.nan_to_num(error), CAUCHY * np.nanmedian(error), np.isfinite(error))
    residual = np.nan_to_num(residual)
    slope = np.stack([projection_slope(points, pose, intrinsics) for pose in poses])
    view = normalised(normalised(camera_centres(poses)).mean(0))
    beside = normalised(np.cross(view, np.eye(3)[np.argmin(np.abs(view))]))
    known = []
    for axis in (beside, np.cross(view, beside)):
        known.append(_apart(slope @ axis, known, weight)[0])
    parallax, information = _apart(slope @ view, known, weight)
    across = np.stack([-parallax[..., 1], parallax[..., 0]], axis=-1)
    null = _inner(_apart(across, [*known, parallax], weight)[0], residual, weight) / information
    null -= np.median(null)
    single = ROBUST_SCALE * float(np.median(np.abs(null)))
    null = np.clip(null, -CLIP * single, CLIP * single)
    patches = cKDTree(points).query_ball_point(points, PATCH_MM)
    means = np.array([null[patch].mean() for patch in patches])
    shared = float(np.var(means)) * np.mean([len(patch) for patch in patches])
    expected = np.nanmedian(error, axis=0) / information
    expected[~np.isfinite(expected)] = np.nanmax(expected)
    return DepthNoise(expected * np.sqrt(max(shared, single**2)) / np.median(expected), single)


def _inner(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """[F, N, 2] twice -> [N]: weighted product over all frames."""
    return np.einsum("fn,fni,fni->n", weight, first, second)


def _apart(profile: np.ndarray, known: list[np.ndarray], weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A profile [F, N, 2] less its share in the known orthonormal ones, of length one, and the length [N] it had."""
    for _ in range(2):
        for other in known:
            profile = profile - other * _inner(profile, other, weight)[:, None]
    length = np.sqrt(np.maximum(_inner(profile, profile, weight), LEAST_INFORMATION))
    return profile / length[:, None], length
