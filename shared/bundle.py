"""Rigid bundle adjustment: the head as a rigid cloud of points, the camera moving around it.

Poses and points are solved together. The scale and place of the cloud are free in the images: a weak prior on the
points fixes them and steadies clips with little rotation. A Levenberg step over 250 frames and 2500 points takes about
a second on two cores, where Ceres takes ten times as long over the same dense system, and its matrix gives the
covariance.

References: [Triggs2000], section 9 (gauge freedom); [Levenberg1944] (damped steps).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.bundle_problem import BundleProblem, BundleState, Tracks, moved
from shared.geometry import project
from shared.motion_prior import MotionPrior

LARGEST_DAMPING = 1e6
LEAST_GAIN = 1e-4
"""Relative fall of the cost at which the iteration ends; poses then move by less than 0.001 degrees."""


@dataclass(frozen=True)
class BundleSolution:
    """camera_from_points [F, 4, 4], points [N, 3] mm, residuals_px [F, N, 2] (model minus observed; NaN: unseen).

    focal_gain: the solved focal length over the given one; 1 where it was not solved.
    """

    camera_from_points: np.ndarray
    points: np.ndarray
    residuals_px: np.ndarray
    focal_gain: float = 1.0

    @property
    def error_px(self) -> np.ndarray:
        """[F, N] length of each residual, NaN where unseen."""
        return np.linalg.norm(self.residuals_px, axis=-1)


def adjust(
    tracks: Tracks,
    camera_from_points: np.ndarray,
    points: np.ndarray,
    intrinsics: np.ndarray,
    *,
    loss_scale: float,
    prior_mm: float,
    motion: MotionPrior | None = None,
    refine_focal: bool = False,
    max_iterations: int = 25,
) -> BundleSolution:
    """Minimises the whitened reprojection error under a Cauchy loss by Levenberg-Marquardt.

    camera_from_points [F, 4, 4] and points [N, 3] mm are the start; points seen less than twice keep it. loss_scale:
    whitened residuals beyond it lose their pull. prior_mm: deviation of each point about its start, weighed against
    all its observations together as one of them, since the errors of a track go along with each other: with wide
    rotation the prior is nothing, with little it keeps the depth.
    """
    problem = BundleProblem(
        tracks,
        points,
        intrinsics,
        loss_scale=loss_scale,
        prior_mm=prior_mm,
        motion=motion,
        refine_focal=refine_focal,
    )
    state = BundleState(np.array(camera_from_points, np.float64), problem.anchor.copy())
    cost, damping = problem.cost(state), 1e-4
    for _ in range(max_iterations):
        system = problem.reduced_system(state)
        candidate, lower, damping = _descend(problem, state, system, cost, damping)
        if candidate is None:
            break
        gain, state, cost = (cost - lower) / cost, candidate, lower
        if gain < LEAST_GAIN:
            break
    gain = float(np.exp(state.log_focal))
    pixels, _ = project(state.points, state.poses, zoomed(intrinsics, gain))
    return BundleSolution(state.poses, state.points, pixels - tracks.pixels, gain)


def _descend(problem, state, system, cost, damping):
    """The first damped step that lowers the cost -> state (None: none does), its cost, damping for the next."""
    while damping < LARGEST_DAMPING:
        candidate = problem.step(state, system, damping)
        lower = problem.cost(candidate)
        if lower < cost:
            return candidate, lower, max(0.1 * damping, 1e-9)
        damping *= 10.0
    return None, cost, damping


def zoomed(intrinsics: np.ndarray, gain: float) -> np.ndarray:
    """Intrinsics [3, 3] with a focal length that is `gain` times as long."""
    return intrinsics * [[gain, 1.0, 1.0], [1.0, gain, 1.0], [1.0, 1.0, 1.0]]


def resect(
    tracks: Tracks,
    camera_from_points: np.ndarray,
    points: np.ndarray,
    intrinsics: np.ndarray,
    loss_scale: float,
    iterations: int = 10,
) -> tuple[np.ndarray, np.ndarray]:
    """Poses alone, the points held: F independent robust Gauss-Newton solutions -> poses, covariances [F, 6, 6].

    A frame that shows fewer than six points keeps its start and has an infinite covariance.
    """
    problem = BundleProblem(tracks, points, intrinsics, loss_scale=loss_scale, least_views=1)
    poses = np.array(camera_from_points, np.float64)
    solvable = tracks.seen.sum(1) >= 6
    for _ in range(iterations):
        cameras, rhs = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
        for chunk in problem.chunks():
            block = problem.linearised(BundleState(poses, problem.anchor), chunk)
            cameras += block.cameras
            rhs += block.camera_rhs
        cameras[~solvable] = np.eye(6)
        step = np.where(solvable[:, None], np.linalg.solve(cameras, rhs[..., None])[..., 0], 0.0)
        poses = moved(poses, step)
        if np.abs(step[:, :3]).max(initial=0.0) < 1e-6:
            break
    covariance = np.linalg.inv(cameras)
    covariance[~solvable] = np.inf
    return poses, covariance


def place_points(
    tracks: Tracks,
    camera_from_points: np.ndarray,
    points: np.ndarray,
    intrinsics: np.ndarray,
    *,
    loss_scale: float,
    prior_mm: float,
    iterations: int = 8,
) -> BundleSolution:
    """Points alone, the poses held: N independent robust Gauss-Newton solutions. Arguments as in `adjust`."""
    problem = BundleProblem(tracks, points, intrinsics, loss_scale=loss_scale, prior_mm=prior_mm)
    state = BundleState(np.array(camera_from_points, np.float64), problem.anchor.copy())
    for _ in range(iterations):
        for chunk in problem.chunks():
            block = problem.linearised(state, chunk)
            state.points[chunk] += np.linalg.solve(block.points, block.point_rhs[..., None])[..., 0]
    pixels, _ = project(state.points, state.poses, intrinsics)
    return BundleSolution(state.poses, state.points, pixels - tracks.pixels)


@dataclass(frozen=True)
class PoseCovariance:
    """poses [F, 6, 6]: rotation vector (radians, camera axes) before translation (mm).

    log_focal: deviation of the focal length's logarithm had it been solved as well, else 0.
    """

    poses: np.ndarray
    log_focal: float


def pose_covariance(
    solution: BundleSolution,
    tracks: Tracks,
    intrinsics: np.ndarray,
    *,
    loss_scale: float,
    motion: MotionPrior | None = None,
    with_focal: bool = False,
) -> PoseCovariance:
    """Inverse of the reduced camera system; place, turn and size of the whole cloud do not count.

    The seven free modes are held by the smallest-norm gauge ([Triggs2000], section 9.3).
    """
    problem = BundleProblem(
        tracks,
        solution.points,
        zoomed(intrinsics, solution.focal_gain),
        loss_scale=loss_scale,
        motion=motion,
        refine_focal=with_focal,
    )
    poses = solution.camera_from_points
    system = problem.reduced_system(BundleState(poses, solution.points))
    unit = np.tile(np.repeat([1.0, 0.1 * float(np.median(poses[:, 2, 3]))], 3), len(poses))
    modes = _free_modes(poses)
    if with_focal:
        unit, modes = np.append(unit, 1.0), np.vstack([modes, np.zeros((1, 7))])
    modes = np.linalg.qr(modes / unit[:, None])[0]
    rest = np.eye(len(unit)) - modes @ modes.T
    matrix = rest @ (system.matrix * np.outer(unit, unit)) @ rest
    stiffness = float(np.trace(matrix)) / len(matrix)
    inverse = np.linalg.inv(matrix + stiffness * modes @ modes.T) - modes @ modes.T / stiffness
    inverse *= np.outer(unit, unit)
    blocks = np.stack([inverse[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] for f in range(len(poses))])
    return PoseCovariance(blocks, float(np.sqrt(inverse[-1, -1])) if with_focal else 0.0)


def _free_modes(poses: np.ndarray) -> np.ndarray:
    """[6 F, 7]: how the poses change when the cloud is turned, shifted or grown and the pictures stay the same."""
    modes = np.zeros((len(poses), 6, 7))
    modes[:, :3, :3] = modes[:, 3:, 3:6] = poses[:, :3, :3]
    modes[:, 3:, 6] = poses[:, :3, 3]
    return modes.reshape(-1, 7)
