"""Frames of a turning egg that are looked for from a pose that is far off."""

from dataclasses import replace

import numpy as np
import pytest
from shapes import nods
from toy_head import toy_head
from toy_plane import plane_texture

from shared.geometry.mesh import interpolate
from shared.geometry.raycast import RayScene, camera_hits
from shared.geometry.transforms import rotation_from_vector
from shared.imaging.image_sampling import remap
from shared.tracking.first_poses import UNTRACKED_SEGMENTS
from shared.tracking.pose_uncertainty import rotations_apart
from shared.tracking.texture_tracking import coarse_pass, look_from_afar, track_texture
from shared.tracking.tracked_clip import TrackedClip

SIZE, WIDTH_PX = 340, 300.0
LENS = np.array([[1800.0, 0, SIZE / 2], [0, 1800.0, SIZE / 2], [0, 0, 1]])
LOST = np.array([3, 7])


def across(width_px, frames):
    """Landmarks [F, 2, 2] px of a face of that width."""
    return np.tile([[0.0, 0.0], [width_px, 0.0]], (frames, 1, 1))


def whole(items, label=""):
    return items


@pytest.fixture(scope="module")
def egg_clip():
    """Model, clip and poses of an egg with blotches of some to a hundred pixels, which stand for its local contrast."""
    model = toy_head(4)
    model = replace(model, segment_names=("face", *UNTRACKED_SEGMENTS),
                    face_segment=np.where(model.face_segment == 0, 0, 1 + UNTRACKED_SEGMENTS.index("scalp")))
    texture, scene = plane_texture(1440, (6, 25, 80), 35.0), RayScene(model.template, model.faces)
    poses = nods(np.linspace(-16.0, 16.0, 11))
    pictures = []
    for seed, pose in enumerate(poses):
        face, bary, _ = camera_hits(scene, pose, LENS, SIZE, SIZE)
        picture, hit = np.full((SIZE, SIZE), 128.0), face >= 0
        place = (interpolate(model.template, model.faces, face[hit], bary[hit])[:, :2] / 240.0 + 0.5) * 1440
        picture[hit] = remap(texture, place)
        noise = np.random.default_rng(seed).normal(0, 3.0, picture.shape)
        pictures.append((picture + noise).round().clip(0, 255).astype(np.uint8))
    clean = [np.zeros((SIZE, SIZE), np.uint8)] * len(poses)
    landmarks = across(WIDTH_PX, len(poses))
    clip = TrackedClip(pictures, pictures, clean, landmarks, np.arange(len(poses)) / 25.0, LENS, (SIZE, SIZE))
    return model, clip, poses


def test_a_frame_is_found_from_where_a_single_pass_stays(egg_clip):
    """A head that turns at once lies beyond the windows' reach, and its tracks agree with where it is not."""
    model, clip, poses = egg_clip
    lost, settings = np.isin(np.arange(clip.count), LOST), coarse_pass(WIDTH_PX)
    begun = poses.copy()
    begun[lost, :3, :3] = rotation_from_vector(np.radians([3.0, -8.0, 2.0])) @ poses[lost, :3, :3]
    begun[lost, :3, 3] += [5.0, -4.0, 18.0]
    arguments = clip, model, model.template

    def off_deg(start):
        _, _, found = track_texture(*arguments, start, ~lost, lost, settings, whole)
        return np.degrees(np.linalg.norm(rotations_apart(found[:, :3, :3], poses[:, :3, :3]), axis=1))[lost]

    near, = look_from_afar(*arguments, [begun], ~lost, lost, settings, whole)
    assert np.array_equal(near[~lost], poses[~lost])
    assert off_deg(begun).min() > 3.0
    assert off_deg(near).max() < 0.3


def test_a_small_face_is_not_looked_for_in_texels_that_show_nothing_of_it(egg_clip):
    """Of a face 55 px wide a window of texels twice as large would see nearly all."""
    model, clip, poses = egg_clip
    lost, small = np.isin(np.arange(clip.count), LOST), replace(clip, landmarks_px=across(55.0, clip.count))
    far, = look_from_afar(small, model, model.template, [poses + 0.0], ~lost, lost, coarse_pass(55.0), whole)
    assert np.array_equal(far, poses)
