"""Rigid bundle adjustment against clouds whose poses are known."""

import numpy as np
import pytest

from shared.bundle import BundleSolution, adjust, pose_covariance, pose_from_points
from shared.geometry import project, rigid, rotation_from_vector, similarity_from_points, vector_from_rotation

LENS = np.array([[1500.0, 0, 320], [0, 1500.0, 320], [0, 0, 1]])
SIZE = (640, 640)


def head_turn(frames=12, points=150, noise_px=0.1, outliers=0.0, seed=0):
    """A cloud shaped like a face, turned +-25 degrees before the lens -> points, poses, observations."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform(-1, 1, size=(points, 3)) * [60, 80, 10]
    cloud[:, 2] += 50 - cloud[:, 0] ** 2 / 80 - cloud[:, 1] ** 2 / 160
    angle = np.sin(np.linspace(0, 2 * np.pi, frames))
    vectors = np.stack([0.15 * angle[::-1], np.radians(25) * angle, 0.02 * angle], axis=1)
    rotation = np.diag([1.0, -1, -1]) @ rotation_from_vector(vectors)
    poses = rigid(rotation, np.array([0, 0, 950.0]) + rng.normal(size=(frames, 3)) * 3)
    observed = project(cloud, poses, LENS)[0] + noise_px * rng.normal(size=(frames, points, 2))
    wrong = rng.random((frames, points)) < outliers
    observed[wrong] += rng.normal(size=(wrong.sum(), 2)) * 20
    observed[rng.random((frames, points)) < 0.3] = np.nan
    return cloud, poses, observed


def rotation_errors_deg(found, true):
    """Angle of each frame's error after the best common rotation."""
    u, _, vt = np.linalg.svd(np.einsum("fji,fjk->ik", found[:, :3, :3], true[:, :3, :3]))
    common = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    error = np.einsum("fij,jk,flk->fil", found[:, :3, :3], common, true[:, :3, :3])
    return np.degrees(np.linalg.norm(vector_from_rotation(error), axis=1))


def test_pose_from_points_survives_outliers():
    cloud, poses, observed = head_turn(outliers=0.2)
    seen = np.isfinite(observed[3, :, 0])
    found = pose_from_points(cloud[seen], observed[3, seen], LENS, SIZE, 3.0)
    assert np.abs(found[:3, 3] - poses[3, :3, 3]).max() < 3.0
    assert np.abs(found[:3, :3] - poses[3, :3, :3]).max() < 2e-3


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_adjustment_recovers_poses_and_shape(outliers):
    cloud, poses, observed = head_turn(outliers=outliers)
    rng = np.random.default_rng(1)
    start = rigid(rotation_from_vector(0.03 * rng.normal(size=(12, 3))) @ poses[:, :3, :3], poses[:, :3, 3])
    shape = cloud + 3 * rng.normal(size=cloud.shape)
    solution = adjust(observed, start, shape, LENS, SIZE, loss_scale_px=0.3, prior_mm=30.0)
    assert rotation_errors_deg(solution.camera_from_points, poses).max() < 0.06
    scale, rotation, shift = similarity_from_points(solution.points, cloud)
    assert np.median(np.linalg.norm(scale * solution.points @ rotation.T + shift - cloud, axis=1)) < 0.4
    assert np.isnan(solution.error_px).sum() == np.isnan(observed[..., 0]).sum()
    assert np.nanmedian(solution.error_px) < 0.2


def test_adjustment_is_deterministic():
    cloud, poses, observed = head_turn(frames=6, points=60)
    first, second = (adjust(observed, poses, cloud, LENS, SIZE, loss_scale_px=0.3, prior_mm=5.0) for _ in range(2))
    assert np.array_equal(first.camera_from_points, second.camera_from_points)
    assert np.array_equal(first.points, second.points)


def test_covariance_predicts_the_scatter_of_repeated_solutions():
    cloud, poses, _ = head_turn()
    rng = np.random.default_rng(5)
    clean = project(cloud, poses, LENS)[0]
    turned = []
    for _ in range(12):
        noisy = clean + 0.1 * rng.normal(size=clean.shape)
        solution = adjust(noisy, poses, cloud, LENS, SIZE, loss_scale_px=10.0, prior_mm=1000.0)
        turned.append(rotation_errors_deg(solution.camera_from_points, poses))
    predicted = pose_covariance(BundleSolution(poses, cloud, noisy - clean), LENS) / 8.0
    expected = np.degrees(np.sqrt(np.trace(predicted[:, :3, :3], axis1=1, axis2=2).mean()))
    measured = np.sqrt(np.mean(np.square(turned)))
    assert 0.5 < measured / expected < 1.5
