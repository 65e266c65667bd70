"""Poses of all frames from those of some: another tracker's, interpolated ones, and where landmarks know better."""

from dataclasses import replace

import numpy as np

from shared.geometry import project, rigid, rotation_from_vector
from shared.solve import track_head
from shared.solve.first_poses import interpolate_poses
from shared.solve.pose_trust import rotations_apart
from shared.solve.track_head import carried_poses, follow_landmarks
from shared.solve.tracked_clip import TrackedClip


def some_poses(count, seed=0):
    rng = np.random.default_rng(seed)
    turn = rotation_from_vector(0.3 * rng.normal(size=(count, 3)))
    return rigid(turn, [0, 0, 900.0] + 20 * rng.normal(size=(count, 3)))


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
    yaw = np.radians(np.minimum(np.arange(frames) * 1.5, 30.0))
    turn = np.diag([1.0, -1, -1]) @ rotation_from_vector(np.stack([0 * yaw, yaw, 0 * yaw], axis=1))
    poses = rigid(turn, np.tile([0.0, 0, 900.0], (frames, 1)))
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
