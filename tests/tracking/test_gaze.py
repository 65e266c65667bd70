"""Gaze from the irises' centres, on eyes that look where they are told to."""

import numpy as np
import pytest
from shapes import nods

from shared.geometry.eyeballs import Eyeball, gaze_direction, gaze_rotation, gaze_towards
from shared.geometry.transforms import WORLD_FROM_CAMERA, camera_centres, project, rigid, rotation_from_vector
from shared.tracking.gaze import _direction_slope, iris_distance, iris_radius, solve_gaze

FRAMES, DISTANCE_MM, FOCAL_PX = 90, 900.0, 1700.0
INTRINSICS = np.array([[FOCAL_PX, 0.0, 320.0], [0.0, FOCAL_PX, 320.0], [0.0, 0.0, 1.0]])
CENTRES = np.array([[-31.0, 32.0, 71.0], [31.5, 32.5, 70.5]])
RADIUS_MM, IRIS_MM = 5.85, 13.8
TIME = np.arange(FRAMES) / 15.0


def turning(degrees: float = 25.0) -> np.ndarray:
    """Poses [F, 4, 4] of a head that turns to both sides and nods."""
    phase = np.linspace(0.0, 2.0 * np.pi, FRAMES)
    turn = np.stack([0.3 * np.sin(2 * phase), np.sin(phase), 0 * phase], axis=-1) * np.radians(degrees)
    rotation = WORLD_FROM_CAMERA.T @ rotation_from_vector(turn)
    return rigid(rotation, np.broadcast_to([0.0, 20.0, DISTANCE_MM], (FRAMES, 3)))


def seen(gaze: np.ndarray, poses: np.ndarray, noise_px: float = 0.0, seed: int = 3) -> np.ndarray:
    """Irises [F, 2, 5, 2] px of eyes with gaze [F, 2, 2]."""
    spokes = RADIUS_MM * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)
    pixels = np.zeros((FRAMES, 2, 5, 2))
    for f, pose in enumerate(poses):
        for eye in range(2):
            disc = CENTRES[eye] + (spokes + (0, 0, IRIS_MM)) @ gaze_rotation(gaze[f, eye]).T
            pixels[f, eye] = project(disc, pose, INTRINSICS)[0]
    pixels[:, 1, [1, 3]] = pixels[:, 1, [3, 1]]
    return pixels + noise_px * np.random.default_rng(seed).standard_normal((FRAMES, 2, 1, 2))


def towards_camera(poses: np.ndarray) -> np.ndarray:
    return gaze_towards(camera_centres(poses)[:, None] - CENTRES)


def jumping() -> np.ndarray:
    """[F, 2, 2]: both eyes rest on one place after another, and jump in between."""
    looks = np.radians([[0, 0], [14, -4], [-9, 3], [20, 6], [2, -10], [-16, 0]])
    return looks[np.arange(FRAMES) // 15][:, None] + [[0.03, 0.0], [-0.03, 0.0]]


def solved(gaze, poses, noise_px=0.3, centres=CENTRES, counts=None):
    counts = np.ones((FRAMES, 2), bool) if counts is None else counts
    return solve_gaze(seen(gaze, poses, noise_px), counts, centres, IRIS_MM, poses, INTRINSICS, TIME)


def error_deg(found, gaze: np.ndarray) -> np.ndarray:
    angle = np.arccos(np.clip((gaze_direction(found.gaze) * gaze_direction(gaze)).sum(-1), -1.0, 1.0))
    return np.degrees(angle)


def test_the_slope_of_a_direction_is_its_difference():
    gaze, step = np.array([[0.3, -0.2], [-0.5, 0.1]]), 1e-6
    for axis in range(2):
        moved = (gaze_direction(gaze + step * np.eye(2)[axis]) - gaze_direction(gaze - step * np.eye(2)[axis])) / 2e-6
        assert np.allclose(_direction_slope(gaze)[..., axis], moved, atol=1e-8)


class TestKinds:
    def test_a_gaze_on_the_camera_is_found_and_corrects_the_centres(self):
        poses = turning()
        off = np.array([[0.9, -0.6, 1.0], [-0.5, 0.8, -1.0]])
        gaze = towards_camera(poses)
        found = solved(gaze, poses, centres=CENTRES + off)
        assert found.kind == "camera" and np.nanmean(error_deg(found, gaze)) < 1.5
        assert np.abs(found.centres - CENTRES)[:, :2].max() < 0.5 < np.abs(off)[:, :2].max()

    def test_eyeballs_that_begin_too_high_still_look_into_the_camera(self):
        """By a little more than fitted heads are off (1.9 mm at most on ten): the gaze is not turned down to a place
        below the lens."""
        poses = turning()
        gaze = towards_camera(poses)
        found = solved(gaze, poses, centres=CENTRES + [0.3, 2.2, 0.5])
        assert found.kind == "camera" and np.nanmean(error_deg(found, gaze)) < 2.0

    def test_a_place_beside_the_camera_is_one_of_its_own(self):
        poses = turning()
        gaze = towards_camera(poses) + np.radians([9.0, -6.0])
        found = solved(gaze, poses)
        assert found.kind == "place" and np.nanmean(error_deg(found, gaze)) < 2.5

    def test_a_gaze_fixed_in_the_head_is_told_from_one_on_the_camera(self):
        poses, gaze = turning(), np.full((FRAMES, 2, 2), (0.1, -0.05))
        found = solved(gaze, poses)
        assert found.kind == "head" and np.nanmean(error_deg(found, gaze)) < 2.5
        assert np.nanmean(np.square((found.gaze - gaze) / found.sigma)) < 1.0

    def test_a_gaze_that_jumps_is_wandering_and_its_jumps_stay(self):
        poses, gaze = turning(8.0), jumping()
        found = solved(gaze, poses)
        assert found.kind == "wandering"
        course, truth = found.gaze.mean(1)[:, 0], gaze.mean(1)[:, 0]
        course = course - np.median(course - truth)
        assert np.degrees(np.abs(course - truth)).max() < 1.5, "a smoothed jump would be off by half of it"
        assert np.degrees(np.std((course - truth)[1:14])) < 0.4, "noise of 0.3 px is a degree"


def test_deviations_say_how_far_off_it_is():
    """Over heads whose centres lie as far off as they may: errors over their deviations have a deviation near 1."""
    poses, ratio = turning(), []
    gaze = towards_camera(poses)
    for seed in range(12):
        off = np.random.default_rng(seed).standard_normal((2, 3)) * (1.2, 1.2, 1.5)
        counts = np.ones((FRAMES, 2), bool)
        iris_px = seen(gaze, poses, 0.3, seed)
        found = solve_gaze(iris_px, counts, CENTRES + off, IRIS_MM, poses, INTRINSICS, TIME)
        ratio.append(((found.gaze - gaze) / found.sigma)[::15])
    assert 0.3 < np.sqrt(np.mean(np.square(ratio))) < 1.3


def test_a_shut_eye_has_no_gaze_and_pulls_nothing():
    poses = turning()
    gaze = towards_camera(poses)
    counts = np.ones((FRAMES, 2), bool)
    counts[30:36] = False
    iris = seen(gaze, poses, 0.2)
    blinked = iris.copy()
    blinked[30:36] += (0.0, 40.0)
    found, other = (solve_gaze(points, counts, CENTRES, IRIS_MM, poses, INTRINSICS, TIME) for points in (iris, blinked))
    assert np.isnan(found.gaze[30:36]).all() and np.isnan(found.sigma[30:36]).all()
    assert np.isfinite(found.gaze[counts]).all()
    assert np.array_equal(found.gaze, other.gaze, equal_nan=True)


def test_an_iris_whose_rim_disagrees_says_less():
    poses = turning()
    gaze = towards_camera(poses)
    iris = seen(gaze, poses, 0.2)
    iris[40, 0, [1, 3]] += (0.0, 6.0)
    found = solve_gaze(iris, np.ones((FRAMES, 2), bool), CENTRES, IRIS_MM, poses, INTRINSICS, TIME)
    assert found.sigma[40, 0, 1] > found.sigma[38, 0, 1]


def test_the_radius_of_the_iris_is_measured_from_any_side():
    poses, gaze = nods(35.0 * np.sin(np.linspace(0.0, 2.0 * np.pi, FRAMES))), np.zeros((FRAMES, 2, 2))
    counts = np.ones((FRAMES, 2), bool)
    radius, sigma = iris_radius(seen(gaze, poses), counts, gaze, CENTRES, IRIS_MM, poses, INTRINSICS)
    assert radius == pytest.approx(RADIUS_MM, rel=0.005) and 0.02 < sigma / radius < 0.06


def test_too_few_eyes_are_none():
    poses = turning()
    counts = np.zeros((FRAMES, 2), bool)
    counts[:3] = True
    assert solved(towards_camera(poses), poses, counts=counts) is None


def test_the_iris_lies_where_its_rim_cuts_the_eyeball():
    eyeball = Eyeball(np.zeros(0, int), np.zeros(0, int), np.zeros(3), 15.0)
    assert np.hypot(iris_distance([eyeball, eyeball]), RADIUS_MM) == pytest.approx(15.0)
