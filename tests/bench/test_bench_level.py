"""The bench of the albedo's level: errors of channels and luminance, the stated interval, and what is scored anew."""

import json
from pathlib import Path

import numpy as np
import pytest

from shared.errors import InputError
from shared.imaging.color import LUMINANCE
from tools.bench import level
from tools.bench.level import LevelBench, level_of
from tools.bench.runner import run

SKIN = np.array([0.4, 0.3, 0.2])


def scale_of(low=0.8, high=1.3) -> dict:
    return {"skin_albedo": SKIN.tolist(), "skin_albedo_90": [(low * SKIN).tolist(), (high * SKIN).tolist()],
            "log_sigma": {"luminance": 0.2}, "prior_share": 0.4}


def albedo_scores(gains, squares=(1.0, 1.0, 1.0)) -> dict:
    return {"median_gain": list(gains), "gain": list(squares), "raw": {"delta_e2000_median": 3.0}}


def run_folder(folder: Path, scale: dict, manifest: str = "{}") -> None:
    (folder / "work" / "inverse_render").mkdir(parents=True, exist_ok=True)
    (folder / "work" / "inverse_render" / "solve.json").write_text(json.dumps({"albedo_scale": scale}))
    (folder / "work" / "inverse_render" / "manifest.json").write_text(manifest)


def test_channels_and_luminance_are_logarithms_of_found_over_true():
    row = level_of(scale_of(), albedo_scores((0.5, 1.0, 1.25), squares=(2.0, 1.0, 1.0)))
    np.testing.assert_allclose([row[name] for name in level.CHANNELS], [np.log(2), 0, -np.log(1.25)], atol=1e-12)
    true = SKIN * (0.5, 1.0, 1.25)
    assert row["luminance"] == pytest.approx(np.log((SKIN @ LUMINANCE) / (true @ LUMINANCE)))
    assert row["red_by_squares"] == pytest.approx(-np.log(2)) and row["green_by_squares"] == pytest.approx(0)
    assert row["inside_90"] == 2  # red at half of what was found is below 0.8 of it
    assert (row["sigma"], row["prior_share"], row["raw_de"]) == (0.2, 0.4, 3.0)


def test_a_scale_without_an_interval_is_named():
    with pytest.raises(InputError, match="no interval"):
        level_of({"skin_albedo": SKIN.tolist()}, albedo_scores((1, 1, 1)))


def test_runs_are_scored_once_and_anew_when_solved_anew(tmp_path, monkeypatch, capsys):
    scored = []

    def scores(subject, export):
        scored.append((subject.name, export.relative_to(tmp_path).as_posix()))
        return {"albedo": albedo_scores((1.1, 1.1, 1.1) if subject.name == "a" else (0.7, 1.0, 1.0))}

    monkeypatch.setattr(level, "score", scores)
    for name in "ab":
        run_folder(tmp_path / "runs" / name, scale_of())
    arguments = ["a", "b", "--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]
    assert run(LevelBench, "tools.bench level", arguments) == 0
    assert scored == [("a", "runs/a/export"), ("b", "runs/b/export")]
    said = capsys.readouterr().out
    assert "2 subjects: the median channel is off by 10 %; 5 of 6 inside the stated 90 % interval" in said
    assert run(LevelBench, "tools.bench level", arguments) == 0 and len(scored) == 2
    run_folder(tmp_path / "runs" / "b", scale_of(), manifest='{"version": 2}')
    assert run(LevelBench, "tools.bench level", arguments) == 0 and scored[2:] == [("b", "runs/b/export")]
    rows = json.loads((tmp_path / "out" / "level.json").read_text())["rows"]
    assert [row["case"] for row in rows] == ["a", "b"]


def test_a_run_that_is_not_there_fails_by_name(tmp_path, capsys):
    arguments = ["a", "--runs", str(tmp_path), "--out", str(tmp_path / "out")]
    assert run(LevelBench, "tools.bench level", arguments) == 1
    assert "a stage has not run" in capsys.readouterr().err
