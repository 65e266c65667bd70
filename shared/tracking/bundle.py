"""Rigid bundle adjustment: the head as a rigid cloud of points, the camera moving around it.

Poses and points are solved together. The scale and place of the cloud are free in the images: a weak prior on the
points fixes them and steadies clips with little rotation. A Levenberg step over 250 frames and 2500 points takes
0.6 s of processor time, where Ceres takes some ten seconds over the same dense system, and its matrix gives the
covariance.

Compiled loops make the blocks of cameras, of points and of their coupling, each observation from its derivatives. Every
point is seen in most frames, so the reduced camera system is dense, and one matrix product builds it.

References: [Triggs2000], sections 3.3 (robust cost), 6.1 (elimination), 9 (gauge freedom); [Levenberg1944] (damped
steps).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from shared.compute.parallel import shared_out
from shared.geometry.transforms import project, rotation_from_vector
from shared.tracking.bundle_loops import Observations, add_normal_equations, cauchy_cost, couple
from shared.tracking.motion_prior import MotionPrior

CHUNK_POINTS, TILE_ROWS = 256, 300
"""Shares of the work that do not hang on the number of threads, so that sums do not either."""
LARGEST_DAMPING = 1e6
LEAST_GAIN = 1e-4
"""Relative fall of the cost at which the iteration ends; poses then move by less than 0.001 degrees."""


@dataclass(frozen=True)
class Tracks:
    """Where F frames show N points: pixels [F, N, 2] (NaN: unseen), whitening [F, N, 2, 2] 1/px.

    whitening @ error has unit covariance where the noise is as measured.
    """

    pixels: np.ndarray
    whitening: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """[F, N] bool."""
        return np.isfinite(self.pixels[..., 0])

    @classmethod
    def of_equal_noise(cls, pixels: np.ndarray, noise_px: float) -> Tracks:
        """All observations alike: noise_px is the standard deviation along each axis."""
        return cls(pixels, np.broadcast_to(np.eye(2) / noise_px, (*pixels.shape, 2)))

    def subset(self, frames=slice(None), points=slice(None)) -> Tracks:
        """Chosen frames and points (slices, masks or indices)."""
        return Tracks(self.pixels[frames][:, points], self.whitening[frames][:, points])

    def with_noise(self, factor: float) -> Tracks:
        """All noise larger by a factor."""
        return Tracks(self.pixels, self.whitening / factor)


@dataclass(frozen=True)
class BundleState:
    """Unknowns: poses [F, 4, 4] (camera_from_points), points [N, 3], log of the focal length's gain."""

    poses: np.ndarray
    points: np.ndarray
    log_focal: float = 0.0


@dataclass(frozen=True)
class Blocks:
    """Normal equations but for what couples cameras with points.

    cameras [F, 6, 6], camera_rhs [F, 6]; points [N, 3, 3], point_rhs [N, 3]; the focal length's own entries, with the
    cameras [F, 6] and with the points [N, 3].
    """

    cameras: np.ndarray
    camera_rhs: np.ndarray
    points: np.ndarray
    point_rhs: np.ndarray
    focal: float
    focal_rhs: float
    focal_cameras: np.ndarray
    focal_points: np.ndarray


@dataclass(frozen=True)
class ReducedSystem:
    """matrix [C, C] @ cameras = rhs [C]; coupling [C, 3 N], half_inverse [N, 3, 3] and point_rhs [N, 3] for points.

    coupling holds until the problem makes its next system.
    """

    matrix: np.ndarray
    rhs: np.ndarray
    coupling: np.ndarray
    half_inverse: np.ndarray
    point_rhs: np.ndarray


class BundleProblem:
    """Whitened reprojection errors under a Cauchy loss, points tied weakly to an anchor, perhaps a motion prior.

    Camera unknowns: rotation vector (camera axes) and translation of each frame, then, if wanted, the log focal gain.
    """

    def __init__(
        self,
        tracks: Tracks,
        anchor: np.ndarray,
        intrinsics: np.ndarray,
        *,
        loss_scale: float,
        prior_mm: float = np.inf,
        motion: MotionPrior | None = None,
        refine_focal: bool = False,
        least_views: int = 2,
    ):
        """anchor [N, 3] mm; prior_mm: see shared.tracking.bundle.adjust; points seen less often than least_views are
        out."""
        self.seen = np.ascontiguousarray(tracks.seen & (tracks.seen.sum(0) >= least_views))
        self.anchor, self.intrinsics, self.loss_scale = np.array(anchor, np.float64), intrinsics, loss_scale
        self.motion, self.refine_focal = motion, refine_focal
        self.unknowns = 6 * len(tracks.pixels) + int(refine_focal)
        self._pixels = np.ascontiguousarray(tracks.pixels, np.float64)
        self._whitening = np.ascontiguousarray(tracks.whitening, np.float64)
        self._anchor_weight = np.maximum(self.seen.sum(0), 1) / prior_mm**2 + 1e-9
        self._coupling: np.ndarray | None = None

    def _over_points(self, loop: Callable, state: BundleState) -> list:
        """What loop(observations, first, last) returns for each chunk of the points."""
        count = len(self.anchor)
        observations = Observations(
            rotation=np.ascontiguousarray(state.poses[:, :3, :3]),
            shift=np.ascontiguousarray(state.poses[:, :3, 3]),
            points=state.points,
            pixels=self._pixels,
            whitening=self._whitening,
            seen=self.seen,
            focal=self._focal(state),
            centre=self.intrinsics[:2, 2].copy(),
            loss=float(self.loss_scale),
        )
        return shared_out(
            lambda first: loop(observations, first, min(first + CHUNK_POINTS, count)), range(0, count, CHUNK_POINTS)
        )

    def cost(self, state: BundleState) -> float:
        """Cauchy cost of the residuals, the anchor's and the motion's."""
        total = sum(self._over_points(cauchy_cost, state))
        total += (self._anchor_weight[:, None] * (state.points - self.anchor) ** 2).sum()
        return float(total + (0.0 if self.motion is None else self.motion.cost(state.poses)))

    def _focal(self, state) -> np.ndarray:
        return self.intrinsics[[0, 1], [0, 1]] * np.exp(state.log_focal)

    def linearised(self, state: BundleState) -> Blocks:
        """Normal equations of all observations and of the points' anchor."""
        frames, count = self.seen.shape
        own = np.zeros((count, 3, 5))

        def add(observations: Observations, first: int, last: int) -> np.ndarray:
            cameras = np.zeros((frames, 7, 8))
            add_normal_equations(observations, first, last, cameras, own)
            return cameras

        cameras = sum(self._over_points(add, state))
        normal = cameras[:, :6, :6] + np.triu(cameras[:, :6, :6], 1).swapaxes(1, 2)
        own[:, [0, 1, 2], [0, 1, 2]] += self._anchor_weight[:, None]
        return Blocks(
            cameras=normal,
            camera_rhs=cameras[:, :6, 7],
            points=own[..., :3],
            point_rhs=own[..., 4] - self._anchor_weight[:, None] * (state.points - self.anchor),
            focal=float(cameras[:, 6, 6].sum()),
            focal_rhs=float(cameras[:, 6, 7].sum()),
            focal_cameras=cameras[:, :6, 6],
            focal_points=own[..., 3],
        )

    def coupling(self, state: BundleState, half: np.ndarray, focal_points: np.ndarray) -> np.ndarray:
        """What couples the camera unknowns with the points, [C, 3 N], each point's columns times its half [N, 3, 3]; it
        holds until the next call. focal_points [N, 3]: see Blocks."""
        if self._coupling is None:  # the largest array of all: its pages are had once
            self._coupling = np.empty((self.unknowns, 3 * len(half)))
        coupling = self._coupling
        self._over_points(
            lambda observations, first, last: couple(observations, first, last, half, coupling), state
        )
        if self.refine_focal:
            coupling[-1] = np.einsum("nj,njk->nk", focal_points, half).ravel()
        return coupling

    def reduced_system(self, state: BundleState) -> ReducedSystem:
        """Gauss-Newton system of the cameras with the points eliminated (Schur complement)."""
        frames, block = len(self.seen), self.linearised(state)
        size = 6 * frames
        half = np.linalg.cholesky(np.linalg.inv(block.points))
        coupling = self.coupling(state, half, block.focal_points)
        matrix, rhs = -_outer_product(coupling), np.zeros(self.unknowns)
        rhs[:size] = block.camera_rhs.ravel()
        if self.refine_focal:
            matrix[-1, :size] += block.focal_cameras.ravel()
            matrix[:size, -1] += block.focal_cameras.ravel()
            matrix[-1, -1] += block.focal
            rhs[-1] = block.focal_rhs
        for f in range(frames):
            matrix[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] += block.cameras[f]
        rhs -= coupling @ np.einsum("njk,nj->nk", half, block.point_rhs).ravel()
        if self.motion is not None:
            for axis, (normal, pull) in enumerate(zip(*self.motion.normal_equations(state.poses), strict=True)):
                matrix[axis:size:6, axis:size:6] += normal
                rhs[axis:size:6] += pull
        return ReducedSystem(matrix, rhs, coupling, half, block.point_rhs)

    def step(self, state: BundleState, system: ReducedSystem, damping: float) -> BundleState:
        """Solves the damped camera system, then each point for itself. damping: relative to the diagonal."""
        matrix = system.matrix + damping * np.diag(np.diag(system.matrix) + 1e-12)
        cameras = cho_solve(cho_factor(matrix, check_finite=False), system.rhs, check_finite=False)
        frames = len(state.poses)
        half, coupled = system.half_inverse, (system.coupling.T @ cameras).reshape(-1, 3)
        own = np.einsum("njk,nj->nk", half, system.point_rhs)
        points = state.points + np.einsum("njk,nk->nj", half, own - coupled)
        poses = moved(state.poses, cameras[: 6 * frames].reshape(frames, 6))
        return BundleState(poses, points, state.log_focal + (float(cameras[-1]) if self.refine_focal else 0.0))


def moved(poses: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Poses [F, 4, 4] turned and shifted by motion [F, 6]: rotation vector in camera axes, translation in mm."""
    result = poses.copy()
    result[:, :3, :3] = rotation_from_vector(motion[:, :3]) @ poses[:, :3, :3]
    result[:, :3, 3] += motion[:, 3:]
    return result


def _outer_product(rows: np.ndarray) -> np.ndarray:
    """rows [C, K] @ rows.T, tile by tile: the library itself works on one thread."""
    product = np.empty((len(rows), len(rows)))
    starts = range(0, len(rows), TILE_ROWS)

    def fill(tile: tuple[int, int]) -> None:
        i, j = (slice(start, start + TILE_ROWS) for start in tile)
        product[i, j] = rows[i] @ rows[j].T
        product[j, i] = product[i, j].T

    shared_out(fill, [(i, j) for i in starts for j in starts if i <= j])
    return product


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

    A frame that shows fewer than six points keeps its start and has an infinite covariance. points [N, 3] mm.
    """
    problem = BundleProblem(tracks, points, intrinsics, loss_scale=loss_scale, least_views=1)
    poses = np.array(camera_from_points, np.float64)
    solvable = tracks.seen.sum(1) >= 6
    for _ in range(iterations):
        block = problem.linearised(BundleState(poses, problem.anchor))
        cameras, rhs = block.cameras, block.camera_rhs
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
    """Points alone, the poses held: N independent robust Gauss-Newton solutions. Arguments as in `adjust`. points
    [N, 3] mm."""
    problem = BundleProblem(tracks, points, intrinsics, loss_scale=loss_scale, prior_mm=prior_mm)
    state = BundleState(np.array(camera_from_points, np.float64), problem.anchor.copy())
    for _ in range(iterations):
        block = problem.linearised(state)
        state.points[:] += np.linalg.solve(block.points, block.point_rhs[..., None])[..., 0]
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
