"""Scores of gaze: known errors are found in any head space, blinks are counted, and the table says what is missing."""

import shutil

import numpy as np
import pytest
from quick import TINY
from test_score import TURN, export_from_truth

from shared.geometry.eyeballs import gaze_direction, gaze_towards
from shared.geometry.transforms import WORLD_FROM_CAMERA, project, rigid
from shared.io.arrays import load_arrays, save_arrays, write_json
from tools.scoring.gaze import REGION, eye_pixels, found_gaze, gaze_errors, iris_errors_px
from tools.scoring.score import score, score_eyes
from tools.scoring.table import table

NOT_TURNED = np.eye(3)


def some_gaze(frames: int = 12) -> np.ndarray:
    return 0.2 * np.random.default_rng(0).normal(size=(frames, 2, 2))


def by_frame(gaze: np.ndarray) -> dict[int, np.ndarray]:
    return dict(enumerate(gaze))


def test_a_constant_offset_is_the_error_and_is_gone_when_removed():
    truth = some_gaze()
    truth[..., 1] = 0.0
    found = truth + np.radians([[2.0, 0.0], [-3.0, 0.0]])
    scores = gaze_errors(truth, by_frame(found), NOT_TURNED)
    assert scores["right"]["mean"] == pytest.approx(2.0) and scores["left"]["mean"] == pytest.approx(3.0)
    assert scores["deg"]["mean"] == pytest.approx(2.5) and scores["deg"]["p95"] == pytest.approx(3.0)
    assert scores["deg_centred"]["mean"] < 1e-6 and scores["frames"] == 12
    assert scores["shut"] == {"eyes": 0, "false": 0.0}


def test_another_head_space_changes_nothing():
    truth = some_gaze()
    turned = gaze_towards(gaze_direction(truth) @ TURN)  # the result's space: truth_from_result is TURN
    assert gaze_errors(truth, by_frame(turned), TURN)["deg"]["mean"] < 1e-6
    assert gaze_errors(truth, by_frame(turned), NOT_TURNED)["deg"]["mean"] > 5.0


def test_blinks_are_counted_by_eye_and_frame():
    truth, found = some_gaze(10), some_gaze(10)
    truth[2:6] = np.nan
    found[3:6] = np.nan
    found[8, 0] = np.nan
    scores = gaze_errors(truth, by_frame(found), NOT_TURNED)
    assert scores["shut"] == {"eyes": 8, "recall": 0.75, "false": pytest.approx(1 / 12)}
    assert scores["deg"]["mean"] < 1e-6
    every = gaze_errors(np.full((4, 2, 2), np.nan), by_frame(np.full((4, 2, 2), np.nan)), NOT_TURNED)
    assert every == {"frames": 4, "shut": {"eyes": 8, "recall": 1.0}}


def test_only_frames_that_the_result_has_are_compared():
    truth = some_gaze()
    assert gaze_errors(truth, {3: truth[3], 50: truth[0]}, NOT_TURNED)["frames"] == 1


def test_pixels_of_an_eye_are_an_ellipse_about_its_centre():
    focal, distance, radius = 1000.0, 500.0, 16.0
    lens = np.array([[focal, 0, 100.0], [0, focal, 60.0], [0, 0, 1.0]])
    centres = np.array([[-30.0, 0.0, -15.0], [30.0, 0.0, -15.0]])
    pose = rigid(WORLD_FROM_CAMERA, np.array([0.0, 0.0, distance]))
    seen = eye_pixels(np.full((120, 200), distance), pose, lens, centres, radius)
    area = 2 * np.pi * np.prod(np.array(REGION) * radius * focal / distance)
    assert seen.sum() == pytest.approx(area, rel=0.02)
    assert seen[60, 40] and seen[60, 160] and not seen[60, 100]
    assert not eye_pixels(np.zeros((120, 200)), pose, lens, centres, radius).any()
    at_the_outline = np.full((120, 200), 0.6 * distance)
    assert not eye_pixels(at_the_outline, pose, lens, centres, radius).any()
    behind = centres + [0.0, 0.0, 30.0]
    assert not eye_pixels(np.full((120, 200), distance), pose, lens, behind, radius).any()


def living_tiny(folder, gaze: np.ndarray):
    shutil.copytree(TINY, folder)
    truth = load_arrays(TINY / "gt" / "poses.npz")
    centres = np.array([[-31.5, 33.0, 71.0], [31.5, 33.0, 71.0]])
    save_arrays(folder / "gt" / "poses.npz", **truth, gaze=gaze, eyeball_centres=centres,
                eyeball_radius=np.float64(16.0))
    return folder


def test_irises_are_compared_in_pixels_of_the_clip(tmp_path):
    """The crop is zoomed by two; one iris of twelve frames lies three clip pixels beside the truth, others where it
    has them; an eye without gaze does not count."""
    truth = load_arrays(living_tiny(tmp_path / "eyes", some_gaze()) / "gt" / "poses.npz")
    places = truth["eyeball_centres"] + np.sqrt(16.0**2 - 5.85**2) * gaze_direction(truth["gaze"])
    irises = np.stack([project(both, pose, truth["K"])[0] for both, pose in
                       zip(places, truth["camera_from_head"], strict=True)])  # fmt: skip
    irises[4, 1] += [3.0, 0.0]
    gaze = truth["gaze"].copy()
    gaze[7, 0], irises[7, 0] = np.nan, 0.0
    crop = np.diag([2.0, 2.0, 1.0]) @ truth["K"]
    index = np.arange(len(gaze))
    assert iris_errors_px(truth, tmp_path) is None
    save_arrays(tmp_path / "landmarks.npz", frame_index=index, iris_px=np.repeat(2.0 * irises[:, :, None], 5, axis=2))
    save_arrays(tmp_path / "poses.npz", frame_index=index, gaze=gaze, intrinsics=truth["K"], intrinsics_crop=crop)
    found = iris_errors_px(truth, tmp_path)
    assert found["mean"] == pytest.approx(3.0 / 23, abs=1e-6) and found["median"] < 1e-6


def test_the_score_of_a_subject_with_living_eyes(tmp_path):
    gaze, export = some_gaze(), export_from_truth(tmp_path / "run" / "export")
    subject = living_tiny(tmp_path / "eyes", gaze)
    without = score(subject, export)
    assert without["gaze"] is None and "the result has none" in table(without)
    assert without["rerender_eyes"]["psnr"] > 60 and without["rerender_eyes"]["frames"] == 1
    tracked, truth = tmp_path / "run" / "work" / "track_landmarks", load_arrays(subject / "gt" / "poses.npz")
    tracked.mkdir(parents=True)
    index = np.arange(0, 12, 2)
    save_arrays(tracked / "poses.npz", gaze=gaze[::2], frame_index=index, intrinsics=truth["K"],
                intrinsics_crop=truth["K"])  # fmt: skip
    save_arrays(tracked / "landmarks.npz", frame_index=index, iris_px=np.zeros((6, 2, 5, 2)))
    scores = score_eyes(subject, export, truth, NOT_TURNED)
    assert scores["gaze"]["frames"] == 6 and scores["gaze"]["deg"]["mean"] < 1e-6
    own = load_arrays(export / "poses.npz")
    save_arrays(export / "poses.npz", **own, gaze=gaze + np.radians([3.0, 0.0]))
    assert sorted(found_gaze(export)) == list(range(12))
    solved = tmp_path / "run" / "work" / "inverse_render"
    solved.mkdir()
    write_json(solved / "solve.json", {"held_out_frames": [0, 5]})
    scores = score_eyes(subject, export, truth, NOT_TURNED)
    assert scores["gaze"]["frames"] == 12 and scores["gaze"]["deg"]["mean"] == pytest.approx(3.0, abs=0.2)
    assert scores["rerender_eyes"]["held_out"]["frames"] == 1
    lines = table(without | scores)
    assert "none in the truth" in lines and "held out" in lines and "centres off by" in lines
