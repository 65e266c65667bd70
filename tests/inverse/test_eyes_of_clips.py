"""Gaze and lids on their way from tracking to the views."""

import numpy as np
from shapes import FACING, sphere

from shared.geometry.eyeballs import eyeballs_of, gaze_direction, gaze_towards
from shared.geometry.mesh import Mesh
from shared.geometry.surface import Surface
from shared.geometry.transforms import project, rigid, rotation_from_vector
from shared.imaging.views import Views
from shared.inverse.clip_inputs import _lids, _shown_gaze
from shared.inverse.joint_clips import Placed, join_views

LENS = np.array([[800.0, 0, 100], [0, 800.0, 100], [0, 0, 1]])
RNG = np.random.default_rng(6)
GAZE = RNG.uniform(-0.4, 0.4, (4, 2, 2))


def two_eyes():
    ball = sphere(14.0, 3)
    vertices = np.concatenate([ball.vertices + (x, 30.0, 60.0) for x in (-31.0, 31.0)])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    return Surface(Mesh(vertices, faces, np.zeros((1, 2)), np.zeros_like(faces)), np.zeros(len(faces)), ("eyes",))


def views_of(gaze, lids_px=None):
    poses = np.stack([rigid(FACING, np.array([0.0, 0.0, 500.0]))] * len(GAZE))
    return Views.in_one_light(poses, LENS, (200, 200), "head", None, None, gaze=gaze, lids_px=lids_px)


def test_irises_are_shown_where_the_clip_shows_them():
    surface, views = two_eyes(), views_of(GAZE)
    centres = np.array([ball.centre for ball in eyeballs_of(surface)]) + [[1.0, -2.0, 1.5], [-0.5, 1.0, 2.0]]
    said = {"centres_mm": centres.tolist(), "iris_distance_mm": 10.3}
    shown = _shown_gaze(surface, GAZE, views.camera_from_head, said)
    for k, ball in enumerate(eyeballs_of(surface)):
        for f, pose in enumerate(views.camera_from_head):
            on_mesh = ball.centre + ball.radius * gaze_direction(shown[f, k])
            iris = centres[k] + 10.3 * gaze_direction(GAZE[f, k])
            seen, expected = (project(place[None], pose[None], LENS)[0][0, 0] for place in (on_mesh, iris))
            np.testing.assert_allclose(seen, expected, atol=1e-6)
    assert _shown_gaze(surface, GAZE, views.camera_from_head, {}) is GAZE
    assert _shown_gaze(surface, np.full_like(GAZE, np.nan), views.camera_from_head, {}) is None, "shut throughout"
    assert _shown_gaze(Surface(surface.mesh), GAZE, views.camera_from_head, said) is None


def test_lids_are_a_polygon_in_order():
    angle = np.linspace(0.0, np.pi, 9)
    lower = np.stack([-np.cos(angle), np.sin(angle)], axis=1)
    upper = lower[1:-1] * [1.0, -1.0]
    seen = np.broadcast_to(np.concatenate([lower, upper]), (3, 2, 16, 2))
    polygon = _lids({"lids_px": seen}, [0, 2])
    assert polygon.shape == (2, 2, 16, 2)
    steps = np.linalg.norm(polygon[0, 0] - np.roll(polygon[0, 0], 1, axis=0), axis=1)
    np.testing.assert_allclose(steps, 2.0 * np.sin(np.pi / 16))
    assert _lids({}, [0]) is None


def test_clips_whose_gaze_is_not_known_say_nothing_of_the_eyes():
    lids = RNG.uniform(size=(4, 2, 16, 2))
    joined = join_views([views_of(None), views_of(GAZE, lids)])
    assert np.isnan(joined.gaze[:4]).all() and np.array_equal(joined.gaze[4:], GAZE)
    assert np.isnan(joined.lids_px[:4]).all() and np.array_equal(joined.lids_px[4:], lids)
    assert join_views([views_of(None), views_of(None)]).gaze is None


def test_the_gaze_turns_with_the_head_space():
    turn = rotation_from_vector(np.array([0.1, -0.2, 0.05]))
    placed = Placed(views_of(GAZE).camera_from_head, own_from_shared=turn).of(views_of(GAZE))
    np.testing.assert_allclose(gaze_direction(placed.gaze) @ turn.T, gaze_direction(GAZE), atol=1e-12)
    assert gaze_towards(gaze_direction(placed.gaze)).shape == GAZE.shape
