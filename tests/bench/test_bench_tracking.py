"""The tracking bench: its errors, clips that are refused, clips run backwards."""

import shutil
from pathlib import Path

import numpy as np

from shared.io.arrays import read_json
from shared.io.images import read_png, write_png
from tools.bench.runner import run
from tools.bench.tracking import COLUMNS, TrackingBench, errors_of, run_backwards
from tools.goldens.tiny import TINY_SUBJECT


def test_errors_of_the_tiny_subject(tiny_run):
    row = errors_of(TINY_SUBJECT, tiny_run / "work")
    assert set(row) <= set(COLUMNS)
    assert 0 < row["rotation_mean_deg"] < 0.5 and row["rotation_mean_deg"] <= row["rotation_max_deg"]
    assert row["frames"] + row["excluded"] == 12


def test_a_clip_that_a_stage_refuses_is_a_row(tmp_path):
    """A copy of the tiny subject whose clip has gone."""
    subject = tmp_path / "anna"
    shutil.copytree(TINY_SUBJECT, subject, ignore=shutil.ignore_patterns("frames", "work", "export"))
    assert run(TrackingBench, "tracking", [str(subject), "--out", str(tmp_path / "out")]) == 0
    (row,) = read_json(tmp_path / "out" / "tracking.json")["rows"]
    assert row["case"] == "anna" and "sample_frames" in row["warnings"] and "rotation_mean_deg" not in row


def test_a_subject_without_truth_is_refused(tmp_path, capsys):
    assert run(TrackingBench, "tracking", [str(tmp_path), "--out", str(tmp_path / "out")]) == 2
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
    assert run_backwards(subject, tmp_path / "copy") == 4
    for number, frame in enumerate(frames[::-1]):
        assert (read_png(tmp_path / "copy" / "frames" / f"{number:04d}.png") == frame).all()
    assert not (tmp_path / "copy" / "gt").exists()
