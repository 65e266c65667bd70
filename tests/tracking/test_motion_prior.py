"""The motion prior on turns that are known: less jitter, no lag, and room for a true jerk."""

import numpy as np
import pytest
from shapes import FACING, turned

from shared.geometry.transforms import project, rigid, rotation_from_vector, vector_from_rotation
from shared.tracking.bundle import BundleSolution, Tracks, adjust, pose_covariance
from shared.tracking.motion_prior import LEAST_FRAMES, MotionPrior, motion_prior_of

LENS = np.array([[1500.0, 0, 320], [0, 1500.0, 320], [0, 0, 1]])
TIME_S = np.linspace(0.0, 4.0, 48)


def cloud():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, size=(40, 3)) * [60, 80, 10]
    points[:, 2] += 50 - points[:, 0] ** 2 / 80
    return points


def poses_of(yaw):
    """[F] rad -> [F, 4, 4]"""
    return turned(np.stack([0 * yaw, yaw, 0 * yaw], axis=1), (0.0, 0.0, 950.0))


def yaw_of(poses):
    """[F, 4, 4] -> [F] rad; the mean is taken off, since a common turn of the cloud is free."""
    yaw = vector_from_rotation(FACING @ poses[:, :3, :3])[:, 1]
    return yaw - yaw.mean()


def solve(yaw, noise_px, motion):
    """The yaw that an adjustment finds for noisy tracks of this turn."""
    rng = np.random.default_rng(1)
    points, poses = cloud(), poses_of(yaw)
    pixels = project(points, poses, LENS)[0] + noise_px * rng.normal(size=(len(yaw), len(points), 2))
    tracks = Tracks.of_equal_noise(pixels, noise_px)
    return yaw_of(adjust(tracks, poses, points, LENS, loss_scale=5.0, prior_mm=30.0, motion=motion).camera_from_points)


def centred(yaw):
    return yaw - yaw.mean()


def test_constant_velocity_has_no_acceleration_for_uneven_steps():
    time_s = np.array([0.0, 0.04, 0.1, 0.11, 0.3, 0.35, 0.5])
    poses = poses_of(0.4 * time_s)
    poses[:, :3, 3] += time_s[:, None] * [10.0, -5.0, 30.0]
    prior = MotionPrior(time_s, 1.0, 1.0)
    assert np.abs(prior.acceleration(poses)).max() < 1e-9
    assert np.abs(prior.operator() @ time_s).max() < 1e-9
    assert prior.cost(poses) < 1e-15


def test_constant_acceleration_is_measured_for_uneven_steps():
    time_s = np.array([0.0, 0.04, 0.1, 0.11, 0.3, 0.35, 0.5])
    poses = poses_of(0.5 * 0.8 * time_s**2)
    poses[:, 2, 3] += 0.5 * 60.0 * time_s**2
    acceleration = MotionPrior(time_s, 1.0, 1.0).acceleration(poses)
    assert np.allclose(np.linalg.norm(acceleration[:, :3], axis=1), 0.8)
    assert np.allclose(acceleration[:, 5], 60.0)
    assert np.allclose(MotionPrior(time_s, 1.0, 1.0).operator() @ time_s**2, 2.0)


def test_prior_takes_jitter_and_does_not_lag():
    true = np.radians(25) * np.sin(2 * np.pi * TIME_S / 4.0)
    motion = motion_prior_of(poses_of(true), TIME_S)
    free, smooth = solve(true, 2.0, None), solve(true, 2.0, motion)
    jitter = [np.diff(yaw - centred(true), 2).std() for yaw in (free, smooth)]
    assert jitter[1] < 0.5 * jitter[0]
    error = [np.abs(yaw - centred(true)).std() for yaw in (free, smooth)]
    assert error[1] < error[0]
    speed = np.gradient(centred(true), TIME_S)
    lag_s = -(speed @ (smooth - centred(true))) / (speed @ speed)
    assert abs(lag_s) < 0.1 * (TIME_S[1] - TIME_S[0])
    ends = [true.argmax(), true.argmin()]
    assert np.degrees(np.abs(smooth - centred(true))[ends]).max() < 0.25


def test_single_jerk_survives():
    true = np.where(TIME_S < 2.0, -np.radians(4), np.radians(4)) + 0.05 * np.sin(TIME_S)
    motion = MotionPrior(TIME_S, 0.1, 5.0)
    smooth = solve(true, 0.3, motion)
    jump = np.searchsorted(TIME_S, 2.0)
    assert np.degrees(smooth[jump] - smooth[jump - 1]) == pytest.approx(8.0, abs=0.6)
    assert np.degrees(np.abs(smooth - centred(true))).max() < 0.5


def test_prior_is_counted_in_the_covariance():
    points, poses = cloud(), poses_of(np.radians(25) * np.sin(2 * np.pi * TIME_S / 4.0))
    pixels = project(points, poses, LENS)[0]
    tracks = Tracks.of_equal_noise(pixels, 2.0)
    solution, motion = BundleSolution(poses, points, 0 * pixels), MotionPrior(TIME_S, 1.0, 100.0)
    free = pose_covariance(solution, tracks, LENS, loss_scale=5.0).poses
    held = pose_covariance(solution, tracks, LENS, loss_scale=5.0, motion=motion).poses
    inner = slice(4, -4)
    assert np.all(np.trace(held[inner], axis1=1, axis2=2) < np.trace(free[inner], axis1=1, axis2=2))
    assert np.median(held[inner, 1, 1] / free[inner, 1, 1]) < 0.7


def test_prior_follows_the_clip_s_own_accelerations():
    rng = np.random.default_rng(3)
    turn = np.sin(2 * np.pi * TIME_S[:, None] / 4.0 + [0.0, 1.0, 2.0])
    slow, fast = (rigid(rotation_from_vector(size * turn), 300 * size * turn) for size in (0.05, 0.2))
    first, second = motion_prior_of(slow, TIME_S), motion_prior_of(fast, TIME_S)
    assert first.deviation.shape == (6,)
    assert second.rotation == pytest.approx(4 * first.rotation, rel=0.1)
    assert second.translation == pytest.approx(4 * first.translation, rel=1e-6)
    slow[:, :3, 3] += rng.normal(size=(len(TIME_S), 3))
    assert motion_prior_of(slow, TIME_S).translation > 5 * first.translation
    still = motion_prior_of(poses_of(0 * TIME_S), TIME_S)
    assert still.rotation > 0 and still.translation > 0


def test_few_frames_have_no_prior():
    poses = poses_of(0.1 * np.sin(TIME_S))
    assert motion_prior_of(poses[: LEAST_FRAMES - 1], TIME_S[: LEAST_FRAMES - 1]) is None
    assert motion_prior_of(poses[:LEAST_FRAMES], TIME_S[:LEAST_FRAMES]) is not None
