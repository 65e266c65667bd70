"""The round profile of an eyeball's albedo."""

import numpy as np
import pytest

from shared.appearance.eye_albedo import USUAL_WHITE, round_albedo

RIM = 0.4
IRIS, WHITE = np.log([0.06, 0.1, 0.14]), np.log([0.62, 0.58, 0.54])


def eye(seen_to, outliers=0.0):
    """Angles of texels up to the back, what they show, and how well: nothing beyond seen_to."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0.0, np.pi, 8000)
    log_albedo = np.where((angle < RIM)[:, None], IRIS, WHITE) + rng.normal(0.0, 0.05, (8000, 3))
    log_albedo[rng.uniform(size=8000) < outliers] = np.log([0.45, 0.25, 0.2])  # skin of a lid
    information = np.repeat(np.where(angle < seen_to, 200.0, 0.0)[:, None], 3, axis=1)
    return angle, log_albedo, information


@pytest.mark.parametrize("outliers", [0.0, 0.25])
def test_iris_and_white_are_what_texels_at_their_angle_show(outliers):
    angle, log_albedo, information = eye(1.0, outliers)
    found = round_albedo(angle, RIM, log_albedo, information)
    for part, truth in ((angle < RIM - 0.06, IRIS), ((angle > RIM + 0.06) & (angle < 1.0), WHITE)):
        assert np.abs(found[part] - truth).max() < 0.15


def test_the_white_goes_on_where_nothing_shows_it():
    angle, log_albedo, information = eye(0.8)
    found = round_albedo(angle, RIM, log_albedo, information)
    behind = found[angle > 2.5]
    assert np.abs(behind - WHITE).max() < 0.25
    assert np.abs(behind - behind.mean(1, keepdims=True)).max() < 0.1, "about neutral"


def test_eyes_that_no_frame_shows_are_of_the_usual_white():
    angle, log_albedo, information = eye(0.0)
    np.testing.assert_allclose(round_albedo(angle, RIM, log_albedo, information), USUAL_WHITE, atol=1e-6)
