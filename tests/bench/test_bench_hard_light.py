"""The hard-light bench: its cases, the subjects it takes, and a row of a run that is there."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest
from quick import TINY

from shared.errors import InputError
from shared.io.arrays import read_json, write_json
from tools.bench import hard_light
from tools.bench.hard_light import CLIPS, HardLightBench, all_cases, has_made
from tools.bench.runner import run
from tools.synthesis.subject import parse

SCAN = [Path("heads/anna"), Path("heads/ben")]


def bench(*words):
    return run(HardLightBench, "hard_light", list(words))


def listed(capsys, *words):
    assert bench(*words, "--list") == 0
    return [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()]


def settings_of(name, frames=100, scans=()):
    return parse(["folder", *all_cases(list(scans))[name].arguments(frames)])[1]


@pytest.fixture
def scan(tmp_path):
    """A folder that has a truth."""
    (tmp_path / "scan" / "gt").mkdir(parents=True)
    return tmp_path / "scan"


def test_cases_film_every_head_in_every_way():
    cases = all_cases(SCAN)
    assert len(cases) == len(CLIPS) * 3 and {"scan_25", "scan2_25", "synthetic_25_apart"} < set(cases)
    assert cases["scan2_40"].scan == SCAN[1] and cases["synthetic_40"].scan is None
    settings = settings_of("scan_25_1024", 64, SCAN)
    assert (settings.size, settings.frames, settings.clipped, settings.scan) == (1024, 64, 0.25, "heads/anna")
    assert settings.lights[0] == "lamp" and settings.seed == settings_of("scan_10", scans=SCAN).seed
    assert settings_of("scan_25_apart", scans=SCAN).seed != settings.seed != settings_of("synthetic_25").seed


def test_what_lies_apart_is_measured_only_where_it_is_named(tmp_path, capsys, scan):
    out = ("--out", str(tmp_path / "out"))
    usual = listed(capsys, *out, "--scan", str(scan))
    assert len(usual) == 8 and not any("apart" in name for name in usual)
    assert listed(capsys, *out, "--only", "synthetic") == [name for name in usual if "synthetic" in name]
    assert listed(capsys, *out, "--only", "synthetic_25_apart") == ["synthetic_25_apart"]
    assert listed(capsys, *out, "--only", "apart") == ["synthetic_25_apart", "scan_25_apart"]
    assert bench(*out, "--table") == 0 and not (tmp_path / "out").exists()


def test_without_a_scan_its_cases_say_so_and_are_left_out(tmp_path, capsys):
    assert bench("--out", str(tmp_path / "out"), "--only", "scan") == 0
    said = capsys.readouterr().out
    assert said.count("left out, no scan is given") == 4 and not (tmp_path / "out").exists()
    assert bench("--out", str(tmp_path / "out"), "--scan", str(tmp_path)) == 2
    assert "no ground truth" in capsys.readouterr().err


def test_a_subject_is_kept_where_it_was_made_by_the_same_arguments(tmp_path):
    wanted = settings_of("scan_25", scans=SCAN)
    assert not has_made(tmp_path, wanted)
    (tmp_path / "subject.yaml").touch()
    (tmp_path / "synthesis.json").write_text(json.dumps(asdict(wanted) | {"scan": "elsewhere/anna"}))
    assert has_made(tmp_path, wanted)
    made = read_json(tmp_path / "synthesis.json")
    write_json(tmp_path / "synthesis.json", {name: value for name, value in made.items() if name != "gaze"})
    assert has_made(tmp_path, wanted), "made before there was such a setting"
    with pytest.raises(InputError, match="was made by other arguments.*seed 12"):
        has_made(tmp_path, settings_of("scan_25_apart", scans=SCAN))
    with pytest.raises(InputError, match="scan anna"):
        has_made(tmp_path, settings_of("scan_25", scans=SCAN[1:]))


def test_a_given_subject_is_run_and_measured_once(tiny_run, tmp_path, monkeypatch, capsys):
    """The tiny subject, as if it had been made by the case's arguments, and its run as `limn run` would leave it."""
    subject, out, commands = tmp_path / "tiny", tmp_path / "out", []
    shutil.copytree(TINY, subject, ignore=shutil.ignore_patterns("work", "export"))
    (subject / "synthesis.json").write_text(json.dumps(asdict(settings_of("synthetic_25"))))

    def run_there(command, log, well=(0,)):
        commands.append(command)
        shutil.copytree(tiny_run, Path(command[-2]) / "tiny")

    monkeypatch.setattr(hard_light, "measured", run_there)
    words = ("--out", str(out), "--only", "synthetic_25", "--given", f"synthetic_25={subject}")
    assert bench(*words) == bench(*words) == bench(*words, "--table") == 0
    assert len(commands) == 1 and "tools.limn" in commands[0] and str(subject) in commands[0]
    table = read_json(out / "hard_light.json")
    (row,) = table["rows"]
    assert row["case"] == "synthetic_25" and row["frames"] == 12 and row["scan"] == ""
    assert "stages/inverse_render.py" in table["code"]["synthetic_25"]
    assert "| synthetic_25 |" in (out / "hard_light.md").read_text()
    assert bench("--out", str(out), "--given", f"nobody={subject}") == 2
    assert "no such case" in capsys.readouterr().err


def test_a_row_of_other_code_or_of_another_scan_is_dropped(tmp_path, capsys, scan):
    facts = {"frames": 100, "versions": {name: stage.version for name, stage in
                                         hard_light.load_pipeline(None).stages.items()}}  # fmt: skip
    rows = [{"case": "synthetic_25", "repeat": 0, "scan": ""}, {"case": "synthetic_10", "repeat": 0, "scan": ""},
            {"case": "scan_25", "repeat": 0, "scan": "someone"}]  # fmt: skip
    code = {"synthetic_10": {"stages/inverse_render.py": "of another day"}}
    (tmp_path / "hard_light.json").write_text(json.dumps({**facts, "rows": rows, "code": code}))
    assert bench("--out", str(tmp_path), "--scan", str(scan), "--list") == 0
    done = [line for line in capsys.readouterr().out.splitlines() if line.endswith("1 of 1")]
    assert done == ["synthetic_25: 1 of 1"]
