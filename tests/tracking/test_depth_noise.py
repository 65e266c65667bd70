"""The depth noise of tracks against what was put into them."""

import numpy as np
import pytest
from shapes import nods

from shared.geometry.transforms import projection_slope
from shared.tracking.bundle import BundleSolution
from shared.tracking.depth_noise import depth_noise

LENS = np.array([[2000.0, 0, 500], [0, 2000.0, 500], [0, 0, 1]])
NOISE_PX = 0.2


def head(half_angle_deg, count=900, frames=40):
    """Points on a dome of 160 mm across and poses that turn it."""
    rng = np.random.default_rng(0)
    across = rng.uniform(-60.0, 60.0, (count, 2))
    points = np.column_stack([across, np.sqrt(100.0**2 - (across**2).sum(1))])
    return points, nods(np.linspace(-half_angle_deg, half_angle_deg, frames), distance=800.0)


def triangulated(points, poses, error_px):
    """Residuals [F, N, 2] that errors [F, N, 2] leave once each point has moved to fit them best, and the moves."""
    slope = np.stack([projection_slope(points, pose, LENS) for pose in poses])
    normal = np.einsum("fnia,fnib->nab", slope, slope)
    move = np.linalg.solve(normal, np.einsum("fnia,fni->na", slope, error_px)[..., None])[..., 0]
    return np.einsum("fnia,na->fni", slope, move) - error_px, move


@pytest.mark.parametrize("half_angle_deg", (5.0, 25.0))
def test_independent_errors_are_measured_and_points_count_for_themselves(half_angle_deg):
    points, poses = head(half_angle_deg)
    error = NOISE_PX * np.random.default_rng(1).normal(size=(len(poses), len(points), 2))
    residual, move = triangulated(points, poses, error)
    noise = depth_noise(BundleSolution(poses, points, residual), np.ones(len(poses), bool), LENS)
    in_depth = np.std(move[:, 2])
    assert noise.single == pytest.approx(in_depth, rel=0.15)  # robust weights take a tenth
    assert np.median(noise.sigma) == pytest.approx(noise.single, rel=0.25)


def test_errors_that_neighbours_share_count_more():
    points, poses = head(10.0)
    rng = np.random.default_rng(2)
    cell = np.unique(np.floor(points[:, :2] / 12.0), axis=0, return_inverse=True)[1].ravel()
    profile = np.linspace(-1.0, 1.0, len(poses))[:, None, None]
    shared = profile * rng.normal(size=(1, cell.max() + 1, 2))[:, cell] * 0.3
    residual, move = triangulated(points, poses, shared)
    noise = depth_noise(BundleSolution(poses, points, residual), np.ones(len(poses), bool), LENS)
    assert noise.single == pytest.approx(np.std(move[:, 2]), rel=0.3)
    assert np.median(noise.sigma) > 1.5 * noise.single


def test_frames_that_are_not_reliable_do_not_count():
    points, poses = head(15.0)
    error = NOISE_PX * np.random.default_rng(3).normal(size=(len(poses), len(points), 2))
    residual, _ = triangulated(points, poses, error)
    spoilt = np.concatenate([residual, residual[:1] + 500.0])
    reliable = np.arange(len(spoilt)) < len(poses)
    clean = depth_noise(BundleSolution(poses, points, residual), reliable[:-1], LENS)
    found = depth_noise(BundleSolution(poses[[*range(len(poses)), 0]], points, spoilt), reliable, LENS)
    assert found.single == clean.single and np.array_equal(found.sigma, clean.sigma)
