"""The change of head frame between a result and the truth."""

import numpy as np

from shared.geometry.transforms import rigid, rotation_from_vector
from tools.scoring.align import Similarity, result_poses


def test_poses_of_the_result_show_the_same_directions():
    """A point of the result, seen by its pose, lies on the truth's ray, nearer or farther by the scale."""
    turn = rotation_from_vector(np.array([0.2, -0.4, 0.1]))
    alignment = Similarity(1.7, turn, np.array([3.0, -8.0, 5.0]))
    truth = rigid(rotation_from_vector(np.array([[2.9, 0.1, 0.3]])), np.array([[10.0, 20.0, 800.0]]))
    points = np.random.default_rng(0).normal(scale=60.0, size=(20, 3))
    expected = alignment.points(points) @ truth[0, :3, :3].T + truth[0, :3, 3]
    found_pose = result_poses(truth, alignment)
    found = points @ found_pose[0, :3, :3].T + found_pose[0, :3, 3]
    assert np.allclose(found * 1.7, expected)
    assert np.allclose(alignment.pose(found_pose[0]), truth[0])
