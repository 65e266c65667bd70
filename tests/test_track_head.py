"""Poses of another tracker taken over into the space of the fitted head."""

import numpy as np

from shared.geometry import rigid, rotation_from_vector
from shared.solve.first_poses import interpolate_poses
from shared.solve.track_head import carried_poses


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
