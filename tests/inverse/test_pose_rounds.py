"""Poses tracked again on a surface that is known better by now."""

import numpy as np
import pytest
from shapes import turned
from toy_head import toy_head

from shared.compute.run_context import SILENT
from shared.geometry.raycast import RayScene, camera_hits
from shared.geometry.surface import Surface
from shared.geometry.transforms import rotation_from_vector
from shared.inverse.clip_inputs import TrackedPoses
from shared.inverse.pose_rounds import repeat_poses
from shared.tracking.pose_uncertainty import rotations_apart
from shared.tracking.tracked_clip import GreyFrame, TrackedClip

FRAMES, SIZE = 14, 240
LENS = np.array([[1000.0, 0, 120], [0, 1000.0, 120], [0, 0, 1]])
TRUTH = turned(np.stack([0.08 * np.cos(np.linspace(0, 3, FRAMES)), np.linspace(-0.35, 0.35, FRAMES),
                         np.zeros(FRAMES)], axis=1))
JITTER = np.radians(0.15)


@pytest.fixture(scope="module")
def egg():
    model = toy_head(5)
    mesh = model.mesh(np.zeros(2), np.zeros(1))
    return Surface(mesh, model.face_segment, model.segment_names)


@pytest.fixture(scope="module")
def clip(egg):
    """The egg with freckles of 3 to 12 mm in its skin, in even light."""
    rng, mesh = np.random.default_rng(1), egg.mesh
    waves = rng.normal(size=(60, 3))
    waves *= (2.0 * np.pi / rng.uniform(3.0, 12.0, 60) / np.linalg.norm(waves, axis=1))[:, None]
    phase, scene = rng.uniform(0, 2 * np.pi, 60), RayScene(mesh.vertices, mesh.faces)
    greys = []
    for pose in TRUTH:
        face, bary, _ = camera_hits(scene, pose, LENS, SIZE, SIZE)
        place = (mesh.vertices[mesh.faces[np.maximum(face, 0)]] * bary[..., None]).sum(2)
        grey = 120.0 + 6.0 * np.sin(place @ waves.T + phase).sum(-1) + rng.normal(0, 1.0, face.shape)
        codes = np.where(face >= 0, np.clip(grey, 20, 235), 0).astype(np.uint8)
        greys.append(GreyFrame.of(np.repeat(codes[..., None], 3, 2), face < 0))
    detail, unusable = [grey.detail() for grey in greys], [grey.unusable for grey in greys]
    return TrackedClip(detail, detail, unusable, np.empty((FRAMES, 0, 2)), np.arange(FRAMES) / 10.0, LENS, (SIZE, SIZE))


def repeated(clip, egg, poses, deviation_rad, rounds=3):
    covariance = np.tile(np.diag([deviation_rad**2 / 3.0] * 3 + [0.01] * 3), (FRAMES, 1, 1))
    return repeat_poses(TrackedPoses(lambda: clip, covariance), egg, poses, rounds, SILENT)


def errors(poses):
    return rotations_apart(poses[:, :3, :3], TRUTH[:, :3, :3])


def test_wrong_poses_are_mended_and_say_how_well(clip, egg):
    poses = TRUTH.copy()
    poses[:, :3, :3] = rotation_from_vector(np.random.default_rng(2).normal(0, JITTER, (FRAMES, 3))) @ TRUTH[:, :3, :3]
    found = repeated(clip, egg, poses, 2.0 * JITTER)
    assert found.serves
    assert found.record["held_out_px"]["after"] < found.record["held_out_px"]["before"]
    before, after = (np.linalg.norm(errors(some), axis=1).mean() for some in (poses, found.camera_from_head))
    assert after < 0.25 * before
    rotation = found.covariance[:, :3, :3]
    squared = np.einsum("fi,fi->f", errors(found.camera_from_head),
                        np.linalg.solve(rotation, errors(found.camera_from_head)[..., None])[..., 0])
    assert (squared < 6.25).mean() >= 0.9  # the 90 % region


def test_poses_that_are_right_stay_as_they_are(clip, egg):
    found = repeated(clip, egg, TRUTH, np.radians(0.5))
    assert not found.serves
    assert found.camera_from_head is TRUTH
    assert len(found.record["rounds_deg"]) == 1  # at rest after one
