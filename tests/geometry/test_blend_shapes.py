"""Blend shapes: sparse, with in-betweens, of a mesh or a part of it."""

import numpy as np
from toy_result import toy_mesh

from shared.geometry.blend_shapes import (
    BLINKS,
    LID_ACTIONS,
    LOOK_RAD,
    LOOKS_DOWN,
    LOOKS_UP,
    BlendShape,
    LidActions,
    with_normals,
)
from shared.geometry.mesh import Mesh, shading_normals

MOVES = np.array([[0.0, 0, 0], [4.0, 0, 0], [0.0, 2, 0], [0.004, 0, 0], [0.0, 0, 1]])
HALF = np.array([[0.0, 0, 0], [1.0, 1, 0], [0.0, 1, 0], [0.0, 0, 0], [0.0, 0, 1]])
SHAPE = BlendShape.of("blink", MOVES, 0.01, ((0.5, HALF),))


def test_what_hardly_moves_is_left_out():
    np.testing.assert_array_equal(SHAPE.vertices, [1, 2, 4])
    assert SHAPE.offsets.dtype == np.float32
    np.testing.assert_array_equal(SHAPE.offsets, MOVES[[1, 2, 4]])


def test_between_what_is_left_out_and_the_rest_is_no_step():
    """Longer moves stay longer, none changes by more than the least, those beyond four times the least not at all."""
    long = np.linspace(0.0, 0.5, 2001)
    moves = long[:, None] * [0.6, 0.0, 0.8]
    shape = BlendShape.of("brow", moves, 0.05, ((0.5, 0.5 * moves),))
    found = np.zeros_like(moves)
    found[shape.vertices] = shape.offsets
    length = np.linalg.norm(found, axis=1)
    assert length[long <= 0.05].max() == 0.0 and np.abs(length - long).max() < 0.0501
    assert (np.diff(length) >= -1e-7).all() and np.diff(length).max() < 1.4 * long[1]
    np.testing.assert_allclose(length[long > 0.2001], long[long > 0.2001], rtol=1e-6)
    np.testing.assert_allclose(shape.between[0][1], 0.5 * shape.offsets, atol=1e-7)


def test_the_way_leads_through_the_in_between():
    for weight, expected in ((0.0, 0 * MOVES), (0.25, HALF / 2), (0.5, HALF), (0.75, (HALF + MOVES) / 2), (1.0, MOVES)):
        np.testing.assert_allclose(SHAPE.at(weight), expected[[1, 2, 4]], atol=1e-7)
    straight = BlendShape.of("jaw", MOVES, 0.01)
    np.testing.assert_allclose(straight.at(0.3), 0.3 * MOVES[[1, 2, 4]], atol=1e-7)


def test_the_way_goes_on_below_nothing_and_beyond_all():
    """A shape without in-betweens is its own multiple everywhere."""
    for weight, expected in ((-0.5, -HALF), (-1.0, -2.0 * HALF), (1.5, 2.0 * MOVES - HALF)):
        np.testing.assert_allclose(SHAPE.at(weight), expected[[1, 2, 4]], atol=1e-6)
    straight = BlendShape.of("jaw", MOVES, 0.01)
    for weight in (-2.0, -0.3, 1.7):
        np.testing.assert_allclose(straight.at(weight), weight * MOVES[[1, 2, 4]], atol=1e-6)


def test_applied_moves_the_rest_nowhere():
    rest = np.arange(15.0).reshape(5, 3)
    moved = SHAPE.applied(rest, 1.0)
    np.testing.assert_array_equal(moved[[0, 3]], rest[[0, 3]])
    np.testing.assert_allclose(moved[1], rest[1] + [4.0, 0, 0])


def test_a_part_has_its_own_numbers():
    part = SHAPE.of_part(np.array([0, 2, 3, 4]))
    np.testing.assert_array_equal(part.vertices, [1, 3])
    np.testing.assert_array_equal(part.offsets, MOVES[[2, 4]])
    np.testing.assert_array_equal(part.between[0][1], HALF[[2, 4]])
    shuffled = SHAPE.of_part(np.array([4, 1]))
    np.testing.assert_array_equal(shuffled.vertices, [0, 1])
    np.testing.assert_array_equal(shuffled.offsets, MOVES[[4, 1]])


def test_normals_added_are_those_of_the_moved_mesh():
    """Of the whole of it and of the in-between, in the part's own numbers; where all faces shrink to nothing, none."""
    mesh = toy_mesh()
    moves = np.zeros_like(mesh.vertices)
    moves[40:120] = np.random.default_rng(2).normal(0.0, 3.0, (80, 3))
    (shape,) = with_normals([BlendShape.of("smile", moves, 0.0, ((0.5, 0.7 * moves),))], mesh)
    rest = shading_normals(mesh)
    for found, moved in zip(shape.normals, (moves, 0.7 * moves), strict=True):
        after = shading_normals(mesh.replace(vertices=mesh.vertices + moved))
        np.testing.assert_allclose(rest[shape.vertices] + found, after[shape.vertices], atol=1e-6)
    part = shape.of_part(np.array([3, 77, 60]))
    np.testing.assert_array_equal(part.normals, shape.normals[:, [37, 20]])
    flat = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.eye(3)[:, :2], np.array([[0, 1, 2]]))
    (squeezed,) = with_normals([BlendShape.of("blink", -flat.vertices, 0.0)], flat)
    assert not squeezed.normals.any()


def test_lids_blink_and_follow_the_gaze_as_far_as_they_are_open():
    moves = np.random.default_rng(5).normal(size=(6, 4, 3))
    shapes = [BlendShape.of(name, own, 0.0) for name, own in zip(LID_ACTIONS, moves, strict=True)]
    lids = LidActions.of(shapes[::-1])
    shut = np.array([[0.0, 0.0], [0.25, 1.0], [0.0, 0.5], [0.0, 0.0]])
    pitch = LOOK_RAD * np.array([[0.0, 0.0], [0.5, 0.5], [-0.4, -0.4], [2.0, -2.0]])
    weights = lids.weights(shut, pitch)
    assert list(weights) == list(LID_ACTIONS)
    np.testing.assert_allclose(np.stack([weights[name] for name in BLINKS], axis=1), shut)
    down, up = (np.stack([weights[name] for name in names], axis=1) for names in (LOOKS_DOWN, LOOKS_UP))
    np.testing.assert_allclose(up, [[0.0, 0.0], [0.375, 0.0], [0.0, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(down, [[0.0, 0.0], [0.0, 0.0], [0.4, 0.2], [0.0, 1.0]])
    moved = lids.moved(np.zeros((4, 3)), shut[2], pitch[2])
    np.testing.assert_allclose(moved, 0.5 * moves[1] + 0.4 * moves[2] + 0.2 * moves[3], atol=1e-6)
    assert LidActions.of(shapes[:5]) is None
