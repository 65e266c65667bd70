"""`limn validate`: what is wrong with inputs is said in one line each, without a run and without writing anything."""

import numpy as np
import pytest
from toy_runs import tree
from toy_video import DrawnFaceNetworks, drawn_face, turning_face, write_sound, write_video

from shared.contract import main as stage_main
from stages import sample_frames
from tools.cli import validate
from tools.limn import main

GOOD = "video: clip.mp4\ncamera: {focal_length_px: 900}\n"


@pytest.fixture(autouse=True)
def drawn_networks(monkeypatch):
    monkeypatch.setattr(validate, "load_face_networks", DrawnFaceNetworks)
    monkeypatch.setattr("shared.tracking.models.load_face_networks", DrawnFaceNetworks)


def make(folder, frames=None, settings=GOOD):
    """A subject with a drawn clip."""
    folder.mkdir(parents=True)
    write_video(folder / "clip.mp4", turning_face(30) if frames is None else frames)
    (folder / "subject.yaml").write_text(settings)
    return folder


def test_facts_and_warnings_of_a_usable_clip(tmp_path, capsys):
    subject = make(tmp_path / "anna")
    assert main(["validate", str(subject)]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("anna: 240 x 200 px, 30 frames, 25 frames/s, h264; focal length 900 px; face 1") and not err
    assert "warning: the face is only 1" in out and tree(tmp_path) == ["anna", "anna/clip.mp4", "anna/subject.yaml"]
    (subject / "subject.yaml").write_text("video: clip.mp4\n")
    assert main(["validate", str(subject)]) == 0
    out = capsys.readouterr().out
    assert "focal length 312 px (not given)" in out and "warning: the focal length is not given" in out


def nothing(folder):
    return make(folder, [drawn_face((-500, 0)) for _ in range(30)])


def cut_off(folder):
    subject = make(folder, settings="video: clip.mkv\n")
    write_video(subject / "clip.mkv", turning_face(60))
    data = (subject / "clip.mkv").read_bytes()
    (subject / "clip.mkv").write_bytes(data[: len(data) * 2 // 3])
    return subject


def sound(folder):
    subject = make(folder)
    (subject / "clip.mp4").unlink()
    write_sound(subject / "clip.mp4")
    return subject


def text(folder):
    subject = make(folder)
    (subject / "clip.mp4").write_text("no video")
    return subject


def chart_beyond(folder):
    return make(folder, settings=GOOD + "chart: {frame: 99, corners: [[9, 9], [90, 9], [90, 60], [9, 60]]}\n")


def chart_outside(folder):
    return make(folder, settings=GOOD + "chart: {frame: 3, corners: [[9, 9], [900, 9], [900, 60], [9, 60]]}\n")


def grey_outside(folder):
    return make(folder, settings=GOOD + "grey: [9, 900]\n")


@pytest.mark.parametrize("spoil, hint", [
    (nothing, "no face found"), (cut_off, "cut off or damaged"), (sound, "no video stream"), (text, "not a video"),
    (chart_beyond, "the clip has no such frame"), (chart_outside, "corners outside the picture"),
    (grey_outside, "a place outside the picture")])
def test_the_stage_and_validate_say_the_same(tmp_path, capsys, spoil, hint):
    subject = spoil(tmp_path / "anna")
    before = tree(subject)
    assert main(["validate", str(subject)]) == 2
    found = capsys.readouterr().err
    assert hint in found and found.count("\n") == 1 and tree(subject) == before
    assert stage_main(sample_frames.STAGE, sample_frames.run, sample_frames.check, ["--subject", str(subject)]) == 2
    last = capsys.readouterr().err.splitlines(keepends=True)[-1]
    assert last.replace("sample_frames: ", "limn: ", 1) == found


def test_poses_of_another_clip(tmp_path, capsys):
    subject = make(tmp_path / "anna", settings=GOOD + "tracking: {poses: poses.npz}\n")
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = 500.0
    np.savez(subject / "poses.npz", camera_from_head=poses, frame_index=np.arange(5) + 100)
    assert main(["validate", str(subject)]) == 2
    assert "poses.npz: too few of the clip's frames in it; got 0" in capsys.readouterr().err
    np.savez(subject / "poses.npz", camera_from_head=poses, frame_index=np.arange(5))
    assert main(["validate", str(subject)]) == 0


def test_a_face_that_shows_in_few_frames_is_found_as_the_stage_finds_it(tmp_path, capsys):
    frames = [drawn_face((-500, 0)) for _ in range(200)]
    frames[50:58] = turning_face(8)
    assert main(["validate", str(make(tmp_path / "anna", frames))]) == 0
    networks = capsys.readouterr().out
    assert networks.startswith("anna: ")
    frames[50:58] = [drawn_face((-500, 0))] * 8
    frames[97:100] = turning_face(3)  # no multiple of the first stride
    assert main(["validate", str(make(tmp_path / "bert", frames))]) == 0


def test_nothing_stops_the_other_subjects(tmp_path, capsys, monkeypatch):
    make(tmp_path / "anna")
    nothing(tmp_path / "bert")
    make(tmp_path / "carl", settings="video: gone.mp4\n")
    make(tmp_path / "dora")
    assert main(["validate", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert [line.partition(":")[0] for line in out.splitlines() if line[0] != " "] == ["anna", "dora"]
    assert err.count("\n") == 2 and "no such video" in err and "no face found" in err
    usual = validate.open_video
    monkeypatch.setattr(validate, "open_video",
                        lambda path: int("\u00b2") if path.parent.name == "anna" else usual(path))
    assert main(["validate", str(tmp_path)]) == 1
    out, err = capsys.readouterr()
    assert out.startswith("dora: ") and "anna/clip.mp4: ValueError: invalid literal" in err and err.count("\n") == 3


def test_each_of_several_clips(tmp_path, capsys):
    subject = make(tmp_path / "anna", settings="clips: {sun: {video: clip.mp4}, lamp: {video: lamp.mp4}}\n")
    write_video(subject / "lamp.mp4", [drawn_face((-500, 0)) for _ in range(9)])
    assert main(["validate", str(subject)]) == 2
    out, err = capsys.readouterr()
    assert out.startswith("anna/sun: ") and "lamp.mp4: no face found" in err
