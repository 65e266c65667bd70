"""The contract of one stage: declaration, validation, publishing, manifest, currency, exit codes."""

import json
import os
import struct
import subprocess
import sys
import zlib

import pytest
from toy_runs import READ_TEXT, REPOSITORY, make_subject, tree

from shared.contract import Output, Stage, main
from shared.contract.shapes import describe
from shared.errors import InputError, LimnError


def write_text(job):
    (job.out / "text.txt").write_text(f"{job.subject.video.read_text()} {job.params.as_dict()}")


@pytest.fixture
def pipeline(tmp_path):
    path = tmp_path / "pipeline.yaml"
    path.write_text("stages:\n  read_text: {}\n  count: {needs: [read_text]}\n"
                    "presets:\n  standard: {}\n  draft: {read_text: {size: 3}}\n")
    return path


@pytest.fixture
def call(tmp_path, pipeline):
    """call(run, *arguments) -> exit code of the stage on the subject `anna`."""
    subject = make_subject(tmp_path / "anna")

    def run_stage(run=write_text, *arguments, check=None, stage=READ_TEXT, folder=subject):
        return main(stage, run, check, ["--subject", str(folder), "--pipeline", str(pipeline), *map(str, arguments)])

    return run_stage


@pytest.mark.parametrize("arguments, hint", [
    (["--set", "sise=1"], "read_text.size"), (["--set", "size=0"], "1 .. 100"), (["--set", "size"], "stage.key=value"),
    (["--preset", "drft"], "did you mean draft?"), (["--subjekt", "x"], "--help"), (["--threads", "0"], ">= 1")])
def test_bad_command_line_is_one_line_and_writes_nothing(call, tmp_path, capsys, arguments, hint):
    before = tree(tmp_path)
    assert call(write_text, *arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and hint in error and tree(tmp_path) == before


@pytest.mark.parametrize("settings, hint", [
    ("vidio: clip.txt\n", "did you mean video?"), ("camera: {}\n", "no video named"),
    ("video: [a]\n", "no video named"), ("video: gone.mp4\n", "no such video"),
    ("video: ../anna/clip.txt\n", "leaves the subject's folder"),
    ("video: /etc/hostname\n", "leaves the subject's folder"), ("video: empty.mp4\n", "the file is empty"),
    ("video: frames/%05d.png\n", "no such video"), ("video: clip.txt\nvideo: clip.txt\n", "given twice"),
    ("video: {\n", "not valid YAML"), ("- video\n", "not a mapping"),
    ("video: !!python/name:os.system\n", "not valid YAML"),
    ("video: clip.txt\ncamera: {focal_length: 60}\n", "did you mean focal_length"),
    ("video: clip.txt\ncamera: {focal_length_mm: 60}\n", "without sensor_width_mm"),
    ("video: clip.txt\ncamera: {focal_length_px: -5}\n", "10 .. 1e+06 px"),
    ("video: clip.txt\ncamera: {focal_length_px: 900, focal_length_mm: 60, sensor_width_mm: 36}\n", "keep one"),
    ("video: clip.txt\ncolour: {transfer: sRBG}\n", "did you mean srgb?"),
    ("video: clip.txt\ncapture: {moves: light}\n", "head | camera"),
    ("video: clip.txt\nhead: {pupil_distance: 63}\n", "did you mean pupil_distance_mm?"),
    ("video: clip.txt\nhead: {pupil_distance_mm: 6.3}\n", "40 .. 90 mm"),
    ("video: clip.txt\nchart: yes please\n", "auto | off | {frame"),
    ("video: clip.txt\nchart: {corner: []}\n", "did you mean corners?"),
    ("video: clip.txt\nchart: {frame: 3}\n", "not four corners"),
    ("video: clip.txt\nchart: {frame: -1, corners: [[0, 0], [9, 0], [9, 6], [0, 6]]}\n", "chart.frame: no frame"),
    ("video: clip.txt\nchart: {frame: 1, corners: [[0, 0], [9, 0], [9, 6], 4]}\n", "not four corners"),
    ("video: clip.txt\nchart: {frame: 1, corners: [[0, 0], [9, 0], [9, x], [0, 6]]}\n", "not a number of pixels"),
    ("video: clip.txt\nchart: {frame: 1, corners: [[0, 0], [9, 0], [0, 6], [9, 6]]}\n", "do not go around"),
    ("video: clip.txt\ngrey: wall\n", "grey: not a place in the picture"),
    ("video: clip.txt\ngrey: [9]\n", "[x, y] in pixels of the source frame"),
    ("video: clip.txt\ngrey: {x: 9, y: 6}\n", "not a place in the picture"),
    ("video: clip.txt\ngrey: [9, on]\n", "not a number of pixels"),
    ("video: clip.txt\ngrey: [9, .nan]\n", "not a number of pixels"),
    ("video: clip.txt\ncapture: {moves: camera}\ngrey: [9, 6]\n", "only a camera that stands still"),
    ("video: clip.txt\ncapture: head\n", "not a mapping"),
    ("video: clip.txt\ntracking: {poses: ../poses.npz}\n", "leaves the subject's folder"),
    ("video: clip.txt\ntracking: {landmarks: /etc/hostname}\n", "leaves the subject's folder"),
    ("video: clip.txt\ntracking: {landmarks: gone.npz}\n", "tracking.landmarks: no such file"),
    ("video: clip.txt\ntracking: {poses: empty.mp4}\n", "tracking.poses: no such file"),
    ("video: clip.txt\ntracking: {poses: [a]}\n", "no file named"),
    ("video: clip.txt\ntracking: {hold_poses: true}\n", "hold_poses without poses"),
    ("video: clip.txt\ntracking: {landmarks: clip.txt, hold_poses: true}\n", "hold_poses without poses"),
    ("video: clip.txt\ntracking: {poses: clip.txt, hold_poses: always}\n", "true | false"),
    ("video: clip.txt\ntracking: {pose: clip.txt}\n", "did you mean poses?"),
    ("video: clip.txt\ntracking: poses.npz\n", "not a mapping")])
def test_bad_subject_is_one_line_and_writes_nothing(call, tmp_path, capsys, settings, hint):
    folder = make_subject(tmp_path / "bo", settings=settings)
    (folder / "empty.mp4").touch()
    before = tree(folder)
    assert call(folder=folder) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and hint in error and str(folder) in error and tree(folder) == before


def test_folder_without_subject(call, tmp_path, capsys):
    (tmp_path / "bare").mkdir()
    assert call(folder=tmp_path / "bare") == 2 and "no subject.yaml" in capsys.readouterr().err
    assert call(folder=tmp_path / "gone") == 2 and "no such folder" in capsys.readouterr().err


def test_published_folder(call, tmp_path):
    def write_more(job):
        write_text(job)
        (job.out / "lines").mkdir()
        (job.out / "lines" / "000.txt").write_text("a")
        (job.out / "when.json").write_text("{}")
        job.warn("odd clip")
        job.warn("odd clip")
        assert list(job.progress([1, 2], "items")) == [1, 2]
        with pytest.raises(AttributeError):
            job.params.size = 3

    assert call(write_more, "--preset", "draft", "--set", "read_text.letters=upper") == 0
    folder = tmp_path / "anna" / "work" / "read_text"
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["parameters"] == {"size": 3, "letters": "upper", "limit": None, "fast": False}
    assert (manifest["stage"], manifest["version"]) == ("read_text", 1)
    assert set(manifest["inputs"]) == {"video", "subject.yaml"}
    assert set(manifest["outputs"]) == {"text.txt", "lines/000.txt", "when.json"}
    text = manifest["outputs"]["text.txt"]
    assert (text["unit"], text["space"], text["kind"], len(text["sha256"])) == ("mm", "uv", "text", 64)
    assert manifest["outputs"]["when.json"] == {"volatile": True}
    provenance = json.loads((folder / "provenance.json").read_text())
    assert provenance["warnings"] == ["odd clip"] and provenance["wall_s"] > 0 and provenance["peak_memory_mb"] > 1
    assert "items: 2 in" in (folder / "log.txt").read_text()
    assert sorted(path.name for path in folder.parent.iterdir()) == [".hashes.json", "read_text", "read_text.stamp"]


def test_same_work_same_bytes_wherever_it_lies(call, tmp_path):
    assert call() == 0
    folder = tmp_path / "anna" / "work" / "read_text"
    manifest, stamp = (folder / "manifest.json").read_bytes(), folder.with_suffix(".stamp").read_bytes()
    assert call(write_text, "--force") == 0
    assert (folder / "manifest.json").read_bytes() == manifest
    assert call(write_text, "--out", tmp_path / "elsewhere", "--threads", "1") == 0
    other = tmp_path / "elsewhere" / "anna" / "work" / "read_text"
    assert (other / "manifest.json").read_bytes() == manifest and other.with_suffix(".stamp").read_bytes() == stamp


def test_current_result_is_left_alone(call, tmp_path):
    runs = []

    def count(job):
        runs.append(job)
        write_text(job)

    assert call(count) == 0
    clip, text = tmp_path / "anna" / "clip.txt", tmp_path / "anna" / "work" / "read_text" / "text.txt"
    clip.touch()
    text.touch()
    os.utime(tmp_path / "anna" / "subject.yaml", (1, 1))
    (tmp_path / "anna" / "subject.yaml").write_text("# a remark\nvideo:   clip.txt\n")
    assert call(count) == 0 and len(runs) == 1
    (tmp_path / "anna").rename(tmp_path / "berta")
    assert call(count, folder=tmp_path / "berta") == 0 and len(runs) == 1
    (tmp_path / "berta").rename(tmp_path / "anna")
    text.write_text(text.read_text().replace("rose", "nose"))
    assert call(count) == 0 and len(runs) == 2
    text.unlink()
    assert call(count) == 0 and len(runs) == 3
    clip.write_text("a nose is a rose")
    assert call(count) == 0 and len(runs) == 4
    assert call(count, "--set", "size=11") == 0 and len(runs) == 5
    (tmp_path / "anna" / "subject.yaml").write_text("video: clip.txt\ncapture: {moves: camera}\n")
    assert call(count, "--set", "size=11") == 0 and len(runs) == 6


def test_failure_keeps_log_and_earlier_result(call, tmp_path, capsys):
    assert call() == 0
    folder = tmp_path / "anna" / "work" / "read_text"
    before = (folder / "text.txt").read_bytes()

    def fail(job):
        (job.out / "text.txt").write_text("half")
        raise ZeroDivisionError("no rays")

    assert call(fail, "--set", "size=12") == 1
    failed = folder.with_suffix(".failed")
    assert "ZeroDivisionError: no rays" in (failed / "log.txt").read_text()
    error = capsys.readouterr().err
    assert "ZeroDivisionError: no rays" in error and str(failed / "log.txt") in error
    assert (folder / "text.txt").read_bytes() == before and not list(folder.parent.glob(".*.tmp-*"))
    assert call(write_text, "--set", "size=12") == 0 and not failed.exists()


def test_input_error_inside_a_stage_leaves_nothing(call, tmp_path, capsys):
    def blind(job):
        write_text(job)
        raise InputError("no face", where="frame 3", hint="film a face")

    before = tree(tmp_path)
    assert call(blind) == 2
    assert capsys.readouterr().err == "read_text: frame 3: no face; film a face\n" and tree(tmp_path) == before
    assert call(blind, "--out", tmp_path / "new" / "place") == 2 and tree(tmp_path) == before


@pytest.mark.parametrize("fault, hint", [("undeclared", "not among its declared outputs"), ("missing", "did not write"),
                                         ("check", "too dark"), ("input", "an input changed while")])
def test_results_that_break_the_contract_are_not_published(call, tmp_path, capsys, fault, hint):
    def run(job):
        if fault != "missing":
            write_text(job)
        if fault == "undeclared":
            (job.out / "extra.txt").write_text("x")
        if fault == "input":
            job.subject.video.write_text("another clip")

    def check(job):
        if fault == "check":
            raise LimnError("too dark")

    assert call(run, check=check) == 1
    assert hint in capsys.readouterr().err and not (tmp_path / "anna" / "work" / "read_text").exists()


def test_inputs_are_needed_and_confined(call, tmp_path, capsys):
    count = Stage("count", 1, "Counts.", ("read_text",), (Output("n.txt", "n"),))

    def run(job):
        with pytest.raises(LimnError, match="does not declare"):
            job.input("draw")
        (job.out / "n.txt").write_text(str(len((job.input("read_text") / "text.txt").read_text())))

    assert call(run, stage=count) == 2 and "has no result yet" in capsys.readouterr().err
    assert call() == 0 and call(run, stage=count) == 0
    (tmp_path / "anna" / "work" / "read_text" / "text.txt").write_text("")
    assert call(run, stage=count) == 2 and "text.txt is damaged" in capsys.readouterr().err


def test_killed_between_the_two_renames(call, tmp_path, monkeypatch):
    assert call() == 0
    work = tmp_path / "anna" / "work"
    (work / "read_text").rename(work / ".read_text.old-77")
    (work / ".read_text.tmp-77").mkdir()
    assert call() == 0
    assert sorted(path.name for path in work.iterdir()) == [".hashes.json", "read_text", "read_text.stamp"]


def test_two_writers_are_kept_apart(call, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("shared.contract.cli._LOCK_WAIT_S", 0.2)
    code = ("import sys; from pathlib import Path; from shared.contract.folders import RunFolder\n"
            "with RunFolder(Path(sys.argv[1])).locked('read_text'):\n  print('held', flush=True); sys.stdin.read()")
    holder = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "anna")], stdin=subprocess.PIPE,
                              stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(REPOSITORY)})
    holder.stdout.readline()
    assert call() == 2 and f"process {holder.pid}" in capsys.readouterr().err
    holder.kill()
    holder.wait()
    assert call() == 0 and not list((tmp_path / "anna" / "work").glob("*.lock"))


def test_unwritable_place_is_an_input_error(call, tmp_path, capsys):
    (tmp_path / "file").write_text("x")
    assert call(write_text, "--out", tmp_path / "file") == 2
    assert "--out DIR" in capsys.readouterr().err


def test_shapes_come_from_headers(tmp_path):
    import numpy as np

    from shared.io.images import write_exr

    header = struct.pack(">IIBBBBB", 7, 5, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    write_exr(tmp_path / "b.exr", np.zeros((4, 6, 3), np.float32), colour_space="data")
    np.savez(tmp_path / "c.npz", poses=np.zeros((2, 4, 4)), one=np.float64(1))
    (tmp_path / "d.png").write_bytes(b"broken")
    assert describe(tmp_path / "a.png") == {"kind": "image", "shape": [5, 7, 3]}
    assert describe(tmp_path / "b.exr") == {"kind": "image", "shape": [4, 6, 3]}
    assert describe(tmp_path / "c.npz") == {"kind": "arrays", "shape": {"poses": [2, 4, 4], "one": []}}
    assert describe(tmp_path / "d.png") == {"kind": "image"}
