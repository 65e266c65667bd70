"""Irises followed by their texture, on drawn eyes whose gaze is known."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_eyes import CENTRES, FRAMES, IRIS_MM, LENS, RADIUS_MM, drawn, gaze_on_the_camera, iris_centres, poses

from shared.tracking.gaze import solve_gaze
from shared.tracking.iris_texture import follow_irises, lay_on_rims


@pytest.mark.parametrize(("varies", "glint"), [(0.0, False), (0.3, False), (0.0, True)])
def test_irises_that_the_network_puts_too_near_to_the_middle_are_found(varies, glint):
    gaze = gaze_on_the_camera()
    light = 1.0 - varies * np.linspace(0, 1, FRAMES)
    seen = drawn(gaze, light, glint)
    found, counts, time_s = seen.iris_px, np.ones((FRAMES, 2), bool), np.arange(FRAMES) / 10
    for _ in range(3):
        solved = solve_gaze(found, counts, CENTRES, RADIUS_MM, poses(), LENS, time_s)
        now = replace(seen, iris_px=found)
        found = follow_irises(now, solved.gaze, solved.centres, solved.iris_distance_mm, poses(), LENS)
    before, after = (np.linalg.norm(px[:, :, 0] - iris_centres(gaze), axis=-1) for px in (seen.iris_px, found))
    assert np.quantile(before, 0.9) > 2.0
    assert np.median(after) < 0.15 * np.median(before) and np.quantile(after, 0.9) < 0.3 * np.quantile(before, 0.9)


def test_the_rim_goes_with_the_centre_and_eyes_without_gaze_stay():
    gaze = gaze_on_the_camera()
    seen = drawn(gaze, np.ones(FRAMES), glint=False)
    known = 0.75 * gaze
    known[5], known[7, 1] = np.nan, np.nan
    pictures = tuple((None, None) if f == 5 else own for f, own in enumerate(seen.pictures))
    found = follow_irises(replace(seen, pictures=pictures), known, CENTRES, RADIUS_MM, poses(), LENS)
    assert np.array_equal(found[5], seen.iris_px[5]) and np.array_equal(found[7, 1], seen.iris_px[7, 1])
    rims, before = found - found[:, :, :1], seen.iris_px - seen.iris_px[:, :, :1]
    assert np.allclose(rims, before, atol=1e-9) and (found[8] != seen.iris_px[8]).all()


@pytest.mark.parametrize("share", [0.0, 0.15])
def test_lids_that_leave_little_or_nothing_to_look_at_leave_irises_that_are_finite(share):
    gaze = gaze_on_the_camera()
    seen = drawn(gaze, np.ones(FRAMES), glint=False)
    middle = seen.lids_px.mean(2, keepdims=True)
    narrow = replace(seen, lids_px=middle + (seen.lids_px - middle) * (1.0, share))
    found = follow_irises(narrow, 0.75 * gaze, CENTRES, RADIUS_MM, poses(), LENS)
    off = np.linalg.norm(found[:, :, 0] - iris_centres(gaze), axis=-1)
    assert np.isfinite(found).all() and off.max() < 4.0


def test_circles_beside_the_irises_and_too_small_are_laid_on_their_rims():
    """By the same in all frames; an eye of which nothing is seen stays."""
    gaze = gaze_on_the_camera()
    seen = drawn(gaze, np.ones(FRAMES), glint=False)
    true = iris_centres(gaze)
    mm_px, aside = LENS[0, 0] / 840.0, np.array([[1.0, 0.8], [-1.2, 0.6]])
    rims = 5.3 * mm_px * np.array([[0, 0], [1, 0], [0, -1], [-1, 0], [0, 1]])
    given = replace(seen, iris_px=true[:, :, None] + aside[:, None] + rims)
    known = gaze.copy()
    known[..., 0] += aside[:, 0] / (mm_px * RADIUS_MM)
    known[..., 1] -= aside[:, 1] / (mm_px * RADIUS_MM)
    known[5] = np.nan
    found = lay_on_rims(given, known, CENTRES, RADIUS_MM, 5.3, poses(), LENS)
    assert np.array_equal(found[5], given.iris_px[5])
    kept = np.arange(FRAMES) != 5
    off = np.linalg.norm(found[kept][:, :, 0] - true[kept], axis=-1)
    assert np.linalg.norm(aside, axis=1).min() > 1.2 and np.median(off) < 0.3
    radius = np.linalg.norm(found[kept][:, :, 1] - found[kept][:, :, 0], axis=-1) / mm_px
    assert np.median(radius) == pytest.approx(IRIS_MM, rel=0.03)
    shut = replace(given, lids_px=given.lids_px * 0.0 + given.lids_px.mean(2, keepdims=True))
    laid = lay_on_rims(shut, known, CENTRES, RADIUS_MM, 5.3, poses(), LENS)
    np.testing.assert_allclose(laid, given.iris_px, atol=0.05)
