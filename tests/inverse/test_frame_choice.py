"""Which frames are re-rendered: evenly spread, with open eyes where enough have them."""

import numpy as np
import pytest

from shared.inverse.frame_choice import shown_frames


def gaze_with_shut(count, shut):
    gaze = np.zeros((count, 2, 2))
    gaze[shut, 1] = np.nan  # one eye is enough
    return gaze


def test_without_gaze_they_are_spread_over_all():
    np.testing.assert_array_equal(shown_frames(9, 3, None), [0, 4, 8])
    np.testing.assert_array_equal(shown_frames(2, 3, None), [0, 1])


@pytest.mark.parametrize("shut", [[0, 4], [3, 4, 5], [8]])
def test_shut_eyes_are_passed_over(shut):
    chosen = shown_frames(9, 3, gaze_with_shut(9, shut))
    assert len(chosen) == 3
    assert not set(chosen) & set(shut)


def test_eyes_that_are_hardly_ever_open_leave_all_frames():
    np.testing.assert_array_equal(shown_frames(9, 3, gaze_with_shut(9, list(range(2, 9)))), [0, 4, 8])
