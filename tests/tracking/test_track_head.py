"""Poses of all frames from those of some: another tracker's, interpolated ones, and where landmarks know better."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from quick import TINY
from shapes import nods, turned

from shared.contract import main
from shared.errors import InputError
from shared.geometry.transforms import project, rigid, rotation_from_vector
from shared.io.arrays import load_arrays
from shared.io.images import read_png, write_png
from shared.tracking import track_head
from shared.tracking.bundle import Tracks
from shared.tracking.first_poses import interpolate_poses
from shared.tracking.pose_uncertainty import rotations_apart
from shared.tracking.track_head import agreement, carried_poses, clearly_more, follow_landmarks, refuse_still_head
from shared.tracking.tracked_clip import TrackedClip
from stages import sample_frames, track_landmarks


def some_poses(count, seed=0):
    rng = np.random.default_rng(seed)
    turn = rotation_from_vector(0.3 * rng.normal(size=(count, 3)))
    return rigid(turn, [0, 0, 900.0] + 20 * rng.normal(size=(count, 3)))


def test_still_head_is_refused_with_what_to_film():
    still = turned(np.zeros((12, 3)))
    shaken = still + np.pad(np.random.default_rng(0).normal(0, 0.05, (12, 3, 1)), ((0, 0), (0, 1), (3, 0)))
    for poses in (still, shaken):
        with pytest.raises(InputError, match="does not turn.*25 degrees to each side.*poster"):
            refuse_still_head(poses)
    refuse_still_head(some_poses(5))


def test_still_face_and_poster_end_with_exit_code_2(tmp_path, capsys):
    """One frame again and again with noise: nothing turns. The stage refuses it, where it gave NaN or passed."""
    rng, picture = np.random.default_rng(0), read_png(TINY / "frames" / "0005.png").astype(float)
    (tmp_path / "still" / "frames").mkdir(parents=True)
    for i in range(8):
        noisy = np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).round().astype(np.uint8)
        write_png(tmp_path / "still" / "frames" / f"{i:04d}.png", noisy)
    shutil.copy(TINY / "subject.yaml", tmp_path / "still")
    arguments = ["--subject", str(tmp_path / "still"), "--out", str(tmp_path / "out")]
    fast = [part for value in ("start_frames=8", "references=1", "tracks=500") for part in ("--set", value)]
    assert main(sample_frames.STAGE, sample_frames.run, sample_frames.check, arguments) == 0
    stage = track_landmarks.STAGE, track_landmarks.run, track_landmarks.check
    assert main(*stage, [*arguments, *fast]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "the head does not turn" in said and "25 degrees to each side" in said


def test_mirrored_pictures_give_the_mirrored_poses(tiny_run, tmp_path):
    """Nothing in the pictures tells that they are mirrored: what comes out is right for the head in the mirror."""
    (tmp_path / "mirrored" / "frames").mkdir(parents=True)
    for path in (TINY / "frames").iterdir():
        write_png(tmp_path / "mirrored" / "frames" / path.name, np.ascontiguousarray(read_png(path)[:, ::-1]))
    shutil.copy(TINY / "subject.yaml", tmp_path / "mirrored")
    arguments = ["--subject", str(tmp_path / "mirrored"), "--out", str(tmp_path / "out")]
    assert main(sample_frames.STAGE, sample_frames.run, sample_frames.check, arguments) == 0
    assert main(track_landmarks.STAGE, track_landmarks.run, track_landmarks.check, arguments) == 0
    found, straight = (load_arrays(folder / "work" / "track_landmarks" / "poses.npz")
                       for folder in (tmp_path / "out" / "mirrored", tiny_run))
    assert np.array_equal(found["frame_index"], straight["frame_index"])
    mirror = np.diag([-1.0, 1, 1])
    apart = rotations_apart(found["camera_from_head"][:, :3, :3],
                            mirror @ straight["camera_from_head"][:, :3, :3] @ mirror)
    assert np.degrees(np.sqrt((apart**2).sum(1).mean())) < 0.75


def test_held_poses_go_to_the_heads_space_in_its_unit():
    given = some_poses(9)
    turn, shift, scale = rotation_from_vector(np.array([0.2, -0.4, 0.1])), np.array([5.0, -3.0, 12.0]), 0.97
    expected = rigid(
        given[:, :3, :3] @ turn.T, scale * given[:, :3, 3] - (given[:, :3, :3] @ turn.T @ shift)
    )
    found = carried_poses(given, given[::3], expected[::3])
    assert np.abs(found - expected).max() < 1e-8


def test_interpolated_poses_pass_through_the_given_ones_and_stay_rigid():
    known, time_s = some_poses(4, seed=1), np.array([0.0, 0.4, 1.0, 1.2])
    wanted = np.array([-1.0, 0.0, 0.2, 0.4, 0.7, 1.2, 5.0])
    found = interpolate_poses(known, time_s, wanted)
    assert np.abs(found[[1, 3, 5]] - known[[0, 1, 3]]).max() < 1e-9
    assert np.abs(found[0] - known[0]).max() < 1e-9 and np.abs(found[6] - known[3]).max() < 1e-9
    turned = found[:, :3, :3]
    assert np.abs(turned @ np.swapaxes(turned, 1, 2) - np.eye(3)).max() < 1e-9
    assert np.abs(found[2, :3, 3] - 0.5 * (known[0, :3, 3] + known[1, :3, 3])).max() < 1e-9


def landmark_model(count=60, seed=2):
    """Points of a face, and their landmarks' places in 468 with NaN elsewhere."""
    rng = np.random.default_rng(seed)
    named = np.full((468, 3), np.nan)
    named[:count] = rng.uniform([-60, -60, 50], [60, 60, 100], size=(count, 3))
    return named


INTRINSICS = np.array([[2700.0, 0, 200], [0, 2700.0, 200], [0, 0, 1]])


def stopping_clip(named, bias_deg=1.5, frames=41):
    """A head that turns and stops at once, seen through landmarks that are turned by a constant bias."""
    poses = nods(np.minimum(np.arange(frames) * 1.5, 30.0))
    biased = np.nan_to_num(named) @ rotation_from_vector(np.radians([bias_deg, bias_deg, 0.0])).T
    pixels, _ = project(biased, poses, INTRINSICS)
    clip = TrackedClip([None] * frames, [], [], pixels, np.arange(frames) / 25.0, INTRINSICS, (400, 400))
    return clip, poses


def test_a_sudden_stop_is_followed_and_the_landmarks_bias_left_out():
    named = landmark_model()
    clip, poses = stopping_clip(named)
    known = np.zeros(clip.count, bool)
    known[::8] = True
    straight = interpolate_poses(poses[known], clip.time_s[known], clip.time_s)
    followed = follow_landmarks(clip, named, poses[known], known)
    off, left = (np.degrees(np.linalg.norm(rotations_apart(p[:, :3, :3], poses[:, :3, :3]), axis=1)).max()
                 for p in (straight, followed))
    assert off > 1.5  # the stop lies between two known frames
    assert left < 0.3 * off
    assert np.abs(followed[known] - poses[known]).max() < 1e-9


def test_steady_motion_is_interpolated_not_followed():
    named = landmark_model()
    clip, poses = stopping_clip(named, frames=17)
    known = np.zeros(clip.count, bool)
    known[::8] = True
    shaken = replace(clip, landmarks_px=clip.landmarks_px + np.random.default_rng(0).normal(0, 1.0, (17, 468, 2)))
    straight = interpolate_poses(poses[known], clip.time_s[known], clip.time_s)
    assert np.abs(follow_landmarks(shaken, named, poses[known], known) - straight).max() < 1e-12


def test_a_pose_that_its_landmarks_contradict_is_not_followed(monkeypatch):
    """Among gross outliers the robust estimate can end anywhere."""
    named = landmark_model()
    clip, poses = stopping_clip(named, frames=17)
    known = np.zeros(clip.count, bool)
    known[::8] = True
    honest = track_head.landmark_poses(clip, named)
    lost = rigid(rotation_from_vector(np.array([0.1, 0.3, 0.0])) @ honest[5][:3, :3], honest[5][:3, 3])
    monkeypatch.setattr(track_head, "landmark_poses", lambda *_: [*honest[:5], lost, *honest[6:]])
    straight = interpolate_poses(poses[known], clip.time_s[known], clip.time_s)
    assert np.abs(follow_landmarks(clip, named, poses[known], known) - straight).max() < 1e-12


def test_tracks_tell_which_of_two_poses_a_frame_has():
    """With the right pose all agree, with one that is half the scale off four fifths, with one far off hardly any;
    tracks that a frame does not show say nothing."""
    named = np.nan_to_num(landmark_model())
    poses = nods(np.array([5.0, 5.0, 5.0, 5.0]))
    pixels, _ = project(named, poses, INTRINSICS)
    pixels[1] += [0.5, 0.0]
    pixels[2] += [30.0, 40.0]
    pixels[3, 100:] = np.nan
    found = agreement(Tracks.of_equal_noise(pixels, 1.0), named, poses, INTRINSICS, 1.0)
    np.testing.assert_allclose(found, [468, 468 / 1.25, 468 / 2501, 100], rtol=1e-6)


def test_a_frame_whose_tracks_hardly_tell_stays_where_its_landmarks_have_it():
    """Counts as they were under landmarks that slide (the other place 13 degrees off) and under a hard lamp (right)."""
    assert list(clearly_more(np.array([215.3, 329.3]), np.array([216.2, 741.6]))) == [False, True]
