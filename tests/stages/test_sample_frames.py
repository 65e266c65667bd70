"""From clip to frames: the survey's verdicts on drawn clips, then the stage, good input and bad."""

import json

import cv2
import numpy as np
import pytest
from field_check import field_faults
from toy_chart import draw_chart
from toy_video import DrawnFaceNetworks, drawn_face, turning_face, write_video

from shared.capture.clip_survey import ClipSurvey
from shared.capture.face_tracker import FaceTracker
from shared.capture.landmarks import EYE_LEFT, EYE_RIGHT, OVAL
from shared.contract import main
from shared.contract.records import FRAMES
from shared.geometry.transforms import rotation_from_vector
from shared.imaging.color import decode_srgb
from shared.io.frames import FrameSet
from shared.io.images import read_png, write_exr
from shared.io.video import open_video
from stages import sample_frames


def test_tracking_keeps_two_people_apart_and_finds_one_again():
    networks = DrawnFaceNetworks()
    tracker = FaceTracker(networks)
    for i in range(40):
        rgb = drawn_face((60 + i, 95), size=50)
        rgb[:, 150:] = drawn_face((60, 95), size=25)[:, :90]
        if 15 <= i < 20:
            rgb[:, :150] = 90
        tracker.update(rgb)
    large, small = sorted(tracker.tracks, key=lambda track: -track.weight)
    assert len(large.observations) == 35 and len(small.observations) == 40
    assert networks.calls["detect"] < 20 < networks.calls["track"]


def survey_of(frames, networks=None):
    survey = ClipSurvey(networks or DrawnFaceNetworks(), mask_every=4)
    for i, rgb in enumerate(frames):
        survey.add(i, i / 25, rgb, "" if rgb is not None else "damaged")
    return survey


def test_each_bad_frame_gets_its_reason():
    frames = turning_face(40)
    frames[5] = None
    frames[8] = frames[8] * 0
    frames[12] = cv2.blur(frames[12], (9, 1))
    frames[20] = frames[19].copy()
    frames[25] = drawn_face((-500, 0))
    reasons, relative = survey_of(frames).verdicts(0.4)
    found = {i: reason.split(":")[0] for i, reason in enumerate(reasons) if reason}
    assert found == {5: "damaged", 8: "black, or all of one colour", 12: "blurred", 20: "repeats the frame before",
                     25: "no face found"}
    assert np.nanmin(np.delete(relative, 12)) > 0.6


def test_survey_boxes_hold_the_drawn_head():
    survey = survey_of(turning_face(20))
    boxes = survey.head_boxes(np.arange(20))
    for i, box in enumerate(boxes):
        face = np.array([90 + 2 * i - 45, 95 + i % 3 - 60, 90 + 2 * i + 45, 95 + i % 3 + 60])
        assert (box[:2] <= face[:2]).all() and (box[2:] >= face[2:]).all()


@pytest.fixture
def subject(tmp_path, monkeypatch):
    """A function that writes a subject and runs the stage on it with stand-in networks -> exit code, out folder."""
    def run(video, *settings, yaml="camera: {focal_length_px: 900}\n", networks=None):
        networks = networks or DrawnFaceNetworks()
        monkeypatch.setattr("shared.tracking.models.load_face_networks", lambda: networks)
        folder = video.parent.parent if "%" in video.name else video.parent
        (folder / "subject.yaml").write_text(f"video: {video.relative_to(folder).as_posix()}\n{yaml}")
        arguments = ["--subject", str(folder), "--out", str(tmp_path / "out")]
        for setting in settings:
            arguments += ["--set", setting]
        code = main(sample_frames.STAGE, sample_frames.run, sample_frames.check, arguments)
        return code, tmp_path / "out" / folder.name / "work" / "sample_frames"
    return run


def frames_json(out):
    return json.loads((out / "frames.json").read_text())


def test_stage_on_a_clip_with_faults(tmp_path, subject):
    frames = turning_face(40)
    frames[12] = cv2.blur(frames[12], (9, 1))
    frames[20] = frames[19].copy()
    frames[30] = frames[30] * 0
    code, out = subject(write_video(tmp_path / "clip.mp4", frames))
    assert code == 0
    content = frames_json(out)
    assert field_faults(content, FRAMES) == []
    dropped = {entry["frame_index"]: entry["reason"].split(":")[0] for entry in content["dropped"]}
    assert dropped == {12: "blurred", 20: "repeats the frame before", 30: "black, or all of one colour"}
    kept = FrameSet.open(out)
    assert kept.frame_index.tolist() == [i for i in range(40) if i not in dropped]
    assert kept.time_s == pytest.approx(kept.frame_index / 25)
    assert kept.focal_known and content["source"]["frame_count"] == 40
    x0, y0, scale = kept.crop
    assert scale == 1 and kept.intrinsics[0, 2] == kept.intrinsics_source[0, 2] - x0
    decoded = dict(open_video(tmp_path / "clip.mp4"))
    width, height = kept.size
    for i in (0, 18, kept.count - 1):
        source = decoded[int(kept.frame_index[i])][y0:y0 + height, x0:x0 + width]
        assert np.array_equal(kept.read_codes(i), source)
        mask = kept.read_mask(i)
        left, top, right, bottom = content["frames"][i]["face_box"]
        rows, columns = np.nonzero(mask == 255)
        assert left - 1 <= columns.min() and columns.max() <= right + 1
        assert top - 1 <= rows.min() and rows.max() <= bottom + 1
    assert read_png(out / "contact_sheet.png").shape == (960, 960, 3)


def test_stage_gives_the_same_bytes_again(tmp_path, subject):
    video = write_video(tmp_path / "clip.mp4", turning_face(12))
    manifests = []
    for name in ("first", "second"):
        code, out = subject(video, yaml="camera: {focal_length_px: 900}\n")
        assert code == 0
        manifests.append((out / "manifest.json").read_bytes())
        out.rename(tmp_path / name)
    assert manifests[0] == manifests[1]


def test_stage_thins_long_clips_and_scales_large_crops(tmp_path, subject):
    frames = turning_face(60, size=90, width=480, height=400)
    code, out = subject(write_video(tmp_path / "clip.mp4", frames), "frame_count=10", "max_size=128", yaml="")
    assert code == 0
    kept = FrameSet.open(out)
    assert kept.count == 10 and np.ptp(np.diff(kept.frame_index)) <= 4
    assert max(kept.size) <= 128 and kept.crop[2] < 1
    assert kept.read_codes(0).shape[:2] == kept.size[::-1]
    assert not kept.focal_known
    assert any("focal length" in text for text in frames_json(out)["warnings"])


def test_stage_on_linear_exr_frames(tmp_path, subject):
    (tmp_path / "s" / "frames").mkdir(parents=True)
    linear = [decode_srgb(rgb / 255.0).astype(np.float32) for rgb in turning_face(6)]
    for i, picture in enumerate(linear):
        write_exr(tmp_path / f"s/frames/{i:05d}.exr", picture, colour_space="lin_rec709_scene")
    code, out = subject(tmp_path / "s/frames/%05d.exr", yaml="colour: {transfer: linear}\n")
    assert code == 0
    kept = FrameSet.open(out)
    x0, y0, _ = kept.crop
    expected = linear[3][y0:y0 + kept.size[1], x0:x0 + kept.size[0]]
    assert np.abs(kept.read_linear(3) - expected).max() < 2e-5


def test_warnings_name_what_a_person_should_know(tmp_path, subject):
    frames = [np.hstack([a, b]) for a, b in zip(turning_face(8, skin=(255, 170, 120)), turning_face(8, size=45),
                                                strict=True)]
    code, out = subject(write_video(tmp_path / "clip.mp4", frames))
    assert code == 0
    warnings = " | ".join(frames_json(out)["warnings"])
    for words in ("2 faces", "px high", "8 usable frames", "overexposed"):
        assert words in warnings


def with_chart(frames, white=(0.9, 0.8, 0.7)):
    """The clip with a colour chart below, in a picture twice as high; the grid's corners [4, 2] px in it."""
    chart, corners = draw_chart(white, 24, size=(240, 200))
    return [np.vstack([frame, chart]) for frame in frames], corners + [0, 200]


def test_stage_finds_a_colour_chart_outside_the_crop(tmp_path, subject):
    frames, corners = with_chart(turning_face(8))
    code, out = subject(write_video(tmp_path / "clip.mp4", frames, pixel_format="yuv444p"))
    assert code == 0
    records = frames_json(out)["chart"]
    assert [record["frame_index"] for record in records] == FrameSet.open(out).frame_index.tolist()
    for record in records:
        assert np.abs(np.array(record["corners"]) - corners).max() < 1.0
        np.testing.assert_allclose(record["white"], (0.9, 0.8, 0.7), rtol=0.03)
    assert FrameSet.open(out).chart == tuple(records)
    assert max(read_png(out / "chart.png").shape) == 640


def test_a_person_says_where_the_chart_is_or_that_there_is_none(tmp_path, subject, capsys):
    frames, corners = with_chart(turning_face(8))
    video = write_video(tmp_path / "clip.mp4", frames, pixel_format="yuv444p")
    code, out = subject(video, yaml="chart: off\n")
    assert code == 0 and frames_json(out)["chart"] == [] and not (out / "chart.png").exists()
    given = (corners + [[1.5, 1], [-1, 2], [-2, -1], [1, -2]]).round(1).tolist()
    code, out = subject(video, yaml=f"chart: {{frame: 5, corners: {given}}}\n")
    assert code == 0
    (record,) = frames_json(out)["chart"]
    assert record["frame_index"] == 5 and np.abs(np.array(record["corners"]) - corners).max() < 1.0
    for chart, words in (({"frame": 50, "corners": given}, "chart.frame: the clip has no such frame"),
                         ({"frame": 5, "corners": [[x + 900, y] for x, y in given]}, "outside the picture")):
        capsys.readouterr()
        assert subject(video, yaml=f"chart: {json.dumps(chart)}\n")[0] == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and words in error


def test_a_person_names_a_grey_place(tmp_path, subject, capsys):
    """The drawn wall is bluish at the left, with a sign held before it in one frame; a red sign hangs at the right."""
    frames = turning_face(8)
    frames[3][80:100, 2:20] = (190, 60, 40)
    for frame in frames:
        frame[20:44, 204:230] = (220, 40, 40)
    video = write_video(tmp_path / "clip.mp4", frames, pixel_format="yuv444p")
    code, out = subject(video)
    assert code == 0 and "grey" not in frames_json(out) and FrameSet.open(out).grey is None
    plain = (out / "frames.json").read_text()
    code, out = subject(video, yaml="camera: {focal_length_px: 900}\ngrey: [8, 90]\n")
    content = frames_json(out)
    assert code == 0 and field_faults(content, FRAMES) == []
    said = content.pop("grey")
    assert FrameSet.open(out).grey == said and content == json.loads(plain)
    assert said["frames"] == [frame["frame_index"] for frame in content["frames"] if frame["frame_index"] != 3]
    np.testing.assert_allclose(said["colour"], decode_srgb(np.array([61, 71, 81]) / 255), rtol=0.06)
    code, out = subject(video, yaml="grey: [217, 32]\n")
    assert code == 0 and "grey" not in frames_json(out)
    assert any("the grey place at (217, 32) is not used" in text for text in frames_json(out)["warnings"])
    capsys.readouterr()
    assert subject(video, yaml="grey: [8, 201]\n")[0] == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "grey: a place outside the picture" in error and "240 x 200 px" in error


class SidewaysNetworks(DrawnFaceNetworks):
    """Sure of a face only when the picture is higher than wide."""

    def detect(self, rgb, min_score=0.5, zoom=True):
        self.score = 0.95 if rgb.shape[0] > rgb.shape[1] else 0.7
        return super().detect(rgb, min_score, zoom)


BAD = {
    "no face": (lambda: [drawn_face((-500, 0), seed=i) for i in range(5)], None, "no face"),
    "one frame": (lambda: turning_face(1), None, "too few usable frames"),
    "two frames": (lambda: turning_face(2), None, "too few usable frames"),
    "a still": (lambda: [drawn_face((120, 95))] * 12, None, "repeats the frame before"),
    "lying head": (lambda: turning_face(6), SidewaysNetworks(), "lies on its side"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_clips_end_in_one_line_and_leave_nothing(tmp_path, subject, capsys, name):
    make, networks, words = BAD[name]
    code, out = subject(write_video(tmp_path / "clip.mp4", make()), networks=networks)
    lines = [line for line in capsys.readouterr().err.splitlines() if "clip.mp4" in line]
    assert code == 2 and len(lines) == 1 and words in lines[0]
    assert not out.exists()


def test_unreadable_clips_end_in_one_line(tmp_path, subject, capsys):
    (tmp_path / "clip.mp4").write_bytes(b"nothing to see" * 100)
    code, out = subject(tmp_path / "clip.mp4")
    assert code == 2 and not out.exists()
    assert "not a video" in capsys.readouterr().err


def test_check_refuses_a_mask_without_a_face(tmp_path, subject, monkeypatch):
    monkeypatch.setattr("shared.capture.crop_pixels.frame_mask",
                        lambda rgb, person, points: np.zeros(rgb.shape[:2], np.uint8))
    code, out = subject(write_video(tmp_path / "clip.mp4", turning_face(5)))
    assert code == 1 and not out.exists()


class TurningNetworks(DrawnFaceNetworks):
    """The drawn face, whose features turn by a degree for each pixel that it wanders to the right."""

    def landmarks(self, rgb, detection):
        presence, points = super().landmarks(rgb, detection)
        half = np.ptp(detection.box.reshape(2, 2), axis=0) / 2
        inner = np.setdiff1d(np.arange(468), [*OVAL, *EYE_LEFT, *EYE_RIGHT])
        directions = np.random.default_rng(0).normal(size=(len(inner), 3))
        directions[:, 2] = -np.abs(directions[:, 2])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        turn = rotation_from_vector(np.array([0.0, np.radians(points[0, 0] - 110.0), 0.0]))
        points[inner] = directions * [*half, half[0]] @ turn.T + [*points[0, :2], 0.0]
        return presence, points


def before_shelves(frames, shift):
    """The drawn faces before a wall full of things that is moved by so many px from frame to frame."""
    rng = np.random.default_rng(3)
    things = cv2.resize(rng.integers(20, 120, (60, 200), np.uint8), (1000, 300), interpolation=cv2.INTER_CUBIC)
    pictures = []
    for i, frame in enumerate(frames):
        grey = np.repeat(things[:frame.shape[0], 400 - round(shift * i):][:, :frame.shape[1], None], 3, axis=2)
        reddish = frame[..., 0].astype(int) - frame[..., 2] > 40
        pictures.append(np.where(reddish[..., None], frame, grey).astype(np.uint8))
    return pictures


@pytest.mark.parametrize("shift, moves, words", [
    (0, "head", ""), (0, "camera", "set capture.moves to head"),
    (4, "camera", ""), (4, "head", "set capture.moves to camera")])
def test_stage_checks_what_moves_against_the_background(tmp_path, subject, shift, moves, words):
    video = write_video(tmp_path / "clip.mp4", before_shelves(turning_face(30, width=400, size=40), shift))
    code, out = subject(video, yaml=f"capture: {{moves: {moves}}}\n", networks=TurningNetworks())
    assert code == 0
    said = [text for text in frames_json(out)["warnings"] if "capture.moves" in text]
    assert len(said) == bool(words) and words in "".join(said)
