"""The covariance of poses, against synthetic tracks whose true poses are known."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shapes import turned

from shared.geometry.transforms import project, rotation_from_vector
from shared.tracking.bundle import BundleSolution, Tracks, adjust, zoomed
from shared.tracking.first_poses import LOSS, Adjusted
from shared.tracking.focal_search import farther
from shared.tracking.pose_uncertainty import (
    FOCAL_DEVIATIONS,
    SHARED_ERRORS,
    estimate_uncertainty,
    focal_elsewhere,
    noise_factor,
    rotations_apart,
)
from shared.tracking.tracked_clip import TrackedClip

LENS = np.array([[1500.0, 0, 320], [0, 1500.0, 320], [0, 0, 1]])
NOISE_PX = 0.1
FRAMES, POINTS, PRIOR_MM = 20, 300, 30.0
CHI_SQUARED_90_3 = 6.25


def face():
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-1, 1, size=(POINTS, 3)) * [60, 80, 4]
    cloud[:, 2] += 50 - cloud[:, 0] ** 2 / 80 - cloud[:, 1] ** 2 / 160
    return cloud


def turn():
    angle = np.sin(np.linspace(0, 2 * np.pi, FRAMES))
    vectors = np.stack([0.15 * angle[::-1], np.radians(25) * angle, 0.02 * angle], axis=1)
    return turned(vectors, (0.0, 0.0, 950.0))


def noise(cloud, shared_mm, seed):
    """[F, N, 2] of NOISE_PX; with shared_mm, tracks nearer to each other than that err alike."""
    rng = np.random.default_rng(seed)
    raw = rng.normal(size=(FRAMES, POINTS, 2))
    if shared_mm:
        near = cKDTree(cloud).query_ball_point(cloud, shared_mm)
        raw = np.stack([raw[:, members].mean(1) * np.sqrt(len(members)) for members in near], axis=1)
    return NOISE_PX * raw


def solved(shared_mm=0.0, seed=0, lens=LENS):
    """Tracks of the turning face and their bundle adjustment -> tracks, solution."""
    cloud, poses = face(), turn()
    tracks = Tracks.of_equal_noise(project(cloud, poses, LENS)[0] + noise(cloud, shared_mm, seed), NOISE_PX)
    return tracks, adjust(tracks, poses, cloud, lens, loss_scale=LOSS, prior_mm=PRIOR_MM)


def clip_of(lens=LENS, hold_poses=False):
    """A clip of which only lens and times matter."""
    return TrackedClip([], [], [], np.zeros((FRAMES, 468, 2)), np.arange(FRAMES) / 15.0, lens, (640, 640),
                       hold_poses=hold_poses)


def all_reliable(tracks, solution):
    return Adjusted(solution, tracks, np.ones(FRAMES, bool))


def test_independent_noise_is_what_the_tracks_say():
    tracks, solution = solved()
    assert 1.0 <= noise_factor(tracks, solution, LENS, PRIOR_MM) < 1.3


def test_errors_that_neighbours_share_raise_the_noise():
    alone, little, much = (noise_factor(*solved(mm), LENS, PRIOR_MM) for mm in (0.0, 12.0, 25.0))
    assert alone < little < much
    assert much > 2.0


def test_few_tracks_leave_the_noise_as_it_is():
    tracks, solution = solved(25.0)
    few = np.arange(POINTS) < 12
    part = BundleSolution(solution.camera_from_points, solution.points[few], solution.residuals_px[:, few])
    assert noise_factor(tracks.subset(points=few), part, LENS, PRIOR_MM) == 1.0


def test_rotations_apart_ignores_a_common_turn():
    rotations = turn()[:, :3, :3]
    common = rotation_from_vector(np.array([0.4, -0.3, 0.9]))
    assert np.abs(rotations_apart(rotations, rotations @ common)).max() < 1e-9


def test_rotations_apart_in_camera_axes():
    rotations = turn()[:, :3, :3]
    vectors = 0.01 * np.random.default_rng(0).normal(size=(FRAMES, 3))
    vectors -= vectors.mean(0)
    apart = rotations_apart(rotation_from_vector(vectors) @ rotations, rotations @ rotation_from_vector(np.ones(3)))
    assert np.abs(apart - vectors).max() < 0.2 * np.abs(vectors).max()
    one = np.zeros((FRAMES, 3))
    one[4] = [0.0, 0.02, 0.0]
    apart = rotations_apart(rotation_from_vector(one) @ rotations, rotations)
    assert np.allclose(apart[4], [0.0, 0.02 * (1 - 1 / FRAMES), 0.0], atol=3e-4)


@pytest.mark.parametrize("shared_mm", [0.0, 12.0])
def test_covariance_covers_the_true_errors(shared_mm):
    tracks, solution = solved(shared_mm, seed=3)
    estimated = estimate_uncertainty(clip_of(), all_reliable(tracks, solution), PRIOR_MM, estimate_focal=False)
    error = rotations_apart(estimated.adjusted.solution.camera_from_points[:, :3, :3], turn()[:, :3, :3])
    inverse = np.linalg.inv(estimated.covariance[:, :3, :3])
    distance = np.einsum("fi,fij,fj->f", error, inverse, error)
    assert (distance < CHI_SQUARED_90_3).mean() >= 0.8
    assert np.median(distance) > 0.2  # nor are they promised to be far worse than they are
    assert estimated.noise_factor >= SHARED_ERRORS and not estimated.focal_solved


def test_frames_that_are_not_reliable_have_no_covariance():
    tracks, solution = solved()
    reliable = np.arange(FRAMES) != 5
    poses = np.array(solution.camera_from_points)
    poses[5] = poses[0]
    lost = BundleSolution(poses, solution.points, solution.residuals_px)
    estimated = estimate_uncertainty(clip_of(), Adjusted(lost, tracks, reliable), PRIOR_MM, estimate_focal=False)
    assert np.isnan(estimated.covariance[5]).all() and np.isfinite(estimated.covariance[reliable]).all()
    assert np.linalg.eigvalsh(estimated.covariance[reliable]).min() > -1e-12
    assert np.array_equal(estimated.adjusted.solution.camera_from_points[5], poses[5])
    assert np.isnan(estimated.adjusted.solution.error_px[5]).all()


def test_guessed_focal_length_is_solved_and_a_given_one_only_checked():
    wrong = zoomed(LENS, 1.06)
    tracks, solution = solved(lens=wrong)
    last = all_reliable(tracks, solution)
    guessed = estimate_uncertainty(clip_of(wrong), last, PRIOR_MM, estimate_focal=True)
    given = estimate_uncertainty(clip_of(wrong), last, PRIOR_MM, estimate_focal=False)
    assert guessed.focal_solved and not given.focal_solved
    assert guessed.focal_gain == given.focal_gain == pytest.approx(1 / 1.06, rel=0.02)
    assert abs(np.log(guessed.focal_gain * 1.06)) < 3 * guessed.focal_deviation
    assert guessed.adjusted.solution.focal_gain == guessed.focal_gain
    assert given.adjusted.solution.focal_gain == 1.0


@pytest.mark.parametrize("wrong", [1 / 3, 0.5, 0.62, 2.0, 3.0])
def test_focal_length_is_found_however_wrong_the_given_one_is(wrong):
    """What head and poses become under the wrong lens, points nearly free to follow it."""
    cloud, poses, lens = face(), turn(), zoomed(LENS, wrong)
    tracks = Tracks.of_equal_noise(project(cloud, poses, LENS)[0] + noise(cloud, 12.0, 5), NOISE_PX)
    start = farther(poses, cloud, wrong)
    solution = adjust(tracks, start, cloud, lens, loss_scale=LOSS, prior_mm=1000.0, max_iterations=100)
    last = all_reliable(tracks, solution)
    elsewhere = focal_elsewhere(clip_of(lens), last)
    estimated = estimate_uncertainty(clip_of(lens), last, 10.0, False, elsewhere)
    assert abs(np.log(estimated.focal_gain * wrong)) < 0.15
    assert abs(np.log(estimated.focal_gain)) > FOCAL_DEVIATIONS * estimated.focal_deviation  # so that a warning says it


@pytest.mark.parametrize("prior_mm", [10.0, 30.0])
def test_right_focal_length_is_left_alone(prior_mm):
    tracks, solution = solved(12.0, seed=4)
    last = all_reliable(tracks, solution)
    assert focal_elsewhere(clip_of(), last) is None
    estimated = estimate_uncertainty(clip_of(), last, prior_mm, estimate_focal=False)
    assert abs(np.log(estimated.focal_gain)) < 3 * estimated.focal_deviation


def test_held_poses_stay():
    tracks, solution = solved()
    held = BundleSolution(turn(), solution.points, solution.residuals_px)
    estimated = estimate_uncertainty(clip_of(hold_poses=True), all_reliable(tracks, held), PRIOR_MM,
                                     estimate_focal=True)
    assert np.array_equal(estimated.adjusted.solution.camera_from_points, turn())
    assert not estimated.focal_solved and np.isfinite(estimated.covariance).all()
    off, known = estimated.held_off
    assert off < 3 * known < np.radians(0.3)


def test_held_poses_that_the_tracks_contradict_are_uncertain_by_as_much():
    tracks, solution = solved()
    errors = np.radians(1.0) * np.sin(np.arange(FRAMES))[:, None] * [0.6, 0.8, 0.0]
    wrong = np.array(turn())
    wrong[:, :3, :3] = wrong[:, :3, :3] @ rotation_from_vector(errors)
    held = all_reliable(tracks, BundleSolution(wrong, solution.points, solution.residuals_px))
    estimated = estimate_uncertainty(clip_of(hold_poses=True), held, PRIOR_MM, estimate_focal=False)
    off, known = estimated.held_off
    assert off == pytest.approx(np.sqrt((errors**2).sum(1).mean()), rel=0.15) and off > 3 * known
    deviation = np.sqrt(np.trace(estimated.covariance[:, :3, :3], axis1=1, axis2=2))
    assert np.corrcoef(deviation, np.linalg.norm(errors, axis=1))[0, 1] > 0.9
    assert estimate_uncertainty(clip_of(), held, PRIOR_MM, estimate_focal=False).held_off is None
