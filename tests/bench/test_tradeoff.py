"""The chart of speed against accuracy: its cases, its measuring, its table."""

import shutil
import sys

import numpy as np
import pytest
from toy_runs import TOY, make_subject
from toy_tradeoff import ERROR, LIKENESS, POINTS

from shared.contract.confine import trust
from shared.contract.pipeline import REPOSITORY, load_pipeline
from shared.contract.subject import load_subject
from shared.errors import InputError
from shared.io.arrays import load_arrays, read_json, save_arrays, write_json
from tools.bench.chart import bench as chart
from tools.bench.chart import runs as tradeoff_runs
from tools.bench.chart.bench import ChartBench
from tools.bench.chart.cases import ABLATIONS, GROUPS, PRESET, QUICK, ChartCase, all_cases
from tools.bench.chart.rows import chart_row, csv_row, higher_is_better, pareto_front, row_costs, summarise
from tools.bench.chart.runs import ProcessCost, Runs, Solved, fingerprints
from tools.bench.chart.scores import flat, scores_of
from tools.bench.runner import Table, run
from tools.goldens.tiny import TINY_SUBJECT
from tools.scoring.score import camera_intrinsics

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
    assert f"{base}, {'mesh held' if base == 'draft' else 'mesh refined'}" not in names


def test_a_larger_clip_has_more_cases():
    few, many = (all_cases(load_pipeline(), "standard", "all", {"frames": n, "height": px}) for n, px in
                 ((48, 400), (300, 1080)))  # fmt: skip
    assert {case.name for case in many} - {case.name for case in few} >= {"standard, 96 frames", "standard, 720 px"}
    assert set(QUICK) <= set(ABLATIONS)


# ---------------------------------------------------------------- measuring
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
def solved(seconds, digest="d0", at=None):
    costs = {"sample_frames": ProcessCost(5.0, 6.0, 100.0, 0.5),
             "inverse_render": ProcessCost(seconds, 2 * seconds, 900.0, 0.0),
             "export_usd": ProcessCost(7.0, 7.0, 1500.0, 0.0)}  # fmt: skip
    return Solved(None, digest, costs, fingerprints(["tools/bench/chart/rows.py"]), at)


@pytest.fixture
def rows():
    case, scores = ChartCase("draft", PRESET, "draft"), {ERROR: 1.5, "pose.frames": 48.0}
    return [chart_row(case, 2, solved(seconds), {}, scores) | {"repeat": k}
            for k, seconds in enumerate((20.0, 10.0, 15.0))]


def test_costs_are_those_up_to_the_maps(rows):
    costs = row_costs(rows[0])
    assert costs["seconds"] == 25.0 and costs["seconds_with_export"] == 32.0
    assert costs["cpu_seconds"] == 46.0 and costs["peak_mb"] == 900.0 and costs["others"] == 0.1
    line = csv_row(rows[1])
    assert line["inverse_render_s"] == 10.0 and line[ERROR] == 1.5 and line["settings"] == "draft"


def test_repeats_become_their_median(rows):
    (found,) = summarise(rows)
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


def test_a_solved_stage_is_scored_with_pictures(tiny_run, tiny_scores):
    """Straight from inverse_render's folder: the maps of the export, and re-renders that look like the clip."""
    scores = scores_of(TINY_SUBJECT, tiny_run / "work" / "inverse_render")
    exported = flat(tiny_scores)
    assert scores[ERROR] == pytest.approx(exported[ERROR], abs=0.02)
    assert scores["geometry_mm.median"] == exported["geometry_mm.median"]
    assert scores["rerender.psnr"] == pytest.approx(exported["rerender.psnr"], abs=0.5)


# ---------------------------------------------------------------- the bench
@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Runs the chart of the tiny subject with a stand-in for the stages -> chart.json; calls: (repeat, case)."""
    calls = []

    class StandIn(Runs):
        def solve(self, case):
            calls.append((self.work.name, case.name))
            return [solved(10.0 + len(calls), f"digest of {case.name}", at) for at in case.seconds or (None,)]

    monkeypatch.setattr(chart, "Runs", StandIn)
    monkeypatch.setattr(chart, "scores_of", lambda subject, folder: {ERROR: 1.0 + 0.1 * len(calls)})
    folders = ["--out", str(tmp_path / "out"), "--work", str(tmp_path / "work"), "--peer-python", sys.executable]

    def measure(*words):
        assert run(ChartBench, "chart", [str(TINY_SUBJECT), *folders, *words]) == 0
        return read_json(tmp_path / "out" / "chart.json")

    return measure, calls, tmp_path / "out"


def test_a_result_is_scored_once_and_a_peer_has_a_row_for_each_of_its_seconds(bench):
    measure, calls, out = bench
    words = "--only", "standard", "matte", "Mitsuba", "--repeats", "2"
    content = measure(*words)
    assert [row["case"] for row in content["rows"][:4]] == ["standard", "draft, matte", "Mitsuba, 30 s",
                                                            "Mitsuba, 90 s"]
    assert [row["repeat"] for row in content["rows"]] == [0] * 4 + [1] * 4
    assert content["rows"][0]["scores"] == content["rows"][4]["scores"] != content["rows"][1]["scores"]
    assert measure(*words) == content and len(calls) == 6
    assert {path.name for path in out.iterdir()} == {f"chart.{kind}" for kind in ("json", "csv", "md", "svg")}


def test_rows_come_back_as_long_as_the_code_is_the_same(bench, monkeypatch):
    measure, calls, _ = bench
    content = measure("--only", "draft")
    assert [set(content["code"])] == [{row["code"]} for row in content["rows"]]
    monkeypatch.setitem(tradeoff_runs._known, "tools/bench/chart/rows.py", "changed")
    assert set(measure("--only", "draft")["code"]).isdisjoint(content["code"]) and len(calls) == 2


def test_other_threads_are_another_measurement(bench, monkeypatch):
    measure, calls, _ = bench
    measure("--only", "draft")
    monkeypatch.setattr(chart.os, "sched_getaffinity", lambda process: range(1000))
    (row,) = measure("--only", "draft")["rows"]
    assert row["threads"] == 1000 and len(calls) == 2


def test_a_subject_without_truth_is_refused(tmp_path, capsys):
    subject = make_subject(tmp_path / "poem")
    assert run(ChartBench, "chart", [str(subject), "--out", str(tmp_path / "out"), "--work", str(tmp_path)]) == 2
    assert "no ground truth" in capsys.readouterr().err


def test_the_published_table_can_still_be_read():
    """docs/chart.json, from which the README's table is made."""
    table = Table.open(REPOSITORY / "docs" / "chart.json", {"schema": chart.SCHEMA})
    assert {"draft", "standard"} <= {point["name"] for point in summarise(table.rows)} and not table.dropped
    assert all(row["code"] in table.beside["code"] and csv_row(row)["case"] == row["case"] for row in table.rows)
