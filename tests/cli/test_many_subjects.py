"""Many subjects in one call: folders and lists, table, summary.json, quality gates, status of a run, retries."""

import json
import os
import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from toy_runs import CURRENT_STAGES, limn, limn_process, make_subject, tree, wait_for

from shared.contract import launch
from shared.contract.needs import WorkSize, amount, measured_scale, parse_needs
from shared.contract.pipeline import Gate
from shared.errors import InputError
from tools.cli.cases import find_subjects
from tools.cli.resources import memory_to_give, requested
from tools.limn import main


@pytest.fixture
def batch(tmp_path):
    """A folder of four subjects: two good ones, one without a face, one whose clip is gone."""
    folder = tmp_path / "batch"
    for name in ("anna", "bert"):
        make_subject(folder / name)
    make_subject(folder / "faceless", "no face in here\n")
    make_subject(folder / "gone", settings="video: gone.mp4\n")
    (folder / "notes").mkdir()
    return folder


def test_folder_of_subjects_table_and_summary(pipeline, batch, capsys):
    code, output = limn("run", batch, "--pipeline", pipeline)
    assert code == 2 and output.endswith(f"summary: {batch / 'summary.json'}\n")
    assert "4 subjects: 2 done, 2 input error" in output and "notes" not in output
    summary = json.loads((batch / "summary.json").read_text())
    assert summary["schema"] == 1 and summary["exit_code"] == 2
    states = {record["subject"]: (record["state"], record["stage"]) for record in summary["subjects"]}
    assert states == {"anna": ("done", "export_page"), "bert": ("done", "export_page"),
                      "faceless": ("input error", "read_text"), "gone": ("input error", "")}
    assert all(record["memory_mb"] > 1 and record["bytes"] > 100 for record in summary["subjects"][2:3])
    assert "no such video" in next(r["reason"] for r in summary["subjects"] if r["subject"] == "gone")
    assert main(["status", str(batch), "--pipeline", str(pipeline), "--json"]) == 2
    records = json.loads(capsys.readouterr().out)
    assert [record["subject"] for record in records] == ["anna", "bert", "faceless"]
    assert {stage["state"] for stage in records[0]["stages"]} == {"current"} and not records[0]["running"]


def test_list_of_subjects(tmp_path, batch):
    listed = tmp_path / "list.txt"
    listed.write_text("# mine\nbatch/anna   # the first\n\nbatch/bert\n")
    assert find_subjects([], listed) == [batch / "anna", batch / "bert"]
    assert find_subjects([batch]) == [batch / name for name in ("anna", "bert", "faceless", "gone")]
    with pytest.raises(InputError, match="no subjects"):
        find_subjects([])
    with pytest.raises(InputError, match="list of subjects"):
        find_subjects([], tmp_path / "gone.txt")


def test_status_shows_a_running_stage(pipeline, tmp_path, capsys):
    subject = make_subject(tmp_path / "anna")
    process = limn_process("run", subject, "--pipeline", pipeline, TOY_PAUSE_S="300")
    arguments = ["status", str(subject), "--pipeline", str(pipeline)]

    def told():
        assert main(arguments) == 0
        text = capsys.readouterr().out
        return "pause" in text and text

    text = wait_for(told)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=120)
    assert "a run works on it" in text and re.search(r"count_words +running", text)
    assert re.search(r"since \d+ s: pause \d+/3000", text)
    assert main(arguments) == 0
    assert not re.search(r"a run works on it|count_words +running", capsys.readouterr().out)


def test_missed_gate_is_flagged(pipeline, tmp_path, monkeypatch):
    from tools.cli import gates

    subject = make_subject(tmp_path / "anna")
    pipeline.write_text(pipeline.read_text() + "gates: {coverage: {least: 0.6}}\n")
    monkeypatch.setattr("tools.cli.review_picture.write_review",
                        lambda run, names, titles: (run.work / gates.PICTURE).write_text(f"{names} {titles}"))
    monkeypatch.setitem(gates.MEASURES, "coverage", lambda run: 0.25)
    summary = tmp_path / "all.json"
    arguments = ["run", str(subject), "--pipeline", str(pipeline), "--summary", str(summary)]
    assert main(arguments) == 3 and (subject / "export" / "page.txt").is_file()
    record = json.loads(summary.read_text())["subjects"][0]
    assert record["state"] == "review" and record["flags"][0]["value"] == 0.25
    assert record["picture"] == str(subject / "work" / "review.png") and "0.6 or more" in record["reason"]
    assert main(arguments) == 3
    monkeypatch.setitem(gates.MEASURES, "coverage", lambda run: 0.75)
    assert main([*arguments, "--set", "export_page.title=Roses"]) == 0
    assert not (subject / "work" / "review.png").exists()
    assert main(["clean", str(subject), "--pipeline", str(pipeline)]) == 0
    assert tree(subject / "work") == [] if (subject / "work").exists() else True


@pytest.mark.parametrize("text, hint", [
    ("coverrage: {least: 0.5}", "did you mean coverage?"), ("coverage: {}", "without limits"),
    ("coverage: {least: much}", "a number"), ("coverage: {lest: 1}", "did you mean least?")])
def test_bad_gate_is_one_line(pipeline, tmp_path, capsys, text, hint):
    subject = make_subject(tmp_path / "anna")
    pipeline.write_text(pipeline.read_text() + f"gates: {{{text}}}\n")
    assert main(["run", str(subject), "--pipeline", str(pipeline)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and hint in error and tree(subject) == ["clip.txt", "subject.yaml"]


def test_gates_of_the_tracking_say_a_wrong_lens_and_a_head_that_hardly_turns(tmp_path):
    from shared.contract.folders import RunFolder
    from shared.contract.pipeline import load_pipeline
    from shared.io.arrays import write_json
    from tools.cli import gates, measures

    run = RunFolder(tmp_path)
    folder = run.published("track_landmarks")
    folder.mkdir(parents=True)

    def missed(p95=0.45, turned=54.0, gain=1.02, solved=False):
        write_json(folder / "tracking.json", {
            "reprojection_px": {"median": 0.1, "p95": p95}, "rotation_range_deg": turned,
            "focal": {"gain": gain, "log_deviation": 0.04, "solved": solved}})
        limits = load_pipeline(None).gates
        values = {name: gates.MEASURES[name](run) for name in limits}
        return [name for name, value in values.items() if value is not None and not limits[name].holds(value)]

    assert missed() == [] and missed(gain=1.1) == [] and missed(gain=3.0, solved=True) == []
    assert missed(p95=1.27) == ["reprojection_p95_px"]
    assert missed(turned=0.03) == ["rotation_range_deg"]
    assert missed(gain=3.0) == ["focal_off"] == missed(gain=1 / 3) == missed(gain=1.5)
    write_json(folder / "tracking.json", {"reprojection_px": "none", "focal": [1]})
    assert measures.focal_off(run) is None and measures.reprojection_p95_px(run) is None


def test_gate_limits():
    assert Gate(least=0.5).holds(0.5) and not Gate(least=0.5).holds(0.49)
    assert Gate(0.1, 0.2).holds(0.15) and not Gate(0.1, 0.2).holds(0.3) and not Gate(most=1.0).holds(float("nan"))


def test_hair_is_no_fault_of_a_clip(tmp_path):
    """A quarter of the map is hair with little confidence, another is not seen."""
    from shared.contract.folders import RunFolder
    from shared.imaging.material_labels import HAIR, LABELS, SKIN
    from shared.io.images import write_exr
    from shared.io.material_maps import write_material
    from tools.cli.measures import confidence, coverage

    run, maps = RunFolder(tmp_path), tmp_path / "export" / "maps"
    maps.mkdir(parents=True)
    label, values = np.full((8, 8), SKIN), np.full((8, 8), 0.9, np.float32)
    label[:4, :4], values[:4, :4], values[4:, 4:] = HAIR, 0.2, 0.0
    write_exr(maps / "confidence.exr", values, colour_space="data")
    assert coverage(run) == pytest.approx(2 / 3)
    write_material(maps / "material.exr", np.eye(len(LABELS), dtype=np.float32)[label], half=True, attributes={})
    assert coverage(run) == 1.0 and confidence(run) == pytest.approx(0.9)


def test_gates_of_a_real_result(tiny_run, tmp_path):
    from shared.contract.folders import RunFolder
    from shared.io.images import read_png
    from tools.cli import gates, review_picture

    run = RunFolder(tiny_run)
    values = {name: measure(run) for name, measure in gates.MEASURES.items()}
    assert 0.01 < values["reprojection_px"] < 0.4 and 0.01 < values["held_out_residual"] < 0.06
    assert values["reprojection_px"] < values["reprojection_p95_px"] < 0.6 and values["focal_off"] == 0.0
    assert 40 < values["rotation_range_deg"] < 70
    assert 0.5 < values["coverage"] < 1 and 0.5 < values["confidence"] < 1
    picture = run.work / gates.PICTURE
    review_picture.write_review(run, list(values), [f"{name} {value:.3f}" for name, value in values.items()])
    shown = read_png(picture)
    picture.unlink()
    assert shown.shape[1] == review_picture.WIDTH_PX and shown.shape[0] > 2 * review_picture.WIDTH_PX
    assert shown.std() > 20


def test_needs_grow_with_the_work(tmp_path):
    needs = parse_needs({"mem_mb": {"base": 100, "frame": 1, "frame_megapixel": 2, "map_megapixel": 50}}, "here")
    large = WorkSize(frames=200, crop_px=1000, map_px=2000)
    assert amount(needs, "mem_mb", large) == 100 + 200 + 400 + 200 and amount(needs, "runtime", large) is None
    scale = {"frames": 200, "crop_px": 1000, "map_px": 2000}
    assert [requested(needs, "mem_mb", scale, tmp_path, attempt, None) for attempt in (1, 2)] == [900, 1800]
    assert requested(needs, "mem_mb", scale, tmp_path, 2, 1000) == 1000
    folder = tmp_path / "work" / "sample_frames"
    folder.mkdir(parents=True)
    (folder / "frames.json").write_text(json.dumps({"size": [400, 900], "frames": [{}] * 50}))
    assert measured_scale(tmp_path, large) == WorkSize(50, 600.0, 2000)
    with pytest.raises(InputError, match="did you mean frame?"):
        parse_needs({"mem_mb": {"fame": 1}}, "here")
    assert memory_to_give() > 100


def test_killed_jobs_are_tried_again_and_failed_ones_are_not(tmp_path, monkeypatch):
    events = tmp_path / "events.jsonl"
    monkeypatch.setenv("LIMN_ATTEMPT", "2")
    for kinds, code in ((["started", "progress"], None), (["started", "failed"], 1), (["input_error"], 2)):
        events.write_text("".join(json.dumps({"kind": kind}) + "\n" for kind in kinds))
        assert launch.earlier_verdict(events) == code
    events.write_text('{"kind": "fail')
    assert launch.earlier_verdict(events) is None
    monkeypatch.setenv("LIMN_ATTEMPT", "1")
    assert launch.earlier_verdict(events) is None


def test_events_that_are_none_are_passed_over(tmp_path):
    from tools.cli.watch import Track

    lines = ['{"kind": "started", "time": 3}', '{"kind": "started"}', "7", '{"kind": ["a"]}', "{", '{"kind": "b"}',
             '{"kind": "progress", "label": 1, "done": 2, "total": 3}', '{"kind": "progress", "label": "a", "done": 2}',
             '{"kind": "progress", "label": "light", "done": 2, "total": null}']
    (tmp_path / "a.jsonl").write_text("\n".join(lines) + "\n")
    track = Track("anna", "read_text", tmp_path / "a.jsonl")
    for event in track.new_events():
        track.apply(event)
    assert (track.state, track.since, track.progress) == ("running", 3, "light 2")


def test_too_little_space_is_told_before_a_stage_starts(pipeline, tmp_path, capsys):
    subject = make_subject(tmp_path / "anna")
    text = pipeline.read_text().replace("{needs: []}", "{needs: [], resources: {disk_mb: 1.0e+9}}")
    pipeline.write_text(text)
    code, output = limn("run", subject, "--pipeline", pipeline)
    assert code == 2 and re.search(r"not enough space on the disk; got \d+ MB; expected about 1100000000 MB", output)
    assert tree(subject) == ["clip.txt", "subject.yaml"]


def test_a_flipped_bit_is_noticed_before_use(pipeline, tmp_path, toy_run):
    subject = shutil.copytree(toy_run[0], tmp_path / "anna")
    page = (subject / "export" / "page.txt").read_bytes()
    bars = subject / "work" / "draw_bars" / "bars.txt"
    flip(bars)
    code, output = limn("run", subject, "--pipeline", pipeline, "--set", "export_page.title=Roses")
    assert code == 0 and re.search(r"draw_bars +done", output)
    assert limn("run", subject, "--pipeline", pipeline)[0] == 0
    assert (subject / "export" / "page.txt").read_bytes() == page
    hidden_flip(subject, bars)
    code, output = limn("run", subject, "--pipeline", pipeline, "--set", "export_page.title=Roses")
    assert code == 2 and "input draw_bars: file bars.txt is damaged" in output
    assert limn("run", subject, "--pipeline", pipeline)[0] == 0
    assert (subject / "export" / "page.txt").read_bytes() == page


def flip(path: Path):
    """One bit, the time of change set back."""
    times = path.stat()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def hidden_flip(subject: Path, path: Path):
    """One bit, and the remembered state as if the file had never been touched: what a failing disk does."""
    flip(path)
    memory = subject / "work" / ".hashes.json"
    known = json.loads(memory.read_text())
    stat = path.stat()
    entry = known[os.path.relpath(path, memory.parent)]
    entry[:3] = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]
    memory.write_text(json.dumps(known))


def test_stages_of_different_subjects_run_side_by_side(pipeline, tmp_path):
    folder = tmp_path / "batch"
    for i in range(4):
        make_subject(folder / f"s{i}")
    code, output = limn("run", folder, "--pipeline", pipeline, "--cores", "2", "--set", "count_words.pause_s=3")
    assert code == 0 and output.count(" done in ") == 4 * (len(CURRENT_STAGES) + 1)
    running = most = 0
    for line in output.splitlines():
        if re.search(r"count_words +(started|done)", line):
            running += 1 if "started" in line else -1
            most = max(most, running)
    assert most == 2
    assert not [path for path in folder.rglob(".*") if ".workflow-" in path.name or path.suffix == ".lock"]
