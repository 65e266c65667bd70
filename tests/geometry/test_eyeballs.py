"""The eyeballs of the head model, and gaze as directions and rotations."""

import numpy as np
import pytest
from shapes import sphere

from shared.geometry.eyeballs import (
    eyeballs_of,
    fit_sphere,
    gaze_between,
    gaze_direction,
    gaze_rotation,
    gaze_shown,
    gaze_towards,
    pitch_from_rest,
)
from shared.geometry.mesh import Mesh
from shared.geometry.surface import Surface

RNG = np.random.default_rng(4)
GAZES = RNG.uniform(-0.7, 0.7, (20, 2))


def two_balls(segment_names=("eyes", "skin"), segments=(0, 0)):
    ball = sphere(levels=2)
    vertices = np.concatenate([12.0 * ball.vertices + (x, 30.0, 60.0) for x in (31.0, -31.0)])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    return Surface(
        Mesh(vertices, faces, np.zeros((1, 2)), np.zeros_like(faces)),
        np.repeat(segments, len(ball.faces)),
        segment_names,
    )


def test_right_eye_comes_first_and_is_on_the_side_of_negative_x():
    surface = two_balls()
    right, left = eyeballs_of(surface)
    for ball, x in ((right, -31.0), (left, 31.0)):
        np.testing.assert_allclose(ball.centre, [x, 30.0, 60.0], atol=1e-9)
        assert ball.radius == pytest.approx(12.0)
        assert set(ball.vertices) == set(surface.mesh.faces[ball.faces].ravel())
    assert not set(right.faces) & set(left.faces)


@pytest.mark.parametrize(
    "surface", [two_balls(segment_names=("lids", "skin")), two_balls(segments=(1, 0)), Surface(two_balls().mesh)]
)
def test_a_mesh_without_two_eyes_has_none(surface):
    assert eyeballs_of(surface) is None


def test_sphere_through_a_part_of_it():
    points = [1.0, -2.0, 300.0] + 11.5 * gaze_direction(GAZES)
    centre, radius = fit_sphere(points)
    np.testing.assert_allclose(centre, [1.0, -2.0, 300.0], atol=1e-8)
    assert radius == pytest.approx(11.5)


def test_gaze_is_yaw_to_the_viewers_right_and_pitch_up():
    np.testing.assert_allclose(gaze_direction(np.zeros(2)), [0, 0, 1])
    assert gaze_direction(np.array([0.1, 0.0]))[0] > 0 and gaze_direction(np.array([0.0, 0.1]))[1] > 0
    np.testing.assert_allclose(gaze_towards(7.0 * gaze_direction(GAZES)), GAZES, atol=1e-12)


def test_the_rotation_of_a_gaze_turns_the_eye_to_it():
    rotation = gaze_rotation(GAZES)
    np.testing.assert_allclose(rotation @ [0.0, 0.0, 1.0], gaze_direction(GAZES), atol=1e-12)
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12)
    right, _ = eyeballs_of(two_balls())
    front = right.centre + [0.0, 0.0, right.radius]
    turned = right.centre + rotation[0] @ (front - right.centre)
    np.testing.assert_allclose(turned, right.centre + right.radius * gaze_direction(GAZES[0]), atol=1e-9)


def test_an_iris_beside_the_mesh_s_eyeball_is_shown_on_the_line_of_sight():
    right, _ = eyeballs_of(two_balls())
    cameras = right.centre + 500.0 * gaze_direction(RNG.uniform(-0.4, 0.4, (20, 2)))
    on_ball = right.centre + right.radius * gaze_direction(GAZES)
    np.testing.assert_allclose(gaze_shown(right, on_ball, cameras), GAZES, atol=1e-9)
    beside = on_ball + RNG.uniform(-2.0, 2.0, (20, 3))
    shown = right.centre + right.radius * gaze_direction(gaze_shown(right, beside, cameras))
    off = np.cross(shown - cameras, beside - cameras)
    np.testing.assert_allclose(off / 500.0**2, 0.0, atol=1e-9)
    assert np.isnan(gaze_shown(right, np.full((1, 3), np.nan), cameras[:1])).all()
    past = right.centre + [[3.0 * right.radius, 0.0, 0.0]]
    limb = gaze_shown(right, past, right.centre + [[0.0, 0.0, 500.0]])
    assert limb[0, 0] == pytest.approx(np.pi / 2, abs=0.1)


def test_a_shut_eye_looks_as_it_does_before_and_after():
    """And as the other one where it is never seen; where neither is, nobody knows."""
    gaze = np.full((5, 2, 2), np.nan)
    gaze[1, 0], gaze[3, 0] = [0.1, -0.2], [0.3, 0.2]
    found = gaze_between(gaze)
    np.testing.assert_allclose(found[:, 0], [[0.1, -0.2], [0.1, -0.2], [0.2, 0.0], [0.3, 0.2], [0.3, 0.2]])
    np.testing.assert_array_equal(found[:, 1], found[:, 0])
    assert np.isnan(gaze_between(np.full((3, 2, 2), np.nan))).all()


def test_lids_are_at_rest_in_the_middle_of_what_is_known_of_the_gaze():
    gaze = np.zeros((5, 2, 2))
    gaze[:, :, 1] = np.array([0.0, 0.1, np.nan, 0.3, 0.1])[:, None] + [0.02, -0.02]
    expected = np.array([-0.1, 0.0, 0.1, 0.2, 0.0])[:, None] * np.ones(2)
    np.testing.assert_allclose(pitch_from_rest(gaze), expected, atol=1e-12)
    np.testing.assert_array_equal(pitch_from_rest(np.full((3, 2, 2), np.nan)), np.zeros((3, 2)))
