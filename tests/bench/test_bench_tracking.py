"""Spoilt copies of the tiny subject, and the table's measures."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from shared.contract.subject import load_subject
from shared.io.arrays import load_arrays
from shared.io.images import read_png, write_png
from tools.bench import degrade
from tools.bench.tracking import COLUMNS, main, measure, write_table
from tools.goldens.tiny import TINY_SUBJECT


def grey(value=120, size=40):
    return np.full((size, size, 3), value, np.uint8)


def test_flicker_changes_whole_frames_by_about_a_fifth():
    means = np.array([degrade.flicker(grey(), i, 30).mean() for i in range(30)]) / 120.0
    assert 1.06 < means.max() < 1.12 and 0.86 < means.min() < 0.93


def test_rolling_exposure_makes_bands_along_the_rows():
    degraded = degrade.rolling_exposure(grey(), 3, 10).astype(float)
    assert np.ptp(degraded, axis=1).max() == 0
    assert np.ptp(degraded[:, 0, 0]) > 8
    assert np.abs(degraded - degrade.rolling_exposure(grey(), 4, 10)).max() > 2


def test_motion_blur_spreads_a_dot_along_its_row_only():
    dot = np.zeros((9, 9, 3), np.uint8)
    dot[4, 4] = 200
    degraded = degrade.motion_blur(dot, 0, 1)[..., 0]
    assert degraded[4, 3:6].tolist() == [50, 100, 50] and degraded.sum() == 200


def landmarks():
    rng = np.random.default_rng(1)
    return 200 + 60 * rng.normal(size=(48, 468, 2)), np.radians(25) * np.sin(np.linspace(0, 6, 48)), rng


def test_landmark_bias_grows_with_the_turn():
    points, yaw, rng = landmarks()
    moved = degrade.landmark_bias(points, yaw, rng) - points
    assert np.abs(moved[..., 1]).max() == 0
    assert np.abs(moved[..., 0]).max() == pytest.approx(3.0)
    assert np.allclose(moved[:, 0, 0] / 3.0, yaw / np.abs(yaw).max())


def test_a_fifth_of_the_landmarks_is_gross():
    points, yaw, rng = landmarks()
    moved = np.abs(degrade.landmark_outliers(points, yaw, rng) - points).max(-1)
    assert 0.18 < (moved > 1e-9).mean() < 0.22
    assert np.median(moved[moved > 1e-9]) > 20


def test_five_stretches_of_landmarks_are_missing():
    points, yaw, rng = landmarks()
    missing = np.isnan(degrade.landmark_gaps(points, yaw, rng)[:, 0, 0])
    assert (np.diff(missing.astype(int)) == 1).sum() == 5


def test_a_copy_with_fewer_frames_keeps_their_truth(tmp_path):
    degrade.degrade_pixels(TINY_SUBJECT, tmp_path / "copy", lambda codes, index, count: codes, slice(None, None, -3))
    copy = load_subject(tmp_path / "copy")
    true = load_arrays(TINY_SUBJECT / "gt" / "poses.npz")["camera_from_head"]
    assert np.array_equal(load_arrays(tmp_path / "copy" / "gt" / "poses.npz")["camera_from_head"], true[::-3])
    original = sorted((TINY_SUBJECT / "frames").iterdir())[::-3]
    assert len(copy.video_files()) == len(original)
    assert all(
        np.array_equal(read_png(a), read_png(b)) for a, b in zip(copy.video_files(), original, strict=True)
    )


def test_a_wrong_focal_length_is_all_that_changes(tmp_path):
    degrade.degrade_focal(TINY_SUBJECT, tmp_path / "copy", 1.1)
    original, copy = load_subject(TINY_SUBJECT), load_subject(tmp_path / "copy")
    assert copy.focal_length_mm == pytest.approx(1.1 * original.focal_length_mm)
    assert copy.sensor_width_mm == original.sensor_width_mm
    assert [file.read_bytes() for file in copy.video_files()] == [file.read_bytes() for file in original.video_files()]


def test_degraded_landmarks_come_as_a_file_in_source_pixels(tiny_run, tmp_path):
    tracked = tiny_run / "work" / "track_landmarks"
    degrade.degrade_landmarks(TINY_SUBJECT, tracked, tmp_path / "copy", lambda points, yaw, rng: points + [2.0, 0.0])
    content = yaml.safe_load((tmp_path / "copy" / "subject.yaml").read_text())
    assert content["tracking"] == {"landmarks": "landmarks.npz"}
    from shared.io.frames import FrameSet
    from shared.tracking.given_tracking import read_given_landmarks

    frames = FrameSet.open(tiny_run / "work" / "sample_frames")
    points, given = read_given_landmarks(load_subject(tmp_path / "copy").landmarks, frames.frame_index, frames.crop)
    own = load_arrays(tracked / "landmarks.npz")["landmarks_px"]
    assert np.abs(points[given] - own - [2.0 * frames.crop[2], 0.0]).max() < 1e-3


def test_measures_of_the_tiny_subject(tiny_run, tmp_path):
    row = measure(TINY_SUBJECT, tiny_run / "work")
    assert set(row) <= set(COLUMNS)
    assert 0 < row["rotation_mean_deg"] < 0.5 and row["rotation_mean_deg"] <= row["rotation_max_deg"]
    assert row["frames"] + row["excluded"] == 12
    write_table([{"case": "tiny", **row}], tmp_path)
    assert "| tiny | " in (tmp_path / "tracking.md").read_text()
    assert (tmp_path / "tracking.csv").read_text().splitlines()[0] == ",".join(COLUMNS)


def test_a_subject_without_truth_is_refused(tmp_path, capsys):
    assert main([str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "no ground truth" in capsys.readouterr().err
    assert not Path(tmp_path / "out").exists()


def test_a_clip_without_truth_can_be_run_backwards(tmp_path):
    subject = tmp_path / "plain"
    subject.mkdir()
    frames = np.random.default_rng(0).integers(0, 255, (4, 16, 24, 3), np.uint8)
    (subject / "frames").mkdir()
    for number, frame in enumerate(frames):
        write_png(subject / "frames" / f"{number:04d}.png", frame)
    (subject / "subject.yaml").write_text("video: frames/%04d.png\n")
    degrade.degrade_pixels(subject, tmp_path / "copy", degrade.unchanged, slice(None, None, -1))
    for number, frame in enumerate(frames[::-1]):
        assert (read_png(tmp_path / "copy" / "frames" / f"{number:04d}.png") == frame).all()
    assert not (tmp_path / "copy" / "gt").exists()
