"""Displacements carried from one surface to another."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapes import sphere

from shared.actions.transfer import carried, local_similarities

BALL = sphere(60.0, 4)
MOVES = np.random.default_rng(1).normal(0.0, 5.0, BALL.vertices.shape)
ALL = np.ones(len(BALL.vertices), bool)


def test_onto_itself_nothing_changes():
    maps = local_similarities(BALL.vertices, BALL.vertices, ALL)
    np.testing.assert_allclose(carried(MOVES, maps), MOVES, atol=1e-9)


@pytest.mark.parametrize("scale", [0.8, 1.3])
def test_a_turned_and_scaled_head_moves_turned_and_scaled(scale):
    turn = scale * Rotation.from_rotvec([0.4, -0.9, 0.2]).as_matrix()
    maps = local_similarities(BALL.vertices, BALL.vertices @ turn.T + [4.0, 5.0, -6.0], ALL)
    np.testing.assert_allclose(carried(MOVES, maps), MOVES @ turn.T, atol=1e-8)


def test_a_head_that_bends_turns_the_motion_where_it_bends():
    """Turned about y by an angle that grows with height: each place by its own."""
    angle = 0.004 * BALL.vertices[:, 1]
    turns = Rotation.from_rotvec(np.stack([0 * angle, angle, 0 * angle], axis=1))
    maps = local_similarities(BALL.vertices, turns.apply(BALL.vertices), ALL)
    turned = np.abs(angle) > 0.1
    off, without = (np.linalg.norm(moves - turns.apply(MOVES), axis=1)[turned]
                    for moves in (carried(MOVES, maps), MOVES))
    assert np.median(off) < 0.5 * np.median(without)


def test_what_does_not_count_follows_what_does():
    """Half of the target is noise that is said not to count."""
    target, counted = 1.2 * BALL.vertices, BALL.vertices[:, 1] > -10.0
    target[~counted] = np.random.default_rng(2).normal(0.0, 50.0, target[~counted].shape)
    maps = local_similarities(BALL.vertices, target, counted)
    np.testing.assert_allclose(maps, np.broadcast_to(1.2 * np.eye(3), maps.shape), atol=1e-9)


def test_refinement_by_tenths_of_a_millimetre_turns_nothing():
    rough = BALL.vertices + np.random.default_rng(3).normal(0.0, 0.2, BALL.vertices.shape)
    maps = local_similarities(BALL.vertices, rough, ALL)
    assert np.abs(maps - np.eye(3)).max() < 0.03
