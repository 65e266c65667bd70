"""Rigid bundle adjustment: the head as a rigid cloud of points, the camera moving around it.

Points and poses are solved together by Ceres through pycolmap. The scale and place of the cloud are free in the images;
a weak prior on the points (pyceres NormalPrior) fixes them and steadies clips with little rotation.

References: Triggs et al., Bundle adjustment - a modern synthesis, 2000; Ceres Solver (Agarwal et al.).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyceres
import pycolmap

from shared.geometry import project, rigid

pycolmap.logging.minloglevel = 2


@dataclass(frozen=True)
class BundleSolution:
    """camera_from_points [F, 4, 4], points [N, 3] mm, residuals_px [F, N, 2] (model minus observed; NaN: unseen)."""

    camera_from_points: np.ndarray
    points: np.ndarray
    residuals_px: np.ndarray

    @property
    def error_px(self) -> np.ndarray:
        """[F, N] length of each residual, NaN where unseen."""
        return np.linalg.norm(self.residuals_px, axis=-1)


def pose_from_points(
    points: np.ndarray, points_px: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], max_error_px: float
) -> np.ndarray | None:
    """Robust pose from 3D-2D pairs: points [N, 3] mm, points_px [N, 2] -> camera_from_points [4, 4] or None."""
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = max_error_px
    estimation.ransac.random_seed = 0
    answer = pycolmap.estimate_and_refine_absolute_pose(
        np.asarray(points_px, np.float64), np.asarray(points, np.float64), _camera(intrinsics, size), estimation
    )
    return None if answer is None else _matrix(answer["cam_from_world"])


def adjust(
    observations_px: np.ndarray,
    camera_from_points: np.ndarray,
    points: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    *,
    loss_scale_px: float,
    prior_mm: float,
    max_iterations: int = 40,
) -> BundleSolution:
    """Minimises the reprojection error of F x N observations under a Cauchy loss.

    observations_px [F, N, 2], NaN where a point is not seen; camera_from_points [F, 4, 4] and points [N, 3] are the
    start. loss_scale_px: residuals beyond it lose their pull. prior_mm: standard deviation of each point about its
    start, weighed against all its observations together as one of loss_scale_px, since the errors of a track go along
    with each other: with wide rotation the prior is nothing, with little it keeps the depth. The intrinsics stay fixed.
    """
    reconstruction, point_ids = _reconstruction(observations_px, camera_from_points, points, intrinsics, size)
    frames = len(camera_from_points)
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.refine_focal_length = options.refine_extra_params = options.refine_principal_point = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale_px
    for i in range(frames):
        config.add_image(i + 1)
    config.set_constant_cam_intrinsics(1)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    length = np.isfinite(observations_px[..., 0]).sum(0)
    deviation = prior_mm / (loss_scale_px * np.sqrt(np.maximum(length, 1)))
    anchors = _add_point_priors(adjuster.problem, reconstruction, point_ids, deviation)
    pyceres.solve(_solver_options(max_iterations), adjuster.problem, pyceres.SolverSummary())
    del anchors
    poses = np.stack([_matrix(reconstruction.images[i + 1].cam_from_world()) for i in range(frames)])
    solved = np.array(points, np.float64)
    for j, point_id in point_ids.items():
        solved[j] = reconstruction.points3D[point_id].xyz
    pixels, _ = project(solved, poses, intrinsics)
    return BundleSolution(poses, solved, pixels - observations_px)


def pose_covariance(solution: BundleSolution, intrinsics: np.ndarray) -> np.ndarray:
    """[F, 6, 6] covariance of each pose: rotation vector (radians, camera axes) before translation (mm).

    Inverse of the normal matrix with the points eliminated (Schur complement); the seven free modes (place and scale
    of the cloud) drop out of the pseudo-inverse. The noise of an observation is taken from the residuals' spread, and
    tracks of one neighbourhood share their error: the count of independent ones is an eighth of all.
    """
    seen = np.isfinite(solution.residuals_px[..., 0])
    frames, count = seen.shape
    by_pose, by_point = _jacobians(solution, intrinsics)
    by_pose, by_point = by_pose * seen[..., None, None], by_point * seen[..., None, None]
    pose_blocks = (np.swapaxes(by_pose, -1, -2) @ by_pose).sum(1)
    point_blocks = (np.swapaxes(by_point, -1, -2) @ by_point).sum(0) + 1e-9 * np.eye(3)
    mixed = (np.swapaxes(by_pose, -1, -2) @ by_point).transpose(1, 0, 2, 3).reshape(count, frames * 6, 3)
    weighted = (mixed @ np.linalg.inv(point_blocks)).transpose(1, 0, 2).reshape(frames * 6, -1)
    normal = -weighted @ mixed.transpose(1, 0, 2).reshape(frames * 6, -1).T
    for f in range(frames):
        normal[f * 6 : f * 6 + 6, f * 6 : f * 6 + 6] += pose_blocks[f]
    scale = np.tile([1.0, 1.0, 1.0, 100.0, 100.0, 100.0], frames)  # balances radians against millimetres
    inverse = np.linalg.pinv(normal * np.outer(scale, scale), rcond=1e-9, hermitian=True) * np.outer(scale, scale)
    noise = 1.4826 * np.nanmedian(np.abs(solution.residuals_px))
    blocks = np.stack([inverse[f * 6 : f * 6 + 6, f * 6 : f * 6 + 6] for f in range(frames)])
    return blocks * noise**2 * 8.0


def _jacobians(solution: BundleSolution, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """d pixel / d (rotation, translation) [F, N, 2, 6] and d pixel / d point [F, N, 2, 3]."""
    rotation = solution.camera_from_points[:, :3, :3]
    turned = np.einsum("fij,nj->fni", rotation, solution.points)
    x, y, z = np.moveaxis(turned + solution.camera_from_points[:, None, :3, 3], -1, 0)
    fx, fy = intrinsics[0, 0], intrinsics[1, 1]
    zero = np.zeros_like(z)
    by_camera = np.stack(
        [np.stack([fx / z, zero, -fx * x / z**2], -1), np.stack([zero, fy / z, -fy * y / z**2], -1)], axis=-2
    )
    tx, ty, tz = np.moveaxis(turned, -1, 0)
    cross = np.stack([np.stack(r, -1) for r in ((zero, tz, -ty), (-tz, zero, tx), (ty, -tx, zero))], axis=-2)
    by_pose = np.concatenate([by_camera @ cross, by_camera], axis=-1)
    return by_pose, np.einsum("fnri,fij->fnrj", by_camera, rotation)


def _camera(intrinsics: np.ndarray, size: tuple[int, int]) -> pycolmap.Camera:
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    width, height = (int(n) for n in size)
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[fx, fy, cx, cy], camera_id=1)


def _matrix(transform: pycolmap.Rigid3d) -> np.ndarray:
    return rigid(transform.rotation.matrix(), transform.translation)


def _reconstruction(observations_px, camera_from_points, points, intrinsics, size):
    """A pycolmap reconstruction of the start; -> it and {row of points: its id}. Points seen once are left out."""
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(_camera(intrinsics, size))
    seen = np.isfinite(observations_px[..., 0])
    seen &= seen.sum(0) >= 2
    place = np.cumsum(seen, axis=1) - 1
    for i, pose in enumerate(camera_from_points):
        image = pycolmap.Image(name=f"{i:06d}", camera_id=1, image_id=i + 1)
        image.points2D = [pycolmap.Point2D(xy) for xy in observations_px[i, seen[i]]]
        transform = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
        reconstruction.add_image_with_trivial_frame(image, transform)
    point_ids = {}
    for j in np.nonzero(seen.any(0))[0]:
        track = pycolmap.Track()
        for i in np.nonzero(seen[:, j])[0]:
            track.add_element(int(i) + 1, int(place[i, j]))
        point_ids[int(j)] = reconstruction.add_point3D(np.asarray(points[j], np.float64), track)
    return reconstruction, point_ids


def _add_point_priors(problem, reconstruction, point_ids, deviation: np.ndarray) -> list:
    """Pulls each point to its start; -> what has to stay alive until the problem is solved."""
    anchors = []
    for j, point_id in point_ids.items():
        covariance = np.eye(3) * deviation[j] ** 2
        position = reconstruction.points3D[point_id].xyz
        cost = pyceres.factors.NormalPrior(position.copy(), covariance)
        loss = pyceres.TrivialLoss()
        problem.add_residual_block(cost, loss, [position])
        anchors += [cost, loss, position]
    return anchors


def _solver_options(max_iterations: int) -> pyceres.SolverOptions:
    options = pyceres.SolverOptions()
    # every point is seen in most frames, so the reduced system is full: building it costs more than iterating on it
    options.linear_solver_type = pyceres.LinearSolverType.ITERATIVE_SCHUR
    options.preconditioner_type = pyceres.PreconditionerType.SCHUR_JACOBI
    options.max_num_iterations = max_iterations
    options.function_tolerance = 1e-6
    options.num_threads = 1  # one summation order, so the same bytes each time
    options.minimizer_progress_to_stdout = False
    return options
