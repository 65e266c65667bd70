"""Measures of re-renders and poses on data whose answer is known."""

import numpy as np
import pytest

from shared.geometry.transforms import rigid, rotation_from_vector
from shared.imaging.color import decode_srgb
from tools.scoring.held_out import (
    HeldOutFrame,
    pose_acceleration,
    region_errors,
    structural_similarity,
)


def frame(picture, error, regions):
    picture = np.broadcast_to(np.float64(picture)[..., None], (*np.shape(picture), 3))
    return HeldOutFrame(0, picture, picture + np.float64(error)[..., None], regions)


def test_errors_are_those_of_the_region_alone():
    """An error of 0.1 is 20 dB; beside the region it is five times as large and does not count."""
    region = np.zeros((32, 40), bool)
    region[4:20, 4:20] = True
    found = region_errors([frame(np.full(region.shape, 0.3), np.where(region, 0.1, 0.5), {"skin": region})])
    assert found["skin"]["db"] == pytest.approx(20.0) and found["skin"]["pixels"] == region.sum()
    codes = found["skin"]["srgb_db"]
    assert decode_srgb(np.array(10 ** (-codes / 20) + 0.5838)) == pytest.approx(0.4, abs=1e-3)  # 0.5838: code of 0.3


def test_frames_count_by_how_much_of_a_region_they_show():
    """Three pixels off by 0.1 and one by 0.3: the mean square is 0.03."""
    sure = np.zeros((2, 4), bool)
    sure[0, :3] = True
    other = np.zeros((2, 4), bool)
    other[1, 3] = True
    grey = np.full((2, 4), 0.2)
    frames = [frame(grey, np.full((2, 4), 0.1), {"skin": sure}), frame(grey, np.full((2, 4), 0.3), {"skin": other})]
    found = region_errors(frames)
    assert found["skin"]["db"] == pytest.approx(-10 * np.log10(0.03)) and found["skin"]["pixels"] == 4


def test_a_region_that_no_frame_shows_has_no_errors():
    nothing = np.zeros((4, 4), bool)
    assert region_errors([frame(np.full((4, 4), 0.2), np.zeros((4, 4)), {"lips": nothing})]) == {}


def test_structural_similarity_in_closed_form():
    """Of a picture with itself 1; of two even pictures the term of the level alone; of stripes and their negative,
    whose covariance is minus the variance, about -1."""
    stripes = np.tile(np.float64([0.25, 0.75]), (64, 32))
    assert structural_similarity(stripes, stripes) == pytest.approx(1.0)
    even = structural_similarity(np.full((30, 30), 0.4), np.full((30, 30), 0.6))
    assert even == pytest.approx((2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4))
    assert structural_similarity(stripes, 1.0 - stripes)[20:-20, 20:-20].max() < -0.95


def test_half_the_contrast_is_less_alike_the_finer_it_is_to_see():
    random = np.random.default_rng(0).uniform(0.3, 0.7, (64, 64))
    likeness = [structural_similarity(random, 0.5 + share * (random - 0.5)).mean() for share in (0.9, 0.5, 0.1)]
    assert likeness == sorted(likeness, reverse=True) and likeness[0] > 0.95 and likeness[2] < 0.5


def poses_of(yaw_deg, depth_mm):
    vectors = np.zeros((len(yaw_deg), 3))
    vectors[:, 1] = np.radians(yaw_deg)
    places = np.zeros((len(yaw_deg), 3))
    places[:, 2] = depth_mm
    return rigid(rotation_from_vector(vectors), places)


def test_an_even_turn_does_not_tremble():
    found = pose_acceleration(poses_of(np.arange(20) * 1.5, 700.0 + 2.0 * np.arange(20)), np.arange(0, 60, 3))
    assert found == pytest.approx({"deg": 0.0, "across_mm": 0.0, "depth_mm": 0.0}, abs=1e-6)


def test_trembling_poses_and_one_outlier():
    """Every other pose 0.2 degrees and 0.3 mm off: second differences of 0.4 and 0.6, over a spacing of two frames a
    quarter of that. One pose that is 30 degrees off moves no median."""
    odd = np.arange(41) % 2
    yaw = np.arange(41) * 1.5 + 0.2 * odd
    yaw[17] += 30.0
    found = pose_acceleration(poses_of(yaw, 700.0 + 0.3 * odd), np.arange(0, 82, 2))
    assert found["deg"] == pytest.approx(0.1, rel=1e-3)
    assert found["depth_mm"] == pytest.approx(0.15, rel=1e-3) and found["across_mm"] == 0.0


def test_uneven_frames_say_nothing_of_trembling():
    found = pose_acceleration(poses_of(np.arange(4.0), np.full(4, 700.0)), np.array([0, 1, 3, 8]))
    assert np.isnan(list(found.values())).all()
