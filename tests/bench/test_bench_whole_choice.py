"""The bench of whole runs with a chosen model beside the full one: what it runs, compares and says."""

import json
from pathlib import Path

import pytest

from shared.errors import InputError
from tools.bench import whole_choice
from tools.bench.clips import settings_of
from tools.bench.runner import run
from tools.bench.whole_choice import CANDIDATES, TRACKED, WholeChoiceBench, compare, prepared


def tracked_run(folder: Path) -> Path:
    for stage in (*TRACKED, "inverse_render"):
        (folder / "work" / stage).mkdir(parents=True)
        (folder / "work" / stage / "provenance.json").write_text("{}")
        (folder / "work" / f"{stage}.stamp").write_text("stamp")
    (folder / "work" / "export_usd.stamp").write_text("stamp")
    return folder


def row(candidate, held_out, cpu_s, clip="a", **scores):
    return {"case": clip, "candidate": candidate, "chosen": f"light of {candidate}", "held_out": held_out,
            "cpu_s": cpu_s, "orientation": 0.05, **scores}


def test_auto_stands_beside_full_and_the_best_fixed_candidate():
    rows = [row("auto", 0.0102, 60.0, albedo_de=1.25), row("full", 0.012, 100.0, albedo_de=1.2),
            row("cubemap_8", 0.010, 80.0), row("auto", 1.0, 1.0, clip="b")]
    (found,) = compare(rows)
    assert found["clip"] == "a" and found["chosen"] == "light of auto" and found["best"] == "cubemap_8"
    assert found["time"] == pytest.approx(0.6) and found["error"] == pytest.approx(0.85)
    assert found["of_best"] == pytest.approx(1.02)
    assert found["albedo_de"] == "1.2 · 1.25" and found["orientation"] == "0.05 · 0.05"
    assert compare(rows[1:]) == []


def test_a_run_starts_from_a_copy_of_what_was_tracked_and_no_more(tmp_path):
    root = prepared(tracked_run(tmp_path / "tracked"), tmp_path / "new")
    assert sorted(path.name for path in (root / "work").iterdir()) == sorted(
        [*TRACKED, *(f"{stage}.stamp" for stage in TRACKED)])
    (tmp_path / "tracked" / "work" / "init_albedo" / "provenance.json").unlink()
    with pytest.raises(InputError, match="a stage has not run"):
        prepared(tmp_path / "tracked", root)
    assert (root / "work").is_dir()  # what was there stays


def test_each_candidate_runs_once_on_each_subject_and_a_later_one_joins_them(tmp_path, monkeypatch, capsys):
    commands = []

    def launched(command, log):
        commands.append(command[2:])
        return {}

    monkeypatch.setattr(whole_choice, "measured", launched)
    monkeypatch.setattr(whole_choice, "row_of", lambda subject, root: {
        name: value for name, value in row("", 0.01, 50.0 if root.parent.name == "auto" else 100.0).items()
        if name not in ("case", "candidate")})
    tracked_run(tmp_path / "runs" / "ada")
    arguments = [str(tmp_path / "ada"), "--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]
    assert run(WholeChoiceBench, "bench", arguments) == 0
    assert sorted(command[0] for command in commands) == ["stages.export_usd"] * 2 + ["stages.inverse_render"] * 2
    assert sum("--set=model=full" in command for command in commands) == 1
    assert "ada: time 0.50, error 1.000 of full's" in capsys.readouterr().out
    assert run(WholeChoiceBench, "bench", [*arguments, "--candidates", "auto", "full", "harmonics_4"]) == 0
    assert len(commands) == 6 and "--set=light_model=harmonics_4" in {*commands[4], *commands[5]}
    rows = json.loads((tmp_path / "out" / "whole_choice.json").read_text())["rows"]
    assert {found["candidate"] for found in rows} == {"auto", "full", "harmonics_4"}
    assert "\n| clip | chosen |" in (tmp_path / "out" / "whole_choice.md").read_text()


@pytest.mark.parametrize("candidate", CANDIDATES)
def test_its_settings_are_the_stages(candidate):
    settings = settings_of(CANDIDATES[candidate])
    assert (settings.selection is None) == (candidate != "auto")
    assert settings.appearance.light_model == CANDIDATES[candidate].get("light_model", "cubemap")
