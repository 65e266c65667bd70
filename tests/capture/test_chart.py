"""The colour chart: reflectances, finding and reading it in pictures, and what its patches say about the light."""

import numpy as np
import pytest
from field_check import below, field_faults
from toy_chart import chart_pose, draw_chart

from shared.capture.chart import COLUMNS, CORNERS, NEUTRAL, PATCHES, fit_chart, reflectances
from shared.capture.chart_finder import LEAST_LIKENESS, clipping_limit, find_chart, read_chart
from shared.capture.chart_watch import ChartWatch
from shared.contract.chart_place import AUTO, ChartPlace
from shared.contract.records import FRAMES
from shared.imaging.color import decode_bt709, decode_srgb, encode_srgb

TABLE = decode_srgb(np.arange(256) / 255.0).astype(np.float32)
LIMIT = clipping_limit(TABLE)
UNCLIPPED = np.zeros((PATCHES, 3), bool)
WHITE = np.array([0.9, 0.75, 0.5])
# What X-Rite gives as the patches' sRGB codes for the charts before November 2014, some units from the later ones.
OLDER_CODES = {0: (115, 82, 68), 1: (194, 150, 130), 6: (214, 126, 44), 8: (193, 90, 99), 13: (70, 148, 73),
               16: (187, 86, 149), 18: (243, 243, 242), 20: (160, 160, 160), 22: (85, 85, 85)}


def test_reflectances_are_those_of_the_chart_under_white_light():
    codes = 255 * encode_srgb(reflectances())
    for patch, expected in OLDER_CODES.items():
        assert np.abs(codes[patch] - expected).max() < 14, patch
    grey = reflectances()[19:]
    assert np.abs(grey / grey.mean(1, keepdims=True) - 1).max() < 0.03
    assert (np.diff(reflectances()[NEUTRAL].mean(1)) < 0).all()


def test_the_fit_returns_the_light_through_a_gradient_and_glare():
    rng = np.random.default_rng(0)
    column, row = np.arange(PATCHES) % COLUMNS, np.arange(PATCHES) // COLUMNS
    shade = 1.0 + 0.12 * (column - 2.5) / 2.5 - 0.05 * (row - 1.5)
    wear = np.exp(rng.normal(0, np.where(NEUTRAL, 0.01, 0.08), PATCHES))
    patches = np.maximum(reflectances(), 0) * (shade * wear)[:, None] * WHITE + 0.01
    fit = fit_chart(patches, UNCLIPPED)
    assert not fit.fault
    assert (np.abs(np.log(fit.white / WHITE)) < np.minimum(2 * fit.sigma, 0.04)).all()
    np.testing.assert_allclose(fit.glare, 0.01, atol=0.008)


def test_a_patch_that_is_hidden_loses_its_say():
    patches = np.maximum(reflectances(), 0) * WHITE
    patches[18] *= 0.3
    fit = fit_chart(patches, UNCLIPPED)
    assert fit.weight[18] < 0.1 < 0.7 < np.median(fit.weight)
    np.testing.assert_allclose(fit.white, WHITE, rtol=0.02)


def test_charts_that_contradict_say_why():
    patches = np.maximum(reflectances(), 0) * WHITE
    over = np.broadcast_to(NEUTRAL[:, None] & (np.arange(PATCHES) < 22)[:, None], UNCLIPPED.shape)
    assert "overexposed" in fit_chart(np.minimum(4 * patches, 1.0), over).fault
    misread = decode_bt709(encode_srgb(patches)) ** 1.6
    assert "grey patches deviate" in fit_chart(misread, UNCLIPPED).fault
    shuffled = patches.copy()
    shuffled[:18] = patches[:18][::-1]
    assert "patches deviate" in fit_chart(shuffled, UNCLIPPED).fault
    assert not fit_chart(np.where(patches > 0.7, 0.7, patches), patches > 0.7).fault


@pytest.mark.parametrize("pitch, turn, tilt, nod, gap", [
    (16, 0, 0, 0, 0.1), (24, 90, 12, 5, 0.06), (24, 178, -20, 0, 0.14), (34, -30, 30, 10, 0.1)])
def test_a_chart_is_found_registered_and_read(pitch, turn, tilt, nod, gap):
    picture, truth = draw_chart(WHITE, pitch, chart_pose(turn, tilt, nod), gap=gap)
    rough = find_chart(picture)
    assert rough is not None
    view = read_chart(TABLE[picture], LIMIT, rough)
    assert np.abs(view.corners - truth).max() < 0.6 and view.likeness > 0.95 > LEAST_LIKENESS
    fit = fit_chart(view.patches, view.clipped)
    assert not fit.fault
    np.testing.assert_allclose(fit.white, WHITE, rtol=0.01)


def test_no_chart_is_made_out_where_there_is_none():
    picture, _ = draw_chart(pitch_px=2.0)
    assert find_chart(picture) is None
    striped = np.zeros((240, 360, 3), np.uint8) + np.uint8(120) * (np.indices((240, 360)).sum(0) // 20 % 2)[..., None]
    for codes in (picture, striped.astype(np.uint8)):
        watch = watched([codes])
        assert watch.record() == [] and watch.warnings() == [] and watch.picture is None


def watched(frames, place=AUTO):
    watch = ChartWatch(place, "srgb")
    watch.expect(len(frames))
    for i, codes in enumerate(frames):
        watch.look(i, 10 * i, codes)
    return watch


def test_the_watch_keeps_what_good_frames_say():
    sharp, truth = draw_chart(WHITE, 26, chart_pose(5, 10), seed=1)
    empty, _ = draw_chart(WHITE, 2)
    watch = watched([empty, sharp, sharp, empty])
    records = watch.record()
    assert [record["frame_index"] for record in records] == [10, 20] and watch.warnings() == []
    assert [field_faults(record, below(FRAMES, "chart[]")) for record in records] == [[], []]
    assert np.abs(np.array(records[0]["corners"]) - truth).max() < 0.6
    np.testing.assert_allclose(records[0]["white"], WHITE, rtol=0.01)
    expected = np.maximum(reflectances(), 0) * WHITE
    np.testing.assert_allclose(np.array(records[0]["patches"])[NEUTRAL], expected[NEUTRAL], rtol=0.03, atol=0.002)
    assert max(watch.picture.shape[:2]) == 640


def test_a_chart_that_cannot_be_used_is_not_and_the_warning_says_why():
    over, _ = draw_chart(7 * WHITE, 26)
    watch = watched([over])
    assert watch.record() == []
    assert "frame 0 is not used" in watch.warnings()[0] and "overexposed" in watch.warnings()[0]
    assert watch.picture is not None
    small, corners = draw_chart(WHITE, 8)
    watch = ChartWatch(ChartPlace(True, 3, tuple(map(tuple, corners.tolist()))), "srgb")
    watch.look_at_given(small)
    assert watch.record() == [] and "8 px apart" in watch.warnings()[0]


@pytest.mark.parametrize("turn, backwards", [(0, False), (1, False), (2, True), (3, True)])
def test_corners_by_hand_may_start_anywhere_and_run_either_way(turn, backwards):
    picture, truth = draw_chart(WHITE, 20, chart_pose(3, -15))
    given = np.roll(truth[::-1] if backwards else truth, turn, axis=0) + np.array([[2, -1], [-2, 2], [1, 1], [-1, -2]])
    watch = ChartWatch(ChartPlace(True, 7, tuple(map(tuple, given.tolist()))), "srgb")
    watch.expect(1)
    watch.look(0, 0, picture)  # nothing is looked for where a person says where the chart is
    assert watch.record() == []
    watch.look_at_given(picture)
    (record,) = watch.record()
    assert record["frame_index"] == 7 and np.abs(np.array(record["corners"]) - truth).max() < 0.6


def test_corners_by_hand_off_the_chart_are_reported():
    picture, _ = draw_chart(WHITE, 20)
    elsewhere = 0.2 * CORNERS / CORNERS.max() * 100 + 10
    watch = ChartWatch(ChartPlace(True, 7, tuple(map(tuple, elsewhere.tolist()))), "srgb")
    watch.look_at_given(picture)
    assert watch.record() == [] and "no colour chart can be made out" in watch.warnings()[0]


def test_a_chart_told_to_be_ignored_is_not_looked_for():
    picture, _ = draw_chart(WHITE, 26)
    watch = watched([picture], ChartPlace(look=False))
    assert watch.record() == [] and watch.picture is None
