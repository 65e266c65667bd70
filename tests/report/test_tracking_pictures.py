"""The tracking stage's pictures show what they are given."""

from types import SimpleNamespace

import numpy as np
from shapes import grid_plane

from shared.geometry.transforms import rigid, rotation_from_vector
from shared.report.tracking_pictures import (
    BRIGHTEST_PX,
    CURVE_COLOURS,
    GRID,
    PAPER,
    PLOT_HEIGHT,
    PLOT_WIDTH,
    pose_curves,
    residual_map,
)

PLANE = grid_plane(5, extent=100.0)


def turn(frames=20):
    """A turn about all axes, each at its own pace."""
    waves = np.sin(np.linspace(0, 6, frames)[:, None] + [0.0, 1.0, 2.0])
    rotation = np.diag([1.0, -1, -1]) @ rotation_from_vector(waves * [0.1, 0.4, 0.2])
    return rigid(rotation, waves * [3.0, 5.0, 8.0] + [0.0, 0, 900])


def curves(deviation, frames=20):
    """Curves of the turn; the second axis is known worst."""
    covariance = np.diag(np.tile([1.0, 2.0, 1.5], 2) * deviation) ** 2
    return pose_curves(turn(frames), np.tile(covariance, (frames, 1, 1)), np.arange(frames) / 15.0)


def test_curves_have_three_panels_and_three_colours():
    picture = curves(1e-3)
    assert picture.shape == (3 * PLOT_HEIGHT, PLOT_WIDTH, 3) and picture.dtype == np.uint8
    for panel in np.split(picture, 3):
        for colour in CURVE_COLOURS:
            assert (np.abs(panel.astype(int) - colour).max(-1) < 40).sum() > 20


def test_larger_deviation_shows_as_a_wider_band():
    panels = [curves(deviation)[:PLOT_HEIGHT].astype(int) for deviation in (1e-3, 0.05)]
    covered = [(np.abs(panel - PAPER).sum(-1) > 20).sum() for panel in panels]
    assert covered[1] > 2 * covered[0]


def test_curves_of_a_still_head_and_of_one_frame():
    still = pose_curves(np.repeat(turn(1), 4, axis=0), np.tile(np.eye(6) * 1e-6, (4, 1, 1)), np.arange(4.0))
    one = pose_curves(turn(1), np.eye(6)[None] * 1e-6, np.zeros(1))
    assert still.shape == one.shape == (3 * PLOT_HEIGHT, PLOT_WIDTH, 3)
    assert (np.abs(still.astype(int) - CURVE_COLOURS[2]).max(-1) < 40).sum() > 100


def test_gaze_has_a_panel_for_each_angle_with_gaps_where_an_eye_is_shut():
    frames = 20
    angles = np.radians(np.linspace(-20, 20, frames))[:, None, None] * np.ones((frames, 2, 2))
    angles[8:12] = np.nan
    gaze = SimpleNamespace(gaze=angles, own_sigma=np.full_like(angles, 1e-4))
    picture = pose_curves(turn(frames), np.tile(1e-6 * np.eye(6), (frames, 1, 1)), np.arange(frames) / 15.0, gaze)
    assert picture.shape[0] == 5 * PLOT_HEIGHT
    panel = picture[3 * PLOT_HEIGHT + 20 : 4 * PLOT_HEIGHT].astype(int)
    # A line between two rows of pixels is shared by them: a third of its colour in one at least.
    ink = np.subtract(CURVE_COLOURS[1], PAPER)
    drawn = ((panel - PAPER) @ ink > ink @ ink / 3).any(0)
    middle = (56 + PLOT_WIDTH - 12) // 2
    assert not drawn[middle - 10 : middle + 10].any() and drawn[100:300].all() and drawn[600:800].all()


def at(picture, point):
    """Colour sum where a point of the plane lies in its UV layout."""
    size = len(picture)
    column, row = (point[:2] / 100.0 + 0.5) * size
    return int(picture[int(size - row), int(column)].astype(int).sum())


def test_bad_point_is_brighter_than_a_good_one():
    points = np.array([[-30.0, 20, 0], [0, 20, 0], [30, 20, 0], [0, -30, 0]])
    picture = residual_map(PLANE, points, np.array([0.02, 0.2, BRIGHTEST_PX, np.nan]), size=256)
    assert picture.shape == (256, 256, 3) and picture.dtype == np.uint8
    good, middling, bad = (at(picture, point) for point in points[:3])
    assert good < middling < bad
    assert at(picture, points[3]) == sum(GRID)  # never seen, so not drawn
    red, _, blue = picture[256 - int(0.7 * 256), 128].astype(int)
    assert red > blue  # middling is red in this scale


def test_errors_beyond_the_brightest_look_alike():
    point = np.array([[10.0, 10, 0]])
    first, second = (residual_map(PLANE, point, np.array([error]), size=128) for error in (BRIGHTEST_PX, 30.0))
    assert np.array_equal(first, second)


def test_texels_that_no_face_covers_are_paper():
    half = PLANE.replace(uvs=PLANE.uvs * 0.5)
    picture = residual_map(half, np.array([[0.0, 0, 0]]), np.array([0.1]), size=64)
    assert np.all(picture[:30, 34:] == PAPER)
    assert np.all(picture[40, 4] == GRID)
