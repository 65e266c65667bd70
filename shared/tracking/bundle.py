"""Rigid bundle adjustment: the head as a rigid cloud of points, the camera moving around it.

Poses and points are solved together. The scale and place of the cloud are free in the images: a weak prior on the
points fixes them and steadies clips with little rotation. A Levenberg step over 250 frames and 2500 points takes about
a second on two cores, where Ceres takes ten times as long over the same dense system, and its matrix gives the
covariance.

Every Jacobian passes through the point in camera axes, so that an observation is worth one 3 x 3 matrix J^T W J and one
3-vector; the blocks of cameras, points and their coupling follow from these by rotations and levers. Every point is
seen in most frames, so the reduced camera system is dense, and one matrix product builds it. Inside, components come
first, [3, 3, F, n]: products of small matrices then run along frames and points, ten times faster than one by one.

References: [Triggs2000], sections 3.3 (robust cost), 6.1 (elimination), 9 (gauge freedom); [Levenberg1944] (damped
steps).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from shared.geometry.transforms import project, rotation_from_vector
from shared.tracking.motion_prior import MotionPrior

CHUNK_POINTS = 256
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
    """What some points add to the normal equations.

    cameras [F, 6, 6], camera_rhs [F, 6]; points [n, 3, 3], point_rhs [n, 3]; mixed [6, 3, F, n]; the focal length's own
    entries, with the cameras [F, 6] and with the points [n, 3].
    """

    cameras: np.ndarray
    camera_rhs: np.ndarray
    points: np.ndarray
    point_rhs: np.ndarray
    mixed: np.ndarray
    focal: float
    focal_rhs: float
    focal_cameras: np.ndarray
    focal_points: np.ndarray


@dataclass(frozen=True)
class ReducedSystem:
    """matrix [C, C] @ cameras = rhs [C]; coupling [C, 3 N], half_inverse [N, 3, 3] and point_rhs [N, 3] for points."""

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
        self.seen = tracks.seen & (tracks.seen.sum(0) >= least_views)
        self.anchor, self.intrinsics, self.loss_scale = np.array(anchor, np.float64), intrinsics, loss_scale
        self.motion, self.refine_focal = motion, refine_focal
        self.unknowns = 6 * len(tracks.pixels) + int(refine_focal)
        self._pixels = np.moveaxis(np.where(self.seen[..., None], tracks.pixels, 0.0), -1, 0).copy()
        self._whitening = np.moveaxis(tracks.whitening, (2, 3), (0, 1)).copy()
        self._anchor_weight = np.maximum(self.seen.sum(0), 1) / prior_mm**2 + 1e-9

    def chunks(self):
        """Slices over the points that bound the memory."""
        return (slice(i, i + CHUNK_POINTS) for i in range(0, len(self.anchor), CHUNK_POINTS))

    def cost(self, state: BundleState) -> float:
        """Cauchy cost of the residuals, the anchor's and the motion's."""
        total = 0.0
        for chunk in self.chunks():
            weight = self._residuals(state, chunk)[1]
            total -= self.loss_scale**2 * np.log(weight[self.seen[:, chunk]]).sum()
        total += (self._anchor_weight[:, None] * (state.points - self.anchor) ** 2).sum()
        return float(total + (0.0 if self.motion is None else self.motion.cost(state.poses)))

    def _residuals(self, state, chunk) -> tuple[np.ndarray, ...]:
        """Whitened residuals [2, F, n], Cauchy weights [F, n], points turned into camera axes, and in the camera."""
        turned = state.poses[:, :3, :3].transpose(1, 0, 2) @ state.points[chunk].T
        in_camera = turned + state.poses[:, :3, 3].T[..., None]
        error = in_camera[:2] / in_camera[2] * self._focal(state)[:, None, None] + self.intrinsics[:2, 2, None, None]
        error -= self._pixels[..., chunk]
        whitening = self._whitening[..., chunk]
        residual = whitening[:, 0] * error[0] + whitening[:, 1] * error[1]
        squared = (residual**2).sum(0) / self.loss_scale**2
        return residual, np.where(self.seen[:, chunk], 1.0 / (1.0 + squared), 0.0), turned, in_camera

    def _focal(self, state) -> np.ndarray:
        return self.intrinsics[[0, 1], [0, 1]] * np.exp(state.log_focal)

    def linearised(self, state: BundleState, chunk: slice) -> Blocks:
        """Normal equations of the points in one chunk."""
        residual, weight, turned, in_camera = self._residuals(state, chunk)
        x, y, z = in_camera
        focal, whitening = self._focal(state), self._whitening[..., chunk]
        by_x, by_y = whitening[:, 0] * (focal[0] / z), whitening[:, 1] * (focal[1] / z)
        jacobian = np.stack([by_x, by_y, -(by_x * (x / z) + by_y * (y / z))])
        weighted = jacobian * weight
        inner = np.einsum("aifn,bifn->abfn", weighted, jacobian)
        pull = -np.einsum("aifn,ifn->afn", weighted, residual)
        rotation = state.poses[:, :3, :3].transpose(1, 2, 0).copy()
        lever_inner, by_point = _cross(turned, inner), np.einsum("abfn,bcf->acfn", inner, rotation)
        cameras = np.empty((len(weight), 6, 6))
        cameras[:, :3, :3] = _cross(turned, lever_inner.swapaxes(0, 1)).sum(-1).transpose(2, 1, 0)
        cameras[:, :3, 3:] = lever_inner.sum(-1).transpose(2, 0, 1)
        cameras[:, 3:, :3] = np.swapaxes(cameras[:, :3, 3:], 1, 2)
        cameras[:, 3:, 3:] = inner.sum(-1).transpose(2, 0, 1)
        points = np.einsum("baf,bcfn->nac", rotation, by_point)
        points[:, [0, 1, 2], [0, 1, 2]] += self._anchor_weight[chunk, None]
        point_rhs = np.einsum("baf,bfn->na", rotation, pull)
        point_rhs -= self._anchor_weight[chunk, None] * (state.points[chunk] - self.anchor[chunk])
        # a longer focal length moves a pixel as a point does that moves away from the axis
        growing = np.einsum("abfn,bfn->afn", inner[:, :2], in_camera[:2])
        return Blocks(
            cameras=cameras,
            camera_rhs=np.concatenate([_cross(turned, pull).sum(-1), pull.sum(-1)]).T,
            points=points,
            point_rhs=point_rhs,
            mixed=np.concatenate([_cross(turned, by_point), by_point]),
            focal=float((growing[:2] * in_camera[:2]).sum()),
            focal_rhs=float((pull[:2] * in_camera[:2]).sum()),
            focal_cameras=np.concatenate([_cross(turned, growing).sum(-1), growing.sum(-1)]).T,
            focal_points=np.einsum("baf,bfn->na", rotation, growing),
        )

    def reduced_system(self, state: BundleState) -> ReducedSystem:
        """Gauss-Newton system of the cameras with the points eliminated (Schur complement)."""
        frames, count = self.seen.shape
        size = 6 * frames
        matrix, rhs = np.zeros((self.unknowns,) * 2), np.zeros(self.unknowns)
        coupling = np.empty((self.unknowns, 3 * count))
        half_inverse, point_rhs = np.empty((count, 3, 3)), np.empty((count, 3))
        cameras = np.zeros((frames, 6, 6))
        for chunk in self.chunks():
            block = self.linearised(state, chunk)
            half = np.linalg.cholesky(np.linalg.inv(block.points))
            columns = slice(3 * chunk.start, 3 * (chunk.start + len(half)))
            mixed = np.einsum("abfn,bcn->acfn", block.mixed, half.transpose(1, 2, 0).copy())
            coupling[:size, columns] = mixed.transpose(2, 0, 3, 1).reshape(size, -1)
            half_inverse[chunk], point_rhs[chunk] = half, block.point_rhs
            cameras += block.cameras
            rhs[:size] += block.camera_rhs.ravel()
            if self.refine_focal:
                coupling[-1, columns] = np.einsum("nj,njk->nk", block.focal_points, half).ravel()
                matrix[-1, :size] += block.focal_cameras.ravel()
                matrix[-1, -1] += block.focal
                rhs[-1] += block.focal_rhs
        if self.refine_focal:
            matrix[:size, -1] = matrix[-1, :size]
        for f in range(frames):
            matrix[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] = cameras[f]
        matrix -= coupling @ coupling.T
        rhs -= coupling @ np.einsum("njk,nj->nk", half_inverse, point_rhs).ravel()
        if self.motion is not None:
            for axis, (normal, pull) in enumerate(zip(*self.motion.normal_equations(state.poses), strict=True)):
                matrix[axis:size:6, axis:size:6] += normal
                rhs[axis:size:6] += pull
        return ReducedSystem(matrix, rhs, coupling, half_inverse, point_rhs)

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


def _cross(vectors: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Cross products of vectors [3, F, n] with others [3, F, n], or with each column of matrices [3, C, F, n]."""
    (x, y, z), (a, b, c) = vectors, others
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a])


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
    """Points alone, the poses held: N independent robust Gauss-Newton solutions. Arguments as in `adjust`. points
    [N, 3] mm."""
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
