"""What lids leave open, found by what turns with the eye, where the network's contours are off."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from drawn_eyes import CENTRES, FRAMES, LENS, LIDS_MM, RADIUS_MM, drawn, gaze_on_the_camera, iris_centres, poses
from shapes import two_balls

from shared.capture.iris import UPPER_LID, EyePicture
from shared.geometry.transforms import project
from shared.tracking import lid_openings as lid_openings_module
from shared.tracking.gaze import Gaze
from shared.tracking.lid_openings import BEYOND_MM, LEAST_FRAMES, lid_openings
from shared.tracking.lids import Lids


def solved(gaze, iris_mm=5.85):
    nothing = np.zeros((FRAMES, 2))
    return Gaze(gaze, 0 * gaze, 0 * gaze, "camera", CENTRES, np.ones((2, 3)), RADIUS_MM, iris_mm, 0.1, nothing, 0.1)


GAZES = {"camera": gaze_on_the_camera(), "head": np.zeros((FRAMES, 2, 2))}


@cache
def eyes_that_look(at):
    return drawn(GAZES[at], np.ones(FRAMES), glint=False)


def found(at, network_mm, frames=FRAMES, seen=None):
    """The openings of eyes that look at something, where the network has contours network_mm [16, 3] and this many
    frames have open eyes."""
    gaze, seen = GAZES[at], seen or eyes_that_look(at)
    lids_px = np.stack([[project(centre + network_mm * (side, 1, 1), pose, LENS)[0] for side, centre in
                         zip((-1, 1), CENTRES, strict=True)] for pose in poses()])  # fmt: skip
    seen = replace(seen, iris_px=seen.iris_px + (iris_centres(gaze) - seen.iris_px[:, :, 0])[:, :, None],
                   lids_px=lids_px)
    shut = np.repeat(np.arange(FRAMES)[:, None] >= frames, 2, axis=1)
    lids = Lids(np.ones((FRAMES, 2)), shut, np.full(2, 9.0))
    return lid_openings(two_balls(CENTRES, RADIUS_MM), seen, lids, solved(gaze), poses(), LENS)


def heights(openings, side):
    """Lower and upper height [2] mm above the eye's centre in its middle, and how wide it is open, mm."""
    curves = openings.points[side] - CENTRES[side]
    middle = [np.interp(0.0, *curve[np.argsort(curve[:, 0])][:, :2].T) for curve in curves]
    return (*middle, np.ptp(curves[0][:, 0]))


def moved_contour(lower_mm=0.0, upper_mm=0.0):
    """The drawn contour, bowed by so much in the middle of either lid."""
    contour = LIDS_MM.copy()
    bow = 1.0 - (contour[:, 0] / 13.0) ** 2
    upper = np.isin(np.arange(16), UPPER_LID[1:-1])
    contour[:, 1] += np.where(upper, upper_mm, lower_mm) * bow
    return contour


@pytest.mark.parametrize(("lower_mm", "upper_mm"), [(0.0, 0.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 1.0)])
def test_the_margins_are_where_the_eyeball_ends_and_not_where_the_network_has_them(lower_mm, upper_mm):
    openings = found("camera", moved_contour(lower_mm, upper_mm))
    assert not openings.shut.any()
    for side in range(2):
        lower, upper, width = heights(openings, side)
        assert lower == pytest.approx(-4.0, abs=0.4 + 0.35 * abs(lower_mm))
        assert upper == pytest.approx(5.0, abs=0.4 + 0.35 * abs(upper_mm))
        assert 19.0 < width < 27.0


def test_where_nothing_moves_the_network_s_contour_stays():
    """A gaze that goes with the head tells skin from eyeball nowhere; the lids' own edges, which are not on the skin's
    surface here, still tremble a little."""
    openings = found("head", moved_contour(0.0, 0.0))
    lower, upper, _ = heights(openings, 0)
    assert lower == pytest.approx(-4.0, abs=0.45)
    assert upper == pytest.approx(5.0, abs=0.45)


def test_what_flickers_far_beyond_the_network_s_contour_is_not_open():
    """As the mirror image of a window in glasses does: here all that lies under the lower lid."""
    seen, pictures = eyes_that_look("camera"), []
    for f, (both, lids_px) in enumerate(zip(seen.pictures, seen.lids_px, strict=True)):
        grey = [picture.grey.copy() for picture in both]
        for own, picture, lids in zip(grey, both, lids_px, strict=True):
            own[round(lids[4, 1] - picture.corner[1]) :] = (60, 240)[f % 2]
        pictures.append(tuple(EyePicture(own, picture.corner) for own, picture in zip(grey, both, strict=True)))
    lower, _, _ = heights(found("camera", LIDS_MM, seen=replace(seen, pictures=tuple(pictures))), 0)
    assert -4.0 - BEYOND_MM - 0.3 < lower < -4.0 - 0.5 * BEYOND_MM


def test_too_few_open_eyes_tell_nothing():
    assert np.isnan(found("camera", LIDS_MM, frames=LEAST_FRAMES - 1).points).all()


def test_eyes_of_few_pixels_tell_nothing(monkeypatch):
    pixel_mm = 900.0 / LENS[0, 0]
    monkeypatch.setattr(lid_openings_module, "LARGEST_PIXEL_MM", 0.9 * pixel_mm)
    assert np.isnan(found("camera", LIDS_MM).points).all()


def test_corners_belong_to_both_lids():
    points = found("camera", LIDS_MM).points
    np.testing.assert_allclose(points[:, 0, [0, -1]], points[:, 1, [0, -1]])
    assert (points[:, 1, 1:-1, 1] > points[:, 0, 1:-1, 1]).all()
    ends = CENTRES[:, None, None] + LIDS_MM[[0, 8]] * np.array([[-1, 1, 1], [1, 1, 1]])[:, None, None]
    np.testing.assert_allclose(points[:, :, [0, -1], 0], np.repeat(ends[..., 0], 2, axis=1), atol=3.0)
