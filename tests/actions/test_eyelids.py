"""Lids that shut over the eyeballs, and never pass through them."""

from dataclasses import replace

import numpy as np
import pytest

from shared.actions.eyelids import CLEAR_MM, FOLLOW
from shared.actions.facial import facial_actions
from shared.geometry.blend_shapes import BLINKS, LOOK_RAD, LOOKS_DOWN, LOOKS_UP
from shared.geometry.eyeballs import eyeballs_of
from shared.geometry.raycast import RayScene
from shared.tracking.fit_lids import LidMargins

WEIGHTS = np.linspace(0.0, 1.0, 21)
VIEWS = np.array([[0.0, 0, -1], [0.0, 0.5, -0.8], [0.0, -0.5, -0.8], [-0.7, 0, -0.7], [0.7, 0, -0.7]])


@pytest.fixture(params=[0, 1], ids=["right", "left"])
def eye(request, solved):
    """(which eye, its ball, its blink)."""
    return request.param, eyeballs_of(solved.surface)[request.param], solved.shapes[BLINKS[request.param]]


def polar(points, ball):
    """Azimuth and height [n] in radians, distance [n] mm, of points [n, 3] about a ball's centre."""
    x, y, z = (points - ball.centre).T
    return np.arctan2(x, np.hypot(y, z)), np.arctan2(y, z), np.linalg.norm(points - ball.centre, axis=1)


def gaps_mm(margins, vertices, ball):
    """[2, n]: between upper and lower margin, up and forward, at azimuths that both have."""
    (lower, upper), azimuths = ([polar(vertices[own], ball) for own, _ in margins], np.linspace(-0.6, 0.6, 25))
    found = []
    for azimuth, *values in (lower, upper):
        order = np.argsort(azimuth)
        found.append([np.interp(azimuths, azimuth[order], value[order]) for value in values])
    (low, near), (high, far) = found
    return np.stack([(high - low) * ball.radius, far - near])


def eye_seen(solved, vertices, ball) -> int:
    """How many rays of a quarter of a millimetre's grid, from five sides, meet an eyeball first."""
    scene, count, eyes = RayScene(vertices, solved.model.faces), 0, solved.model.segment("eyes")
    grid = np.stack(np.meshgrid(np.arange(-16, 16, 0.25), np.arange(-16, 16, 0.25)), -1).reshape(-1, 2)
    for view in VIEWS / np.linalg.norm(VIEWS, axis=1, keepdims=True):
        right = np.cross(view, [0.0, 1.0, 0.0])
        origins = ball.centre + grid @ np.stack([right / np.linalg.norm(right), np.cross(right, view)]) - 100.0 * view
        face = scene.first_faces(origins, np.tile(view, (len(grid), 1)))
        count += int(eyes[face[face >= 0]].sum())
    return count


def test_shut_margins_meet(solved, eye):
    """Where they are millimetres apart at rest; in height and in depth."""
    which, ball, blink = eye
    margins = LidMargins.of(solved.model).fronts[which]
    vertices = solved.surface.mesh.vertices
    assert gaps_mm(margins, vertices, ball)[0].min() > 3.0
    assert np.abs(gaps_mm(margins, blink.applied(vertices, 1.0), ball)).max() < 0.05


def test_shut_lids_hide_the_eyeball(solved, eye):
    _, ball, blink = eye
    vertices = solved.surface.mesh.vertices
    assert eye_seen(solved, vertices, ball) > 2000
    assert eye_seen(solved, blink.applied(vertices, 0.5), ball) > 500
    assert eye_seen(solved, blink.applied(vertices, 1.0), ball) == 0


def test_lids_keep_out_of_the_ball_at_all_weights(solved, eye):
    """Every vertex of skin that is CLEAR_MM outside at rest; a straight way would cut into the ball."""
    _, ball, blink = eye
    vertices = solved.surface.mesh.vertices
    lids = solved.surface.vertices_of(("lids",))[blink.vertices]
    own = blink.vertices[lids]
    own = own[np.linalg.norm(vertices[own] - ball.centre, axis=1) > ball.radius + CLEAR_MM]
    lengths = [np.linalg.norm(blink.applied(vertices, weight)[own] - ball.centre, axis=1) for weight in WEIGHTS]
    assert np.min(lengths) > ball.radius - 0.05
    straight = 0.5 * (vertices[own] + blink.applied(vertices, 1.0)[own])
    inside = ball.radius - np.linalg.norm(straight - ball.centre, axis=1)
    assert inside.max() > 0.1


def test_half_of_a_blink_shows_half_of_the_eye(solved, eye):
    which, ball, blink = eye
    margins = LidMargins.of(solved.model).fronts[which]
    vertices = solved.surface.mesh.vertices
    rest, half = (gaps_mm(margins, blink.applied(vertices, weight), ball)[0] for weight in (0.0, 0.5))
    np.testing.assert_allclose(half / rest, 0.5, atol=0.1)


def test_other_actions_keep_lids_out_of_the_balls(solved):
    vertices = solved.surface.mesh.vertices
    lids = np.nonzero(solved.surface.vertices_of(("lids",)))[0]
    for ball in eyeballs_of(solved.surface):
        own = lids[np.sign(vertices[lids, 0]) == np.sign(ball.centre[0])]
        own = own[np.linalg.norm(vertices[own] - ball.centre, axis=1) > ball.radius + CLEAR_MM]
        for name, shape in solved.shapes.items():
            lengths = [np.linalg.norm(shape.applied(vertices, weight)[own] - ball.centre, axis=1)
                       for weight in (0.25, 0.5, 0.75, 1.0)]
            assert np.min(lengths) > ball.radius - 0.05, name


@pytest.mark.parametrize("names, sign", [(LOOKS_DOWN, -1.0), (LOOKS_UP, 1.0)], ids=["down", "up"])
def test_lids_follow_the_gaze(solved, eye, names, sign):
    """In the middle by their shares of the angle, in the corners not at all; the other eye stays as it is."""
    which, ball, _ = eye
    shape, vertices = solved.shapes[names[which]], solved.surface.mesh.vertices
    moved = shape.applied(vertices, 1.0)
    margins = LidMargins.of(solved.model, splits=1)
    for loop, share in zip(margins.loops[which], FOLLOW, strict=True):
        turned = polar(moved[loop], ball)[1] - polar(vertices[loop], ball)[1]
        assert turned[len(loop) // 2] == pytest.approx(sign * share * LOOK_RAD, rel=0.2)
        assert np.abs(turned[[0, -1]]).max() < 0.02
    other = np.sign(vertices[shape.vertices, 0]) != np.sign(ball.centre[0])
    assert np.linalg.norm(shape.offsets[other], axis=1).max(initial=0.0) < 0.05


def test_eyes_that_are_shut_need_no_blink(model, solved):
    """What is left of it lays the margins on each other."""
    blinks = [solved.shapes[name] for name in BLINKS]
    vertices = solved.surface.mesh.vertices
    for blink in blinks:
        vertices = blink.applied(vertices, 1.0)
    chosen = [k for k, name in enumerate(model.expression_names) if name.startswith("eye_blink")]
    few = replace(model, expression_basis=model.expression_basis[chosen],
                  expression_names=tuple(model.expression_names[k] for k in chosen))
    again = {shape.name: shape for shape in facial_actions(few, vertices, solved.model.faces)}
    for name in BLINKS:
        moved = np.linalg.norm(again[name].offsets, axis=1).max() if name in again else 0.0
        assert moved < 0.5
