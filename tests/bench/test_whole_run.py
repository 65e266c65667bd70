"""The row of a whole run: its measures in closed form, and all of them on the tiny subject."""

import shutil

import numpy as np
import pytest
from quick import TINY

from shared.geometry.transforms import rigid, rotation_from_vector
from shared.io.arrays import read_json
from shared.tracking.texture_tracks import MeanContrast
from tools.bench.whole_run import COLUMNS, gradient_energies, in_head_frame_of, main
from tools.scoring.rotations import rotation_errors


def test_poses_are_brought_into_another_head_frame():
    rng = np.random.default_rng(0)
    poses = rigid(rotation_from_vector(rng.normal(size=(8, 3))), rng.normal(size=(8, 3)) * 20.0 + [0.0, 0.0, 900.0])
    moved = poses @ rigid(rotation_from_vector(np.array([0.02, -0.01, 0.03])), np.array([1.0, -2.0, 0.5]))
    np.testing.assert_allclose(in_head_frame_of(poses, moved), moved, atol=1e-9)


def test_errors_of_poses_that_tremble_by_a_known_angle():
    """Every other frame turned by 0.2 degrees about one axis: the error is 0.1 after a common turn, its second
    difference 0.4."""
    true = np.tile(rigid(np.eye(3), np.array([0.0, 0.0, 900.0])), (10, 1, 1))
    found = true.copy()
    found[::2, :3, :3] = rotation_from_vector(np.radians([0.0, 0.2, 0.0]))
    covariance = np.tile(np.radians(0.1) ** 2 * np.eye(6), (10, 1, 1))
    errors = rotation_errors({"camera_from_head": found, "frame_index": np.arange(10), "covariance": covariance}, true)
    assert errors["rotation_mean_deg"] == pytest.approx(0.1, rel=1e-4)
    assert errors["rotation_max_deg"] == pytest.approx(0.1, rel=1e-4)
    assert errors["acceleration_deg"] == pytest.approx(0.4, rel=1e-4) and errors["covered"] == 1.0


def test_a_blurred_texture_holds_less_detail():
    """Stripes of a known slope; what one of the two does not know counts in neither."""
    ramp = np.tile(np.arange(20, dtype=np.float32), (10, 1))
    seen = np.full(ramp.shape, 9.0, np.float32)
    partly = seen.copy()
    partly[:, 12:] = 1.0
    steep = np.where(np.arange(20) < 12, 2.0 * ramp, 900.0 * ramp).astype(np.float32)
    found = gradient_energies([MeanContrast(ramp, ramp, seen), MeanContrast(steep, ramp, partly)])
    assert found == pytest.approx([1.0, 4.0])


def test_a_row_of_the_tiny_subject(tiny_run, tmp_path, capsys):
    assert main([str(TINY), str(tiny_run), "--json", str(tmp_path / "row.json")]) == 0
    row = read_json(tmp_path / "row.json")
    assert set(row) == set(COLUMNS) and "rotation_mean_deg" in capsys.readouterr().out
    assert row["frames"] == 12 and row["rerendered"] == 1 and row["relit_db"] is None
    assert 0.0 < row["rotation_mean_deg"] <= row["rotation_max_deg"] < 1.0 and 0.0 <= row["covered"] <= 1.0
    assert row["detail"] > 0.0 and row["tracked_detail"] > 0.0 and row["albedo_db"] > 20.0
    assert 0.5 < row["confident_share"] <= 1.0 and 0.5 < row["confident_within_8"] <= 1.0
    assert 0.0 < row["solve_wall_s"] < row["wall_s"] and row["solve_cpu_s"] < row["cpu_s"] and row["peak_mb"] > 100


def test_what_is_missing_is_said(tiny_run, tmp_path, capsys):
    assert main([str(tmp_path), str(tiny_run)]) == 2 and "no ground truth" in capsys.readouterr().err
    shutil.copytree(tiny_run / "work" / "sample_frames", tmp_path / "work" / "sample_frames")
    assert main([str(TINY), str(tmp_path)]) == 2 and "a stage has not run" in capsys.readouterr().err
