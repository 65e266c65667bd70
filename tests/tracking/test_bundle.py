"""Rigid bundle adjustment against clouds whose poses are known, and against Ceres and scipy on the same problem."""

import numpy as np
import pycolmap
import pytest
from scipy.optimize import least_squares
from shapes import turned

from shared.geometry.transforms import (
    project,
    rigid,
    rotation_from_vector,
    similarity_from_points,
    vector_from_rotation,
)
from shared.tracking.bundle import (
    BundleProblem,
    BundleSolution,
    BundleState,
    Tracks,
    adjust,
    moved,
    place_points,
    pose_covariance,
    resect,
    zoomed,
)
from shared.tracking.motion_prior import MotionPrior
from shared.tracking.pnp import pose_from_points

LENS = np.array([[1500.0, 0, 320], [0, 1500.0, 320], [0, 0, 1]])
SIZE = (640, 640)
NOISE_PX = 0.1
NO_LOSS = 1e6


def head_turn(frames=12, points=150, noise_px=NOISE_PX, outliers=0.0, seed=0):
    """A cloud shaped like a face, turned +-25 degrees before the lens -> points, poses, observations."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform(-1, 1, size=(points, 3)) * [60, 80, 10]
    cloud[:, 2] += 50 - cloud[:, 0] ** 2 / 80 - cloud[:, 1] ** 2 / 160
    angle = np.sin(np.linspace(0, 2 * np.pi, frames))
    vectors = np.stack([0.15 * angle[::-1], np.radians(25) * angle, 0.02 * angle], axis=1)
    poses = turned(vectors, np.array([0, 0, 950.0]) + rng.normal(size=(frames, 3)) * 3)
    observed = project(cloud, poses, LENS)[0] + noise_px * rng.normal(size=(frames, points, 2))
    wrong = rng.random((frames, points)) < outliers
    observed[wrong] += rng.normal(size=(wrong.sum(), 2)) * 20
    observed[rng.random((frames, points)) < 0.3] = np.nan
    return cloud, poses, observed


def shaken(poses, cloud, seed=1):
    """A start that is off by about two degrees and three millimetres."""
    rng = np.random.default_rng(seed)
    turned = rotation_from_vector(0.03 * rng.normal(size=(len(poses), 3))) @ poses[:, :3, :3]
    return rigid(turned, poses[:, :3, 3]), cloud + 3 * rng.normal(size=cloud.shape)


def rotation_errors(found, true):
    """[F, 3] rad, camera axes: each frame's rotation error after the best common turn."""
    u, _, vt = np.linalg.svd(np.einsum("fji,fjk->ik", found[:, :3, :3], true[:, :3, :3]))
    common = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return vector_from_rotation(np.einsum("fij,jk,flk->fil", found[:, :3, :3], common, true[:, :3, :3]))


def rotation_errors_deg(found, true):
    return np.degrees(np.linalg.norm(rotation_errors(found, true), axis=1))


def test_pose_from_points_survives_outliers():
    cloud, poses, observed = head_turn(outliers=0.2)
    seen = np.isfinite(observed[3, :, 0])
    found = pose_from_points(cloud[seen], observed[3, seen], LENS, SIZE, 3.0)
    assert np.abs(found[:3, 3] - poses[3, :3, 3]).max() < 3.0
    assert np.abs(found[:3, :3] - poses[3, :3, :3]).max() < 2e-3


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_adjustment_recovers_poses_and_shape(outliers):
    cloud, poses, observed = head_turn(outliers=outliers)
    tracks = Tracks.of_equal_noise(observed, NOISE_PX)
    solution = adjust(tracks, *shaken(poses, cloud), LENS, loss_scale=3.0, prior_mm=30.0)
    assert rotation_errors_deg(solution.camera_from_points, poses).max() < 0.06
    scale, rotation, shift = similarity_from_points(solution.points, cloud)
    assert np.median(np.linalg.norm(scale * solution.points @ rotation.T + shift - cloud, axis=1)) < 0.4
    assert np.isnan(solution.error_px).sum() == np.isnan(observed[..., 0]).sum()
    assert np.nanmedian(solution.error_px) < 0.2
    assert solution.focal_gain == 1.0


def test_adjustment_is_deterministic():
    cloud, poses, observed = head_turn(frames=6, points=60)
    tracks = Tracks.of_equal_noise(observed, NOISE_PX)
    first, second = (adjust(tracks, poses, cloud, LENS, loss_scale=3.0, prior_mm=5.0) for _ in range(2))
    assert np.array_equal(first.camera_from_points, second.camera_from_points)
    assert np.array_equal(first.points, second.points)


def test_points_that_one_frame_sees_keep_their_start():
    cloud, poses, observed = head_turn(frames=6, points=60)
    observed[:, :3] = np.nan
    observed[2, 0] = 300.0
    tracks = Tracks.of_equal_noise(observed, NOISE_PX)
    start, shape = shaken(poses, cloud)
    solution = adjust(tracks, start, shape, LENS, loss_scale=3.0, prior_mm=30.0)
    assert np.allclose(solution.points[:3], shape[:3], atol=1e-9)
    assert np.linalg.norm(solution.points[3:] - shape[3:], axis=1).min() > 0.1


def test_more_points_than_one_chunk_give_the_same_poses(monkeypatch):
    cloud, poses, observed = head_turn(frames=6, points=90)
    tracks, start = Tracks.of_equal_noise(observed, NOISE_PX), shaken(poses, cloud)
    whole = adjust(tracks, *start, LENS, loss_scale=3.0, prior_mm=30.0)
    monkeypatch.setattr("shared.tracking.bundle.CHUNK_POINTS", 32)
    parts = adjust(tracks, *start, LENS, loss_scale=3.0, prior_mm=30.0)
    assert np.abs(parts.camera_from_points[:, :3, :3] - whole.camera_from_points[:, :3, :3]).max() < 1e-7
    assert np.abs(parts.points - whole.points).max() < 1e-4


def test_anisotropic_noise_is_weighed_along_its_axes():
    cloud, poses, _ = head_turn()
    rng = np.random.default_rng(3)
    shape = len(poses), len(cloud)
    along = rng.uniform(0, np.pi, shape)
    axes = np.stack([np.stack([np.cos(along), np.sin(along)], -1), np.stack([-np.sin(along), np.cos(along)], -1)], -2)
    deviation = np.array([1.0, 0.05])
    noise = np.einsum("fnkj,fnk->fnj", axes, deviation * rng.normal(size=(*shape, 2)))
    pixels = project(cloud, poses, LENS)[0] + noise
    right = Tracks(pixels, axes / deviation[:, None])
    equal = Tracks.of_equal_noise(pixels, 0.7)
    solved = [adjust(tracks, poses, cloud, LENS, loss_scale=10.0, prior_mm=300.0) for tracks in (right, equal)]
    errors = [rotation_errors_deg(solution.camera_from_points, poses) for solution in solved]
    assert np.median(errors[0]) < 0.35 * np.median(errors[1])


def tiny_problem(**more):
    """Four frames, ten points, whitening at random, away from the minimum -> problem, state."""
    cloud, poses, observed = head_turn(frames=4, points=10, noise_px=0.5)
    observed[:, 0] = np.nan
    rng = np.random.default_rng(2)
    whitening = np.eye(2) * 3.0 + rng.normal(size=(4, 10, 2, 2))
    problem = BundleProblem(Tracks(observed, whitening), cloud, LENS, loss_scale=2.0, prior_mm=20.0, **more)
    start, points = shaken(poses, cloud)
    return problem, BundleState(start, points, 0.02 if more.get("refine_focal") else 0.0)


def numeric(function, size, step):
    """Central differences of a function of [size] about zero, along each axis."""
    return np.array([(function(e) - function(-e)) / (2 * step) for e in np.eye(size) * step])


def test_right_hand_sides_are_the_cost_s_gradient():
    problem, state = tiny_problem(refine_focal=True)
    block = problem.linearised(state)
    by_camera = numeric(
        lambda d: problem.cost(BundleState(moved(state.poses, d.reshape(4, 6)), state.points, state.log_focal)), 24,
        1e-6
    )
    by_point = numeric(
        lambda d: problem.cost(BundleState(state.poses, state.points + d.reshape(10, 3), state.log_focal)), 30, 1e-4
    )
    by_focal = numeric(lambda d: problem.cost(BundleState(state.poses, state.points, state.log_focal + d[0])), 1, 1e-6)
    assert np.allclose(-2 * block.camera_rhs.ravel(), by_camera, rtol=1e-4, atol=1e-4 * np.abs(by_camera).max())
    assert np.allclose(-2 * block.point_rhs.ravel(), by_point, rtol=1e-4, atol=1e-5 * np.abs(by_point).max())
    assert -2 * block.focal_rhs == pytest.approx(by_focal[0], rel=1e-4)


def test_motion_prior_s_gradient():
    time_s = np.array([0.0, 0.1, 0.25, 0.3])
    motion = MotionPrior(time_s, 0.5, 20.0)
    poses = tiny_problem()[1].poses
    poses = moved(np.repeat(poses[:1], 4, axis=0), 0.02 * np.random.default_rng(0).normal(size=(4, 6)))
    gradient = numeric(lambda d: motion.cost(moved(poses, d.reshape(4, 6))), 24, 1e-6).reshape(4, 6)
    pulls = motion.normal_equations(poses)[1].T
    assert np.allclose(-2 * pulls, gradient, rtol=0.05, atol=0.03 * np.abs(gradient).max(0))


def test_elimination_solves_the_whole_normal_equations():
    problem, state = tiny_problem(refine_focal=True)
    block = problem.linearised(state)
    mixed = problem.coupling(state, np.tile(np.eye(3), (10, 1, 1)), block.focal_points)[:24]
    whole = np.zeros((55, 55))
    for f in range(4):
        whole[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] = block.cameras[f]
    whole[:24, 24], whole[24, 24] = block.focal_cameras.ravel(), block.focal
    for n in range(10):
        columns = slice(25 + 3 * n, 28 + 3 * n)
        whole[:24, columns] = mixed[:, 3 * n : 3 * n + 3]
        whole[24, columns] = block.focal_points[n]
        whole[columns, columns] = block.points[n]
    whole = np.triu(whole) + np.triu(whole, 1).T
    rhs = np.r_[block.camera_rhs.ravel(), block.focal_rhs, block.point_rhs.ravel()]
    dense = np.linalg.solve(whole, rhs)
    stepped = problem.step(state, problem.reduced_system(state), 0.0)
    assert stepped.log_focal - state.log_focal == pytest.approx(dense[24], rel=1e-4)
    assert np.allclose(stepped.points - state.points, dense[25:].reshape(10, 3), rtol=1e-4, atol=1e-5)
    assert np.allclose(stepped.poses, moved(state.poses, dense[:24].reshape(4, 6)), rtol=1e-5, atol=1e-6)


def test_adjustment_lands_where_scipy_lands():
    cloud, poses, observed = head_turn(frames=4, points=12, noise_px=0.5)
    tracks = Tracks(observed, np.eye(2) * 2.0 + 0.5 * np.random.default_rng(2).normal(size=(4, 12, 2, 2)))
    seen = tracks.seen & (tracks.seen.sum(0) >= 2)
    pull = np.sqrt(np.maximum(seen.sum(0), 1)) / 20.0

    def residuals(x):
        pixels = project(cloud + x[24:].reshape(12, 3), moved(poses, x[:24].reshape(4, 6)), LENS)[0]
        whitened = np.einsum("fnij,fnj->fni", tracks.whitening, pixels - observed)[seen]
        return np.r_[whitened.ravel(), (pull[:, None] * x[24:].reshape(12, 3)).ravel()]

    best = least_squares(residuals, np.zeros(60), x_scale=np.r_[np.tile([0.01] * 3 + [10.0] * 3, 4), np.ones(36)])
    solution = adjust(tracks, poses, cloud, LENS, loss_scale=NO_LOSS, prior_mm=20.0, max_iterations=200)
    cost = BundleProblem(tracks, cloud, LENS, loss_scale=NO_LOSS, prior_mm=20.0).cost(
        BundleState(solution.camera_from_points, solution.points)
    )
    assert cost == pytest.approx(2 * best.cost, rel=1e-3)
    expected = moved(poses, best.x[:24].reshape(4, 6))
    assert rotation_errors_deg(solution.camera_from_points, expected).max() < 0.02


def colmap_poses(observed, poses, points):
    """Ceres through pycolmap on the same observations, no loss, one lens that stays -> poses [F, 4, 4]."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=640, params=[1500, 1500, 320, 320], camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    seen = np.isfinite(observed[..., 0])
    place = np.cumsum(seen, axis=1) - 1
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.refine_focal_length = options.refine_extra_params = options.refine_principal_point = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.TRIVIAL
    for i, pose in enumerate(poses):
        image = pycolmap.Image(name=f"{i}", camera_id=1, image_id=i + 1)
        image.points2D = [pycolmap.Point2D(xy) for xy in observed[i, seen[i]]]
        transform = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
        reconstruction.add_image_with_trivial_frame(image, transform)
        config.add_image(i + 1)
    for j in range(len(points)):
        track = pycolmap.Track()
        for i in np.nonzero(seen[:, j])[0]:
            track.add_element(int(i) + 1, int(place[i, j]))
        reconstruction.add_point3D(points[j], track)
    config.set_constant_cam_intrinsics(1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction).solve()
    solved = [reconstruction.images[i + 1].cam_from_world() for i in range(len(poses))]
    return np.stack([rigid(pose.rotation.matrix(), pose.translation) for pose in solved])


def test_adjustment_agrees_with_ceres():
    cloud, poses, observed = head_turn(frames=8, points=60)
    start, shape = shaken(poses, cloud)
    tracks = Tracks.of_equal_noise(observed, NOISE_PX)
    ours = adjust(tracks, start, shape, LENS, loss_scale=NO_LOSS, prior_mm=1e5, max_iterations=100)
    theirs = colmap_poses(observed, start, shape)
    assert rotation_errors_deg(theirs, poses).max() < 0.1
    assert rotation_errors_deg(ours.camera_from_points, theirs).max() < 0.005


def test_focal_length_is_recovered_and_its_deviation_covers_the_error():
    cloud, poses, observed = head_turn(frames=16)
    tracks, wrong = Tracks.of_equal_noise(observed, NOISE_PX), zoomed(LENS, 1.1)
    solved = adjust(tracks, poses, cloud, wrong, loss_scale=5.0, prior_mm=100.0, refine_focal=True, max_iterations=60)
    known = pose_covariance(solved, tracks, wrong, loss_scale=5.0, with_focal=True)
    assert solved.focal_gain == pytest.approx(1 / 1.1, rel=0.02)
    assert known.log_focal < 0.02
    assert abs(np.log(solved.focal_gain * 1.1)) < 3 * known.log_focal
    held = adjust(tracks, poses, cloud, wrong, loss_scale=5.0, prior_mm=100.0, max_iterations=60)
    assert held.focal_gain == 1.0
    assert np.nanmedian(solved.error_px) < np.nanmedian(held.error_px)


def test_focal_deviation_predicts_the_scatter_of_repeated_solutions():
    cloud, poses, _ = head_turn(frames=8, points=60)
    rng = np.random.default_rng(4)
    clean = project(cloud, poses, LENS)[0]
    logs = []
    for _ in range(16):
        tracks = Tracks.of_equal_noise(clean + NOISE_PX * rng.normal(size=clean.shape), NOISE_PX)
        solved = adjust(tracks, poses, cloud, LENS, loss_scale=NO_LOSS, prior_mm=1e4, refine_focal=True)
        logs.append(np.log(solved.focal_gain))
    true = BundleSolution(poses, cloud, np.zeros_like(clean))
    predicted = pose_covariance(true, tracks, LENS, loss_scale=NO_LOSS, with_focal=True).log_focal
    assert 0.6 < np.std(logs) / predicted < 1.5


def test_covariance_predicts_the_scatter_of_repeated_solutions():
    cloud, poses, _ = head_turn()
    rng = np.random.default_rng(5)
    clean = project(cloud, poses, LENS)[0]
    turned = []
    for _ in range(20):
        tracks = Tracks.of_equal_noise(clean + NOISE_PX * rng.normal(size=clean.shape), NOISE_PX)
        solution = adjust(tracks, poses, cloud, LENS, loss_scale=NO_LOSS, prior_mm=1e4)
        turned.append(rotation_errors(solution.camera_from_points, poses))
    true = BundleSolution(poses, cloud, np.zeros_like(clean))
    predicted = pose_covariance(true, tracks, LENS, loss_scale=NO_LOSS).poses
    expected = np.sqrt(np.diagonal(predicted[:, :3, :3], axis1=1, axis2=2).mean(0))
    measured = np.sqrt(np.mean(np.square(turned), axis=(0, 1)))
    assert np.all((0.85 < measured / expected) & (measured / expected < 1.15))


def test_covariance_grows_with_the_noise_and_ignores_the_cloud_s_frame():
    cloud, poses, observed = head_turn(frames=6, points=60)
    tracks = Tracks.of_equal_noise(observed, NOISE_PX)
    solution = BundleSolution(poses, cloud, project(cloud, poses, LENS)[0] - observed)
    once = pose_covariance(solution, tracks, LENS, loss_scale=NO_LOSS).poses
    twice = pose_covariance(solution, tracks.with_noise(2.0), LENS, loss_scale=NO_LOSS).poses
    assert np.allclose(twice, 4 * once, rtol=1e-3, atol=1e-6 * np.abs(once).max())
    turn, shift = rotation_from_vector(np.array([0.3, -0.5, 0.2])), np.array([5.0, -3.0, 2.0])
    rotation = poses[:, :3, :3] @ turn.T
    turned = rigid(rotation, poses[:, :3, 3] - rotation @ shift)
    other = BundleSolution(turned, cloud @ turn.T + shift, solution.residuals_px)
    same = pose_covariance(other, tracks, LENS, loss_scale=NO_LOSS).poses
    assert np.allclose(same[:, :3, :3], once[:, :3, :3], rtol=0.05, atol=0.02 * once[:, :3, :3].max())


def test_resection_finds_poses_of_held_points():
    cloud, poses, observed = head_turn(outliers=0.05)
    observed[4, 5:] = np.nan
    observed[4, :5] = 300.0
    start, _ = shaken(poses, cloud)
    found, covariance = resect(Tracks.of_equal_noise(observed, NOISE_PX), start, cloud, LENS, loss_scale=30.0)
    found, covariance = resect(Tracks.of_equal_noise(observed, NOISE_PX), found, cloud, LENS, loss_scale=3.0)
    assert np.array_equal(found[4], start[4])
    assert np.isinf(covariance[4]).all()
    rest = np.arange(12) != 4
    error = vector_from_rotation(found[rest, :3, :3] @ np.swapaxes(poses[rest, :3, :3], 1, 2))
    assert np.degrees(np.linalg.norm(error, axis=1)).max() < 0.05
    assert np.abs(found[rest, :3, 3] - poses[rest, :3, 3]).max() < 1.0
    squared = np.einsum("fi,fij,fj->f", error, np.linalg.inv(covariance[rest, :3, :3]), error)
    assert 0.5 < np.median(squared) < 6.0


def test_points_are_placed_by_held_poses():
    cloud, poses, observed = head_turn(outliers=0.05)
    _, shape = shaken(poses, cloud)
    tracks = Tracks.of_equal_noise(observed, NOISE_PX)
    solution = place_points(tracks, poses, shape, LENS, loss_scale=3.0, prior_mm=300.0)
    assert np.array_equal(solution.camera_from_points, poses)
    error = np.linalg.norm(solution.points - cloud, axis=1)
    assert np.median(error) < 0.3 and np.median(error) < 0.1 * np.median(np.linalg.norm(shape - cloud, axis=1))
    assert np.array_equal(np.isnan(solution.error_px), np.isnan(observed[..., 0]))


def test_subset_of_tracks():
    tracks = Tracks.of_equal_noise(head_turn(frames=5, points=20)[2], NOISE_PX)
    part = tracks.subset(np.array([0, 3]), np.arange(20) % 2 == 0)
    assert part.pixels.shape == (2, 10, 2) and part.whitening.shape == (2, 10, 2, 2)
    assert np.array_equal(part.seen, tracks.seen[[0, 3]][:, ::2])
    assert part.whitening[0, 0, 0, 0] == pytest.approx(1 / NOISE_PX)
