"""Each reason and each warning of the tracking appears when it should, and only then."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from field_check import below, field_faults
from shapes import nods

from shared.contract.records import TRACKING
from shared.geometry.transforms import rotation_range_deg
from shared.tracking.track_head import HeadTrack
from shared.tracking.track_quality import frames_that_fit, mouth_ratio, warnings_of
from stages.track_landmarks import excluded_frames

FRAMES, POINTS = 20, 60
LIPS = np.array([[-10.0, -40, 90], [0, -40, 95], [10, -40, 90]])
EVERY_FRAME = np.ones(FRAMES, bool)


def turn(degrees):
    """Poses of a head that turns by so many degrees in all."""
    return nods(np.linspace(-degrees / 2, degrees / 2, FRAMES))


def good_track(**changes):
    """A track with nothing wrong: fifteen of its points lie by the lips."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-60, 0, 60], [60, 80, 90], size=(POINTS, 3))
    points[:15] = LIPS[rng.integers(0, 3, 15)] + rng.uniform(-5, 5, (15, 3))
    track = HeadTrack(
        camera_from_head=turn(50.0),
        covariance=np.tile(1e-6 * np.eye(6), (FRAMES, 1, 1)),
        fit=None,
        points_head=points,
        sigma_mm=np.full(POINTS, 0.2),
        error_px=rng.uniform(0.1, 0.2, (FRAMES, POINTS)),
        reliable=np.ones(FRAMES, bool),
        noise_factor=2.0,
        focal_gain=1.005,
        focal_deviation=0.01,
        focal_solved=False,
        held_out_px=(0.2, 0.2),
    )
    return replace(track, **changes)


def warnings(track, fits=EVERY_FRAME, frame_count=FRAMES, focal_known=True):
    return warnings_of(track, fits, frame_count, focal_known, LIPS)


def test_good_clip_has_neither_reasons_nor_warnings():
    track = good_track()
    fits, reasons = frames_that_fit(track, 4.0)
    assert fits.all() and reasons == [""] * FRAMES
    assert warnings(track) == []


def test_held_poses_are_doubted_where_the_skin_moves_otherwise():
    doubted = warnings(good_track(held_off=(np.radians(1.0), np.radians(0.2))))
    assert len(doubted) == 1 and "1.0 degrees otherwise" in doubted[0] and "hold_poses" in doubted[0]
    assert warnings(good_track(held_off=(np.radians(1.0), np.radians(0.4)))) == []  # the tracks don't know it
    assert warnings(good_track(held_off=(np.radians(0.2), np.radians(0.02)))) == []  # theirs may be the better ones


def test_poses_that_are_hardly_known_are_said_to_be():
    covariance = np.tile(np.radians(0.6) ** 2 / 3.0 * np.eye(6), (FRAMES, 1, 1))
    unsure = warnings(good_track(covariance=covariance))
    assert len(unsure) == 1 and "known to 0.6 degrees only" in unsure[0] and "compression" in unsure[0]
    covariance[: FRAMES // 2 + 1] *= 0.25  # most frames are known well
    assert warnings(good_track(covariance=covariance)) == []


def test_frame_with_too_few_tracks_is_named():
    reliable = np.arange(FRAMES) != 3
    error = good_track().error_px
    error[3] = np.nan
    fits, reasons = frames_that_fit(good_track(reliable=reliable, error_px=error), 4.0)
    assert np.array_equal(fits, reliable)
    assert reasons[3] == "too little skin could be tracked" and reasons[2] == ""


def test_frame_that_fits_badly_is_named():
    error = good_track().error_px
    error[7] += 2.0
    error[8] += 0.3  # more than the others, less than the limit
    fits, reasons = frames_that_fit(good_track(error_px=error), 4.0)
    assert np.nonzero(~fits)[0].tolist() == [7]
    assert reasons[7].startswith("track error 2.1") and "blur" in reasons[7]


def test_limit_grows_with_the_clip_s_own_error():
    track = good_track(error_px=good_track().error_px * 10)
    error = track.error_px.copy()
    error[7] *= 3
    error[8] *= 6
    fits, _ = frames_that_fit(replace(track, error_px=error), 4.0)
    assert np.nonzero(~fits)[0].tolist() == [8]


@pytest.mark.parametrize("degrees", [0.0, 10.0, 50.0])
def test_rotation_range_is_the_widest_angle_between_views(degrees):
    assert rotation_range_deg(turn(degrees)) == pytest.approx(degrees, abs=1e-4)


def test_small_rotation():
    assert warnings(good_track(camera_from_head=turn(16.0))) == []
    (warning,) = warnings(good_track(camera_from_head=turn(12.0)))
    assert "12 degrees" in warning and "film a turn" in warning


def test_rotation_of_frames_that_do_not_fit_does_not_count():
    middle = np.abs(np.arange(FRAMES) - 9.5) < 2
    found = warnings(good_track(), fits=middle, frame_count=4)
    assert len(found) == 1 and "degrees" in found[0]


def test_focal_mismatch():
    assert warnings(good_track(focal_gain=1.05, focal_deviation=0.02)) == []  # within its own deviation
    assert warnings(good_track(focal_gain=1.025, focal_deviation=0.001)) == []  # within the tolerance
    (longer,) = warnings(good_track(focal_gain=1.08, focal_deviation=0.01))
    assert "+8 %" in longer and "subject.yaml" in longer
    (shorter,) = warnings(good_track(focal_gain=0.92, focal_deviation=0.01))
    assert "-8 %" in shorter


def test_focal_unknown():
    (guess,) = warnings(good_track(focal_gain=1.2, focal_deviation=0.2), focal_known=False)
    assert "a guess" in guess and "focal_length_mm" in guess
    (solved,) = warnings(good_track(focal_solved=True, focal_deviation=0.013), focal_known=False)
    assert "known to 1.3 %" in solved


def test_moving_mouth():
    error = good_track().error_px
    error[:, :15] *= 1.5
    assert warnings(good_track(error_px=error)) == []
    error[:, :15] *= 2.0
    (warning,) = warnings(good_track(error_px=error))
    assert "3.0 times" in warning and "lips closed" in warning


def test_mouth_with_few_tracks_is_not_judged():
    error = good_track().error_px
    error[:, :15] *= 5.0
    points = good_track().points_head
    points[5:15] = [0.0, 60.0, 90.0]
    track = good_track(error_px=error, points_head=points)
    assert mouth_ratio(track, EVERY_FRAME, LIPS) == 1.0
    assert warnings(track) == []


def test_excluded_frames_are_recorded_with_their_reasons():
    frames = SimpleNamespace(count=3, frame_index=np.array([4, 6, 9]))
    rows = excluded_frames(frames, np.array([0, 1]), np.array([1.0, 1.0, 0.2]), ["", "fits badly"])
    assert rows == [{"frame_index": 6, "reason": "fits badly"},
                    {"frame_index": 9, "reason": "no face found (presence 0.20)"}]
    assert [field_faults(row, below(TRACKING, "excluded[]")) for row in rows] == [[], []]


def test_many_excluded_frames():
    fits = np.arange(FRAMES) >= 4
    assert warnings(good_track(), fits=fits) == []
    (warning,) = warnings(good_track(), fits=fits, frame_count=FRAMES + 1)
    assert warning.startswith("5 of 21 frames")
