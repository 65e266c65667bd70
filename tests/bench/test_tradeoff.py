"""The chart of speed against accuracy: its cases, its measuring, its table."""

import csv
import shutil
import sys

import numpy as np
import pytest
from toy_runs import TOY, make_subject
from toy_tradeoff import ERROR, LIKENESS, POINTS

from shared.contract.confine import trust
from shared.contract.pipeline import load_pipeline
from shared.contract.subject import load_subject
from shared.errors import InputError
from shared.io.arrays import load_arrays, read_json, save_arrays, write_json
from tools.bench.chart import command as chart
from tools.bench.chart import runs as tradeoff_runs
from tools.bench.chart.cases import ABLATIONS, GROUPS, PEER, PRESET, QUICK, ChartCase, all_cases, chosen_cases
from tools.bench.chart.rows import Rows, csv_row, higher_is_better, pareto_front, row_costs, summarise
from tools.bench.chart.runs import ProcessCost, Runs, Solved, fingerprints, measured
from tools.bench.chart.scores import flat, scores_of
from tools.goldens.tiny import TINY_SUBJECT
from tools.scoring.score import camera_intrinsics, score

CLIP = {"frames": 48, "height": 400}


# ---------------------------------------------------------------- cases
@pytest.mark.parametrize(("which", "base"), [("quick", "draft"), ("all", "standard")])
def test_every_case_differs_from_its_base_and_from_the_others(which, base):
    cases = all_cases(load_pipeline(), base, which, CLIP)
    names = [case.name for case in cases]
    assert len(set(names)) == len(names) and {case.group for case in cases} == set(GROUPS)
    assert {"draft", "standard"} <= set(names) and ("fine" in names) == (which == "all")
    assert f"{base}, 12 frames" in names and f"{base}, no visibility" in names
    # What the clip does not have, and what the preset does anyway, would be the base again.
    assert not {f"{base}, 48 frames", f"{base}, 250 frames", f"{base}, 1024 px"} & set(names)
    assert f"{base}, {load_pipeline().parameters(load_pipeline().stages['inverse_render'], base, {})['directions']} " \
           "directions" not in names


def test_a_larger_clip_has_more_cases():
    few, many = (all_cases(load_pipeline(), "standard", "all", {"frames": n, "height": px}) for n, px in
                 ((48, 400), (300, 1080)))  # fmt: skip
    assert {case.name for case in many} - {case.name for case in few} >= {"standard, 96 frames", "standard, 720 px"}
    assert set(QUICK) <= set(ABLATIONS)


def test_words_choose_cases():
    cases = all_cases(load_pipeline(), "draft", "quick", CLIP)
    assert [case.name for case in chosen_cases(cases, ["matte", "standard"])] == ["draft, matte", "standard"]
    assert [case.name for case in chosen_cases(cases, ["draft"])] == ["draft"]
    with pytest.raises(InputError, match="no such case.*sparkle"):
        chosen_cases(cases, ["sparkle"])


# ---------------------------------------------------------------- measuring
def test_a_process_is_measured(tmp_path):
    work = "import time; t = time.process_time()\nwhile time.process_time() < t + 0.3: pass"
    cost = measured([sys.executable, "-c", f"{work}\ntime.sleep(0.3)"], tmp_path / "log")
    assert cost["wall_s"] > 0.55 and 0.28 < cost["cpu_s"] < cost["wall_s"] and cost["others"] >= 0.0
    with pytest.raises(InputError, match="the last word.*exit code 3"):
        measured([sys.executable, "-c", "print('the last word'); raise SystemExit(3)"], tmp_path / "log")


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """Runs over the toy pipeline, whose draw_bars stands for the solver."""
    monkeypatch.setattr(tradeoff_runs, "_SOLVED", "draw_bars")
    monkeypatch.setattr(tradeoff_runs, "_EXPORTED", "export_page")
    trust([TOY])
    subject = load_subject(make_subject(tmp_path / "poem"))
    return Runs(tmp_path / "work", subject, "its key", load_pipeline(TOY / "pipeline.yaml"), sys.executable)


def test_cases_share_the_stages_that_they_have_in_common(toy):
    narrow = ChartCase("narrow", "ablation", "standard", ("draw_bars.width=2",))
    first, second = toy.solve(ChartCase("plain", PRESET, "standard"))[0], toy.solve(narrow)[0]
    assert first.digest != second.digest
    assert set(first.costs) == {"read_text", "count_words", "draw_bars", "export_page"}
    assert set(second.costs) == {"read_text", "count_words", "draw_bars"}
    assert first.costs["count_words"] == second.costs["count_words"]
    assert len(list(toy.work.glob("*/measured.json"))) == 5


def times_measured(runs):
    """When each stage was measured last: costs themselves may be alike by chance."""
    return {read_json(path)["stage"]: path.stat().st_mtime_ns for path in runs.work.glob("*/measured.json")}


def test_what_is_done_is_kept_until_its_code_changes(toy, monkeypatch):
    case = ChartCase("plain", "ablation", "standard")
    first = toy.solve(case)[0]
    begun = times_measured(toy)
    assert toy.solve(case)[0].costs == first.costs and times_measured(toy) == begun
    monkeypatch.setitem(tradeoff_runs._known, next(name for name in first.code if "draw_bars" in name), "changed")
    assert toy.solve(case)[0].digest == first.digest
    again = times_measured(toy)
    assert {name for name in begun if again[name] != begun[name]} == {"draw_bars"}
    monkeypatch.setitem(tradeoff_runs._known, next(name for name in first.code if "read_text" in name), "changed")
    toy.solve(case)
    anew = times_measured(toy)
    assert {name for name in again if anew[name] != again[name]} == {"read_text", "count_words", "draw_bars"}


def test_a_stage_that_was_cut_off_is_measured_from_its_start(toy):
    case = ChartCase("plain", "ablation", "standard")
    first = toy.solve(case)[0]
    begun = times_measured(toy)
    for path in toy.work.glob("*/measured.json"):
        path.unlink()
    assert toy.solve(case)[0].digest == first.digest
    again = times_measured(toy)
    assert set(again) == set(begun) and all(again[name] > begun[name] for name in begun)


def test_a_stage_that_fails_says_why_and_leaves_the_earlier_ones(toy, monkeypatch):
    monkeypatch.setenv("TOY_FAIL", "1")
    with pytest.raises(InputError, match="abacus|count_words"):
        toy.solve(ChartCase("plain", PRESET, "standard"))
    assert [read_json(path)["stage"] for path in toy.work.glob("*/measured.json")] == ["read_text"]


# ---------------------------------------------------------------- the table
def solved(seconds, digest="d0"):
    costs = {"sample_frames": ProcessCost(5.0, 6.0, 100.0, 0.5),
             "inverse_render": ProcessCost(seconds, 2 * seconds, 900.0, 0.0),
             "export_usd": ProcessCost(7.0, 7.0, 1500.0, 0.0)}  # fmt: skip
    return Solved(None, digest, costs, fingerprints(["tools/bench/chart/rows.py"]))


@pytest.fixture
def rows(tmp_path):
    found = Rows.open(tmp_path / "chart.json", "someone", "key")
    case = ChartCase("draft", PRESET, "draft")
    for repeat, seconds in enumerate((20.0, 10.0, 15.0)):
        found.add(case, repeat, 2, solved(seconds), {ERROR: 1.5, "pose.frames": 48.0})
    found.save()
    return found


def test_rows_come_back_as_long_as_code_and_subject_are_the_same(rows, monkeypatch):
    case = ChartCase("draft", PRESET, "draft")
    again = Rows.open(rows.path, "someone", "key")
    assert again.rows == rows.rows and again.dropped == 0
    assert again.has(case, 2, 2) and not again.has(case, 3, 2) and not again.has(case, 2, 1)
    assert not again.has(ChartCase("draft", PRESET, "draft", ("a.b=1",)), 2, 2)
    assert again.scores_of("d0")[ERROR] == 1.5 and again.scores_of("other") is None
    assert Rows.open(rows.path, "someone", "another clip").dropped == 3
    monkeypatch.setitem(tradeoff_runs._known, "tools/bench/chart/rows.py", "changed")
    stale = Rows.open(rows.path, "someone", "key")
    assert stale.rows == [] and stale.dropped == 3


def test_a_peer_is_measured_when_all_its_seconds_are(rows):
    case = ChartCase("Mitsuba", PEER, "draft", seconds=(60.0, 120.0))
    for at in case.seconds:
        assert not rows.has(case, 0, 2)
        rows.add(case, 0, 2, Solved(None, f"m{at}", {"Mitsuba": ProcessCost(at, at, 1.0, 0.0)}, {}, at), {ERROR: 3.0})
    assert rows.has(case, 0, 2) and rows.rows[-1]["case"] == "Mitsuba, 120 s"


def test_costs_are_those_up_to_the_maps(rows):
    costs = row_costs(rows.rows[0])
    assert costs["seconds"] == 25.0 and costs["seconds_with_export"] == 32.0
    assert costs["cpu_seconds"] == 46.0 and costs["peak_mb"] == 900.0 and costs["others"] == 0.1
    with open(rows.path.with_suffix(".csv"), encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 3 and float(table[1]["inverse_render_s"]) == 10.0 and float(table[0][ERROR]) == 1.5
    assert csv_row(rows.rows[0])["settings"] == "draft"


def test_repeats_become_their_median(rows):
    (found,) = summarise(rows.rows)
    assert found["seconds"] == 20.0 and found["ranges"]["seconds"] == [15.0, 25.0] and found["repeats"] == 3
    assert found["stages"]["inverse_render"] == 15.0 and found["scores"][ERROR] == 1.5


def test_the_front_holds_what_nothing_beats():
    assert pareto_front(POINTS, ERROR) == ["draft, matte", "draft", "standard"]
    assert pareto_front(POINTS, LIKENESS) == ["draft, matte", "draft", "standard"]
    assert pareto_front(POINTS, ERROR, "peak_mb") == ["standard"]
    assert not higher_is_better(ERROR) and higher_is_better(LIKENESS) and higher_is_better("mask_coverage")


def test_scores_become_flat():
    albedo = {"gain": [1.0, 2.0], "raw": {"psnr": 30.123456789}}
    nested = {"subject": "x", "albedo": albedo, "frames": 3, "bad": float("nan")}
    assert flat(nested) == {"albedo.gain.0": 1.0, "albedo.gain.1": 2.0, "albedo.raw.psnr": 30.12346, "frames": 3.0}


# ---------------------------------------------------------------- the scores
def test_the_truth_scores_as_the_truth(tmp_path):
    """The tiny subject's own mesh (of the skin alone), maps, poses and light: off by what its files round."""
    truth, names = TINY_SUBJECT / "gt", {"albedo": "diffuse_albedo", "specular": "specular_intensity"}
    (tmp_path / "maps").mkdir()
    for name in ("albedo", "specular", "roughness"):
        shutil.copyfile(truth / f"{name}.exr", tmp_path / "maps" / f"{names.get(name, name)}.exr")
    for name in ("mesh.obj", "envmap.exr"):
        shutil.copyfile(truth / name, tmp_path / name)
    poses = load_arrays(truth / "poses.npz")["camera_from_head"]
    lens = {"frame_index": np.arange(len(poses)), "intrinsics": camera_intrinsics(TINY_SUBJECT)}
    save_arrays(tmp_path / "poses.npz", camera_from_head=poses, **lens)
    write_json(tmp_path / "solve.json", {"model": {"moves": "head"}})
    scores = scores_of(TINY_SUBJECT, tmp_path)
    assert scores[ERROR] < 0.8 and scores["pose.rotation_deg.mean"] < 0.02 and scores["geometry_mm.median"] < 0.5
    assert scores["envmap.lobe25_correlation"] > 0.999 and scores["rerender.psnr"] > 10.0


def test_a_solved_stage_is_scored_with_pictures(tiny_run):
    """Straight from inverse_render's folder: the maps of the export, and re-renders that look like the clip."""
    scores = scores_of(TINY_SUBJECT, tiny_run / "work" / "inverse_render")
    exported = flat(score(TINY_SUBJECT, tiny_run / "export"))
    assert scores[ERROR] == pytest.approx(exported[ERROR], abs=0.02)
    assert scores["geometry_mm.median"] == exported["geometry_mm.median"]
    assert scores["rerender.psnr"] == pytest.approx(exported["rerender.psnr"], abs=0.5)


# ---------------------------------------------------------------- the command
@pytest.fixture
def command(tmp_path, monkeypatch):
    """chart.main on the tiny subject with a stand-in for the stages; calls: (repeat, case) in order."""
    calls = []

    class StandIn(Runs):
        def solve(self, case):
            calls.append((self.work.name, case.name))
            if case.name == "draft, matte" and "fail" in calls[0]:
                raise InputError("failed", got="a stage")
            return [solved(10.0 + len(calls), f"digest of {case.name}")]

    monkeypatch.setattr(chart, "Runs", StandIn)
    monkeypatch.setattr(chart, "scores_of", lambda subject, folder: {ERROR: 1.0 + 0.1 * len(calls)})
    folders = ["--out", str(tmp_path / "out"), "--work", str(tmp_path / "work")]
    chosen = ["--only", "draft", "standard", "matte"]
    return lambda *more: chart.main([str(TINY_SUBJECT), *folders, *chosen, *more]), calls, tmp_path / "out"


def test_all_cases_are_measured_before_any_is_again(command):
    run, calls, out = command
    assert run("--repeats", "2") == 0
    names = ["draft", "standard", "draft, matte"]
    assert calls == [("repeat0", name) for name in names] + [("repeat1", name) for name in names]
    rows = read_json(out / "chart.json")["rows"]
    assert len(rows) == 6 and rows[0]["scores"] == rows[3]["scores"] != rows[1]["scores"]
    assert "draft" in (out / "chart.svg").read_text() and "standard" in (out / "chart.html").read_text()
    assert run("--repeats", "3") == 0
    assert calls[6:] == [("repeat2", name) for name in names]


def test_a_case_that_fails_does_not_stop_the_others(command, capsys):
    run, calls, out = command
    calls.append("fail")
    assert run("--repeats", "1") == 1
    assert [row["case"] for row in read_json(out / "chart.json")["rows"]] == ["draft", "standard"]
    assert "failed: draft, matte" in capsys.readouterr().err
    calls.clear()
    calls.append("from now on it works")
    assert run("--repeats", "1") == 0 and calls[1:] == [("repeat0", "draft, matte")]


def test_no_case_begins_when_the_minutes_are_over(command):
    run, calls, _ = command
    assert run("--minutes", "0") == 0 and calls == []


def test_it_lists_what_is_there_and_wants_a_truth(command, tmp_path, capsys):
    run, calls, _ = command
    assert run("--list") == 0 and calls == []
    assert "draft, matte: 0 of 1; draft inverse_render.specular=false" in capsys.readouterr().out
    assert chart.main([str(make_subject(tmp_path / "poem"))]) == 2
    assert "no ground truth" in capsys.readouterr().err
