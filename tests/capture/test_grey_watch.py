"""A grey place in the picture: what is read of it in noisy frames, before which somebody walks, or that are clipped."""

import numpy as np
import pytest
from field_check import below, field_faults

from shared.capture.grey_watch import LOOKS, GreyWatch, patch_around
from shared.contract.records import FRAMES
from shared.imaging.color import encode_srgb

PLACE = (50.0, 30.5)
TINT = np.array([0.25, 0.2, 0.14])
SKIN = np.array([0.5, 0.3, 0.2])


def wall(colour=TINT, noise=0.01, seed=0):
    """uint8 sRGB [60, 80, 3]: a wall of a linear colour around the place, something else elsewhere."""
    linear = np.tile(np.array([0.02, 0.3, 0.6]), (60, 80, 1))
    linear[24:38, 43:58] = colour
    linear = np.maximum(linear + noise * np.random.default_rng(seed).normal(size=linear.shape), 0.0)
    return np.rint(255 * encode_srgb(np.minimum(linear, 1.0))).astype(np.uint8)


def watched(frames, place=PLACE):
    watch = GreyWatch(place, "srgb")
    watch.expect(len(frames))
    for i, codes in enumerate(frames):
        watch.look(i, 10 * i, codes)
    return watch


def tint_of(colour):
    return np.log([colour[0] / colour[1], colour[2] / colour[1]])


def test_the_tint_is_read_through_noise_from_a_dozen_frames():
    watch = watched([wall(noise=0.02, seed=i) for i in range(40)])
    record = watch.record()
    assert watch.warnings() == [] and field_faults(record, below(FRAMES, "grey")) == []
    assert record["place"] == [50.0, 30.5] and len(record["frames"]) == LOOKS and record["frames"][-1] == 390
    np.testing.assert_allclose(record["colour"], TINT, rtol=0.02)
    sigma = np.array(record["log_sigma"])
    assert (np.abs(tint_of(record["colour"]) - tint_of(TINT)) < 2.0 * sigma).all() and (sigma < 0.04).all()
    quiet = watched([wall(noise=0.002, seed=i) for i in range(40)]).record()
    assert (np.array(quiet["log_sigma"]) < 0.6 * sigma).all()


def test_exposure_is_none_of_its_business():
    dim = watched([wall(gain * TINT, 0.0) for gain in np.linspace(0.3, 1.5, 12)]).record()
    assert len(dim["frames"]) == 12
    np.testing.assert_allclose(tint_of(dim["colour"]), tint_of(TINT), atol=0.01)


def test_frames_before_which_somebody_walks_do_not_count():
    passing = {2, 3, 4, 5}
    record = watched([wall(SKIN if i in passing else TINT, seed=i) for i in range(12)]).record()
    assert record["frames"] == [10 * i for i in range(12) if i not in passing]
    np.testing.assert_allclose(tint_of(record["colour"]), tint_of(TINT), atol=0.03)


def test_clipped_and_black_frames_do_not_count():
    colours = {0: 5 * TINT, 1: 5 * TINT, 7: 0.01 * TINT}
    record = watched([wall(colours.get(i, TINT), noise=0.002, seed=i) for i in range(12)]).record()
    assert record["frames"] == [20, 30, 40, 50, 60, 80, 90, 100, 110]
    np.testing.assert_allclose(record["colour"], TINT, rtol=0.02)


@pytest.mark.parametrize("colours, words", [
    ([5 * TINT] * 10 + [TINT] * 2, "2 of 12 frames can be read there, the others are overexposed"),
    ([5 * TINT] * 6 + [0.01 * TINT] * 6, "0 of 12 frames can be read there, the others are overexposed and too dark"),
    ([SKIN[[1, 0, 2]] * [0.1, 1.0, 0.7]] * 12, "no usual light makes of grey"),
    ([[0.5, 0.1, 0.5], [0.5, 0.25, 0.1], [0.2, 0.5, 0.35]], "not the same in 3 frames"),
    ([TINT, SKIN] * 6, "not the same in 12 frames"),
])
def test_a_place_that_says_nothing_is_not_used_and_the_warning_says_why(colours, words):
    watch = watched([wall(np.array(colour), noise=0.001) for colour in colours])
    assert watch.record() is None
    (warning,) = watch.warnings()
    assert warning.startswith("the grey place at (50, 30.5) is not used: ") and words in warning


def test_nothing_is_looked_at_where_no_place_is_named():
    watch = watched([wall(5 * TINT)] * 3, place=None)
    assert watch.record() is None and watch.warnings() == []


def test_a_patch_is_a_disc_of_whole_pixels_that_ends_with_the_picture():
    picture = np.arange(600).reshape(20, 30, 1)
    whole, corner = (patch_around(picture, place)[:, 0] for place in ((12.5, 10.5), (0.0, 0.0)))
    assert set(whole) == {30 * y + x for y in range(20) for x in range(30) if np.hypot(x - 12, y - 10) <= 4}
    assert set(corner) == {30 * y + x for y in range(4) for x in range(4) if np.hypot(x + 0.5, y + 0.5) <= 4}
