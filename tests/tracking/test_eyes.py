"""What is recorded of the eyes of a fitted head."""

from dataclasses import replace

import drawn_eyes
import numpy as np
from field_check import below, field_faults
from shapes import nods, two_balls

from shared.capture.iris import EyePicture, EyePoints, SeenEyes
from shared.contract.records import LANDMARKS, TRACKED_POSES, TRACKING
from shared.geometry.eyeballs import eyeballs_of
from shared.geometry.mesh import Mesh
from shared.geometry.surface import Surface
from shared.geometry.transforms import project
from shared.tracking.eyes import lids_in_frames, track_eyes

LENS = np.array([[2700.0, 0, 400], [0, 2700.0, 400], [0, 0, 1]])
FRAMES = 40
POSES = nods(20.0 * np.sin(np.linspace(0, 2 * np.pi, FRAMES)))
SHUT = slice(10, 13)
BLANK = np.full((800, 800, 3), 90, np.uint8)


def surface_of(model):
    return Surface(Mesh(model.template, model.faces, model.uvs, model.face_uvs), model.face_segment,
                   model.segment_names)


def seen_eyes(surface) -> SeenEyes:
    """Eyes that look straight ahead, with one blink; the last frame shows no face, the one before it one eye."""
    frames = []
    along = np.concatenate([np.linspace(0, 1, 9), np.linspace(0, 1, 9)[1:-1]])
    above = np.repeat([-0.4, 0.6], [9, 7]) * ((along > 0) & (along < 1))
    spokes = np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    for f, pose in enumerate(POSES):
        eyes = []
        for ball, inward in zip(eyeballs_of(surface), (1.0, -1.0), strict=True):
            opening = 1.0 if f in range(FRAMES)[SHUT] else 9.0
            lids = np.stack([28.0 * inward * (along - 0.5), opening * above, np.full(16, 14.0)], axis=-1)
            iris = np.column_stack([5.85 * spokes * (inward, 1), np.full(5, 13.8)])
            iris_px, lids_px = (project(ball.centre + part, pose, LENS)[0] for part in (iris, lids))
            eyes.append(EyePoints(iris_px, lids_px, EyePicture.of(BLANK, lids_px)))
        frames.append(tuple(eyes))
    return SeenEyes.of([*frames[:-2], (frames[-2][0], None), None])


def tracked(model):
    surface = surface_of(model)
    return track_eyes(surface, seen_eyes(surface), POSES, LENS, np.arange(FRAMES) / 15.0)


def test_the_records_hold_what_is_declared(model):
    found, index = tracked(model), 100 + 2 * np.arange(FRAMES)
    record = found.record(index)
    assert field_faults(record, below(TRACKING, "eyes")) == []
    assert record["blinks"] == record["shut_left"] == index[SHUT].tolist()
    assert record["gaze"] == "head" and abs(record["iris_radius_mm"] - 5.85) < 0.05
    names = {field.path for field in (*TRACKED_POSES, *LANDMARKS)}
    assert {*found.pose_arrays, *found.landmark_arrays} <= names


def test_gaze_is_nan_where_an_eye_is_shut_or_not_seen(model):
    gaze = tracked(model).pose_arrays["gaze"]
    assert np.isnan(gaze[SHUT]).all() and np.isnan(gaze[-1]).all() and np.isnan(gaze[-2, 1]).all()
    assert np.isfinite(gaze[13:-2]).all() and np.isfinite(gaze[-2, 0]).all()


def test_a_clip_of_closed_eyes_has_no_gaze_but_blinks(model):
    surface = surface_of(model)
    seen = seen_eyes(surface)
    shut = seen.subset(np.full(FRAMES, 10))
    found = track_eyes(surface, shut, np.repeat(POSES[10:11], FRAMES, 0), LENS, np.arange(FRAMES) / 15.0)
    assert found.gaze is None and np.isnan(found.pose_arrays["gaze"]).all()
    assert field_faults(found.record(np.arange(FRAMES)), below(TRACKING, "eyes")) == []
    assert found.record(np.arange(FRAMES))["blinks"] == list(range(FRAMES))


def test_a_mesh_without_eyeballs_has_no_eyes(model):
    surface = surface_of(model)
    bare = Surface(surface.mesh)
    assert track_eyes(bare, seen_eyes(surface), POSES, LENS, np.arange(FRAMES) / 15.0) is None


def test_lids_in_frames_are_those_of_the_frames_asked_for():
    """Of the eyes that tracking.json calls shut throughout none moves."""
    frames = np.array([2, 4, 6, 9])
    landmarks = {"frame_index": frames, "eye_openness": np.array([1.0, 0.1, 1.0, 0.1])[:, None] * np.ones(2)}
    blinks = {"eyes": {"shut_right": [4, 9], "shut_left": [4, 9]}}
    found = lids_in_frames(landmarks, blinks, frames[[0, 1, 3]])
    np.testing.assert_allclose(found, [[0, 0], [1, 1], [1, 1]], atol=1e-12)
    shut = {"eyes": {"shut_right": [2, 4, 6, 9], "shut_left": [4, 9]}}
    assert lids_in_frames(landmarks, shut, frames)[:, 0].tolist() == [0.0] * 4
    assert lids_in_frames({"frame_index": frames}, blinks, frames) is None


def test_irises_are_followed_and_the_lids_openings_found_in_the_pictures():
    gaze, poses, lens = drawn_eyes.gaze_on_the_camera(), drawn_eyes.poses(), drawn_eyes.LENS
    seen, true = drawn_eyes.drawn(gaze, np.ones(len(gaze)), glint=False), drawn_eyes.iris_centres(gaze)
    surface, time_s = two_balls(drawn_eyes.CENTRES, drawn_eyes.RADIUS_MM), np.arange(len(gaze)) / 10
    found = track_eyes(surface, seen, poses, lens, time_s)
    before, after = (np.linalg.norm(px[:, :, 0] - true, axis=-1) for px in (seen.iris_px, found.seen.iris_px))
    assert np.median(after) < 0.5 * np.median(before)
    assert found.seen.pictures == () and np.isfinite(found.openings.points).all()
    plain = track_eyes(surface, replace(seen, pictures=()), poses, lens, time_s)
    assert plain.openings is None and np.array_equal(plain.seen.iris_px, seen.iris_px)
