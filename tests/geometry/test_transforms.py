"""Rigid motions, projection, alignment."""

import numpy as np
import pytest

from shared.geometry import transforms


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def random_poses(rng, count):
    rotation = transforms.rotation_from_vector(rng.normal(size=(count, 3)))
    return transforms.rigid(rotation, rng.normal(size=(count, 3)) + [0, 0, 10])


def test_rotation_vector_round_trip(rng):
    vectors = rng.uniform(-1.5, 1.5, size=(20, 3))
    assert np.allclose(transforms.vector_from_rotation(transforms.rotation_from_vector(vectors)), vectors)


def test_quarter_turn_about_y_takes_z_to_x():
    turn = transforms.rotation_from_vector(np.array([0.0, np.pi / 2, 0.0]))
    assert np.allclose(turn @ [0, 0, 1], [1, 0, 0])


def test_invert_rigid(rng):
    poses = random_poses(rng, 5)
    assert np.allclose(transforms.invert_rigid(poses) @ poses, np.eye(4))


def test_projection_follows_the_pixel_convention():
    lens = np.array([[100.0, 0, 320], [0, 100.0, 240], [0, 0, 1]])
    pose = transforms.rigid(np.eye(3), np.array([0.0, 0.0, 50.0]))
    pixels, depth = transforms.project(np.array([[0.0, 0, 0], [1.0, 2.0, 50.0]]), pose, lens)
    assert np.allclose(pixels, [[320, 240], [321, 242]])
    assert np.allclose(depth, [50, 100])


def test_camera_centre_projects_from_nowhere(rng):
    poses = random_poses(rng, 4)
    centres = transforms.camera_centres(poses)
    assert np.allclose(np.einsum("fij,fj->fi", poses[:, :3, :3], centres) + poses[:, :3, 3], 0)


@pytest.mark.parametrize("with_scale", [True, False])
def test_similarity_recovers_a_known_motion(rng, with_scale):
    source = rng.normal(size=(30, 3))
    rotation = transforms.rotation_from_vector(np.array([0.3, -1.0, 0.4]))
    factor = 2.5 if with_scale else 1.0
    target = factor * source @ rotation.T + [1, 2, 3]
    scale, found, shift = transforms.similarity_from_points(source, target, with_scale)
    assert scale == pytest.approx(factor)
    assert np.allclose(found, rotation)
    assert np.allclose(shift, [1, 2, 3])


def test_similarity_never_mirrors(rng):
    source = rng.normal(size=(30, 3))
    _, rotation, _ = transforms.similarity_from_points(source, source * [1, 1, -1])
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_similarity_ignores_points_of_no_weight(rng):
    source = rng.normal(size=(30, 3))
    target = source + [5.0, 0, 0]
    target[0] += 100
    weights = np.ones(30)
    weights[0] = 0
    assert np.allclose(transforms.similarity_from_points(source, target, True, weights)[2], [5, 0, 0])


def test_fibonacci_sphere_integrates_low_harmonics():
    directions = transforms.fibonacci_sphere(512)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    assert np.abs(directions.mean(0)).max() < 1e-3
    assert np.allclose(directions.T @ directions / 512, np.eye(3) / 3, atol=2e-3)


def test_the_world_stands_still_when_the_camera_moves(rng):
    poses = random_poses(rng, 3)
    assert np.allclose(transforms.world_from_head(poses, "camera"), np.eye(3))
    assert np.allclose(transforms.world_from_head(poses, "head")[0], np.diag([1, -1, -1]) @ poses[0, :3, :3])
