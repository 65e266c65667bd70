"""What drops a frame: each measure against a known cause."""

import cv2
import numpy as np
import pytest
from toy_video import drawn_face

from shared.capture.frame_quality import (
    background_drift,
    find_duplicates,
    find_empty,
    find_shots,
    local_median,
    proxy,
    relative_sharpness,
    sharpness,
    spread_evenly,
)
from shared.imaging.color import decode_srgb

RNG = np.random.default_rng(5)
TEXTURE = cv2.resize(RNG.integers(0, 256, (200, 200), np.uint8), (400, 400), interpolation=cv2.INTER_CUBIC)
WHOLE = np.array([0, 0, 400, 400])


@pytest.mark.parametrize(("length", "lowest", "highest"), [(3, 0.3, 0.75), (5, 0.05, 0.4), (9, 0.02, 0.25)])
def test_motion_blur_lowers_sharpness_along_the_motion(length, lowest, highest):
    across = cv2.blur(TEXTURE, (length, 1))
    ratio = sharpness(across, WHOLE) / sharpness(TEXTURE, WHOLE)
    assert lowest < ratio[0] < highest
    turned = sharpness(cv2.blur(TEXTURE, (1, length)), WHOLE) / sharpness(TEXTURE, WHOLE)
    assert lowest < turned[1] < highest
    assert ratio[0] < ratio[1] and turned[1] < turned[0]


def test_sharpness_outside_the_picture_is_zero():
    assert np.array_equal(sharpness(TEXTURE, np.array([500, 500, 600, 600])), [0, 0])


def test_local_median_against_a_loop():
    values = RNG.normal(size=40)
    values[[3, 4, 20]] = np.nan
    expected = [np.nanmedian(values[max(0, i - 7):i + 8]) for i in range(40)]
    assert np.allclose(local_median(values), expected)
    assert np.isnan(local_median(np.full(5, np.nan))).all()


def test_relative_sharpness_forgives_slow_change_and_finds_single_frames():
    slow = np.linspace(1, 4, 60)
    energies = np.stack([slow, slow], axis=1)
    energies[30, 0] *= 0.2
    relative = relative_sharpness(energies)
    assert relative[30] < 0.25
    assert np.delete(relative, 30).min() > 0.7


def test_repeated_frames_differ_less_than_their_neighbours():
    difference = RNG.uniform(1.5, 2.5, 40)
    difference[0] = np.nan
    difference[[7, 20]] = 0.0, 0.15  # written again exactly, and by an encoder
    assert np.nonzero(find_duplicates(difference))[0].tolist() == [7, 20]
    slowing = np.concatenate([np.linspace(3, 0.5, 20), np.linspace(0.5, 3, 20)])
    assert not find_duplicates(slowing).any()


def test_black_and_single_coloured_frames_are_empty():
    picture = proxy(drawn_face((120, 95)))
    pictures = np.stack([picture, picture * 0 + 3, np.full_like(picture, (20, 200, 30)), picture // 8])
    assert find_empty(pictures).tolist() == [False, True, True, False]


def test_cuts_split_shots_and_a_flash_does_not():
    scene_a = [proxy(drawn_face((90 + 2 * i, 95))) for i in range(12)]
    blobs = cv2.resize(np.random.default_rng(9).integers(0, 256, (5, 6, 3), np.uint8), (240, 200))
    scene_b = [proxy(blobs + np.uint8(i)) for i in range(6)]
    white = np.clip(scene_a[5].astype(int) + 150, 0, 255).astype(np.uint8)
    shots = find_shots(np.stack([*scene_a[:5], white, *scene_a[6:], *scene_b]))
    assert len(set(shots[[0, 4, 6, 11]])) == 1
    assert shots[5] != shots[0] and shots[12] != shots[0]
    assert len(set(shots[12:])) == 1


def test_even_spread_in_time_prefers_sharp_frames():
    times, score = np.arange(100) / 25, np.ones(100)
    score[[10, 51]] = 0.5
    chosen = spread_evenly(times, score, 21)
    assert len(chosen) == 21 and not {10, 51} & set(chosen.tolist())
    assert np.diff(times[chosen]).max() < 0.33
    assert spread_evenly(times[:9], score[:9], 20).tolist() == list(range(9))
    gap = np.concatenate([times[:10], times[:10] + 20])
    assert len(spread_evenly(gap, np.ones(20), 15)) >= 2


def test_background_drift_sees_exposure_alone():
    walls = np.full((30, 18, 32, 3), 120, np.uint8)
    background = np.ones((18, 32), bool)
    background[4:, 10:22] = False
    walls[:, ~background] = RNG.integers(0, 256, (30, np.count_nonzero(~background), 3))
    assert background_drift(walls, background) == pytest.approx(0.0)
    walls[20:] = 130
    expected = (decode_srgb(130 / 255) - decode_srgb(120 / 255)) / decode_srgb(120 / 255)
    assert background_drift(walls, background) == pytest.approx(float(expected), rel=0.01)
    assert np.isnan(background_drift(walls, np.zeros((18, 32), bool)))
