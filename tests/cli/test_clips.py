"""Several clips of one subject: subject.yaml, and on the toy pipeline what runs for each, what for all, what again."""

import json
import os
import re
import shutil
import subprocess
import sys

import pytest
from toy_runs import REPOSITORY, copy_pipeline, limn, make_subject, outputs_of, tree

from shared.contract.needs import WorkSize, measured_scale
from shared.contract.pipeline import load_pipeline
from shared.contract.subject import load_subject
from shared.errors import InputError
from tools.limn import main

CLIPS = "clips:\n  sun: {video: clip.txt}\n  lamp: {video: lamp.txt, colour: {transfer: linear}}\n"
EACH = ("read_text", "count_words", "draw_bars")


def make_pair(folder, settings=CLIPS + "camera: {focal_length_px: 900}\n"):
    make_subject(folder, settings=settings)
    (folder / "lamp.txt").write_text("a lamp\n")
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A subject of two clips after one run, the pipeline, and what limn said. For reading only."""
    folder = tmp_path_factory.mktemp("pair")
    pipeline, subject = copy_pipeline(folder / "toy"), make_pair(folder / "anna")
    return subject, pipeline, *limn("run", subject, "--pipeline", pipeline)


# ---------------------------------------------------------------------- subject.yaml


def test_clips_take_from_the_subject_what_they_do_not_say(tmp_path):
    subject = load_subject(make_pair(tmp_path / "anna"))
    assert [clip.name for clip in subject.clips] == ["sun", "lamp"]
    assert [clip.focal_length_px for clip in subject.clips] == [900.0, 900.0]
    assert [clip.transfer for clip in subject.clips] == ["srgb", "linear"]
    assert (subject.name, subject.video, subject.transfer) == ("anna", subject.clips[0].video, "srgb")
    one = load_subject(make_subject(tmp_path / "one", settings="video: clip.txt\n"))
    assert one.clips == () and "clips" not in one.content() and len(subject.content()["clips"]) == 2


@pytest.mark.parametrize(("settings", "said"), [
    ("video: clip.txt\n" + CLIPS, "both video and clips"),
    ("chart: off\n" + CLIPS, "move chart to where it belongs: clips: {NAME: {chart: ...}}"),
    ("grey: [9, 6]\n" + CLIPS, "move grey to where it belongs: clips: {NAME: {grey: ...}}"),
    ("capture: {moves: camera}\n" + CLIPS.replace("lamp.txt", "lamp.txt, grey: [9, 6]"),
     "clips.lamp.grey: a grey place before a camera that moves"),
    (CLIPS.replace("sun", "Sun"), "not a clip's name"),
    (CLIPS.replace("sun:", "1:"), "not a clip's name"),
    (CLIPS.replace("sun", "../sun"), "not a clip's name"),
    ("clips:\n  sun: {video: clip.txt}\n", "name one clip as video: FILE, without clips"),
    ("clips: {}\n", "number of clips not allowed"),
    ("clips: [sun, lamp]\n", "not a mapping"),
    (CLIPS.replace("lamp.txt", "lamp.mov"), "no such video"),
    (CLIPS.replace("lamp.txt", "clip.txt"), "two clips of one video"),
    (CLIPS.replace("{video: clip.txt}", "{}"), "clips.sun.video: no video named"),
    (CLIPS.replace("{video: clip.txt}", "{vidio: clip.txt}"), "did you mean video?"),
    (CLIPS.replace("{video: clip.txt}", "{video: clip.txt, capture: {moves: head}}"), "unknown key 'capture'"),
    (CLIPS.replace("transfer: linear", "transfer: liner"), "did you mean linear?"),
])
def test_what_is_wrong_with_clips_is_said_in_one_line(tmp_path, settings, said):
    folder = make_pair(tmp_path / "anna", settings)
    with pytest.raises(InputError) as fault:
        load_subject(folder)
    assert said in str(fault.value) and "\n" not in str(fault.value)
    assert "subject.yaml" in str(fault.value) or "lamp.mov" in str(fault.value)


# ---------------------------------------------------------------------- one stage by hand


def stage(pipeline, name, subject, *arguments):
    """Runs a toy stage -> (exit code, what it printed)."""
    command = [sys.executable, "-m", f"toy.{name}", "--subject", subject, "--pipeline", pipeline, *arguments]
    path = os.pathsep.join([str(pipeline.parent), str(REPOSITORY)])
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
    return done.returncode, done.stderr


@pytest.mark.parametrize(("name", "arguments", "said"), [
    ("read_text", (), "add --clip NAME, one of sun, lamp"),
    ("read_text", ("--clip", "lmap"), "did you mean lamp?"),
    ("export_page", ("--clip", "sun"), "leave --clip out"),
])
def test_a_stage_says_which_clip_it_wants(tmp_path, pipeline, name, arguments, said):
    subject = make_pair(tmp_path / "anna")
    code, output = stage(pipeline, name, subject, *arguments)
    assert code == 2 and said in output and output.count("\n") == 1
    assert not (subject / "work").exists()


def test_one_clip_takes_no_name(tmp_path, pipeline):
    code, output = stage(pipeline, "read_text", make_subject(tmp_path / "one"), "--clip", "sun")
    assert code == 2 and "this subject has one clip" in output


def test_a_pipeline_must_join_all_that_runs_for_each_clip(pipeline):
    path = pipeline.parent / "toy" / "export_page.py"
    path.write_text(path.read_text().replace('joins=("read_text", "draw_bars")', 'joins=("read_text",)'))
    with pytest.raises(InputError, match="joins other inputs"):
        load_pipeline(pipeline).joint  # noqa: B018


# ---------------------------------------------------------------------- the workflow


def test_each_clip_has_folders_of_its_own_and_the_last_stage_joins_them(finished):
    subject, _, code, output = finished
    assert code == 0, output
    for clip in ("sun", "lamp"):
        for name in EACH:
            assert (subject / "work" / "clips" / clip / "work" / name / "manifest.json").is_file()
    page = (subject / "export" / "page.txt").read_text().split("\n\n")
    assert page[1] == "sun" and page[4] == "lamp" and page[5].strip() == "a lamp"
    assert not (subject / "work" / "read_text").exists()
    inputs = json.loads((subject / "export" / "manifest.json").read_text())["inputs"]
    assert set(inputs) == {"subject.yaml", *(f"{clip}/{name}" for clip in ("sun", "lamp")
                                             for name in ("read_text", "draw_bars"))}


def test_a_clip_s_results_are_those_of_a_subject_of_its_own(finished, tmp_path):
    """Byte by byte, manifests included."""
    subject, pipeline, *_ = finished
    alone = make_subject(tmp_path / "sun", settings="video: clip.txt\ncamera: {focal_length_px: 900}\n")
    assert limn("run", alone, "--pipeline", pipeline)[0] == 0
    own = outputs_of(subject / "work" / "clips" / "sun")
    assert len(own) > 6
    assert own == {name: content for name, content in outputs_of(alone).items() if not name.startswith("export")}


def test_only_what_a_changed_clip_touches_runs_again(finished, tmp_path, capsys):
    original, pipeline, *_ = finished
    subject = tmp_path / "anna"
    shutil.copytree(original, subject)
    ask = ["plan", str(subject), "--pipeline", str(pipeline)]
    assert main(ask) == 0
    states = [line.split()[:2] for line in capsys.readouterr().out.splitlines()[1:]]
    assert [label for label, _ in states] == [*(f"{clip}/{name}" for clip in ("sun", "lamp") for name in EACH),
                                              "export_page"]
    assert {state for _, state in states} == {"current"}
    (subject / "lamp.txt").write_text("a lamp and a lamp\n")
    assert main(ask) == 0
    told = dict(line.split(None, 1) for line in capsys.readouterr().out.splitlines()[1:])
    assert all(told[f"sun/{name}"].startswith("current") for name in EACH)
    assert told["lamp/read_text"].startswith("will run  input video changed")
    assert told["export_page"].startswith("may run   if the outputs of lamp/read_text, lamp/draw_bars change")
    code, output = limn("run", subject, "--pipeline", pipeline)
    assert code == 0 and re.search("lamp/read_text +done", output) and "sun/" not in output
    assert "a lamp and a lamp" in (subject / "export" / "page.txt").read_text()
    assert "current, nothing to do" in limn("run", subject, "--pipeline", pipeline)[1]


def test_a_clip_at_fault_is_named_and_keeps_the_rest_from_running(tmp_path, pipeline):
    subject = make_pair(tmp_path / "anna")
    (subject / "lamp.txt").write_text("no face\n")
    code, output = limn("run", subject, "--pipeline", pipeline, "--summary", tmp_path / "summary.json")
    assert code == 2 and "not run: lamp/count_words, lamp/draw_bars, export_page" in output
    outcome = json.loads((tmp_path / "summary.json").read_text())["subjects"][0]
    assert (outcome["state"], outcome["stage"]) == ("input error", "lamp/read_text") and outcome["bytes"] > 0
    assert (subject / "work" / "clips" / "sun" / "work" / "draw_bars").is_dir()


def test_work_on_all_clips_books_for_the_frames_of_all(tmp_path):
    for clip, frames, size in (("sun", 30, [100, 400]), ("lamp", 12, [300, 300])):
        folder = tmp_path / "work" / "clips" / clip / "work" / "sample_frames"
        folder.mkdir(parents=True)
        (folder / "frames.json").write_text(json.dumps({"size": size, "frames": [0] * frames}))
    assert measured_scale(tmp_path, WorkSize(150, 1024, 512)) == WorkSize(42, 300, 512)
    assert measured_scale(tmp_path / "work" / "clips" / "sun", WorkSize(150, 1024, 512)) == WorkSize(30, 200, 512)
    assert measured_scale(tmp_path / "gone", WorkSize(150, 1024, 512)) == WorkSize(150, 1024, 512)


def test_status_and_clean_see_all_clips(finished, tmp_path, capsys):
    original, pipeline, *_ = finished
    subject = tmp_path / "anna"
    shutil.copytree(original, subject)
    assert main(["status", str(subject), "--pipeline", str(pipeline), "--json"]) == 0
    stages = json.loads(capsys.readouterr().out)[0]["stages"]
    assert [row["state"] for row in stages] == ["current"] * 7 and all(row["bytes"] for row in stages)
    assert main(["clean", str(subject), "--pipeline", str(pipeline)]) == 0
    assert not (subject / "work").exists() or tree(subject / "work") == []
    assert (subject / "export" / "page.txt").is_file()
