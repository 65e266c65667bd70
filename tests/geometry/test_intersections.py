"""Surfaces that cut themselves are found, and moves that would make them do so are held back."""

import numpy as np
import pytest
from shapes import grid_plane, sphere

from shared.geometry.intersections import crossing_edges, move_without_crossing, turned_faces
from shared.geometry.mesh import mesh_edges


@pytest.fixture(scope="module")
def ball():
    return sphere(50.0, 3)


def test_a_ball_does_not_cut_itself(ball):
    assert len(crossing_edges(ball.vertices, ball.faces)) == 0


def test_a_vertex_pushed_through_the_far_side_is_found(ball):
    pushed = ball.vertices.copy()
    pushed[0] *= -1.2
    around = ball.faces[(ball.faces == 0).any(1)]
    found = crossing_edges(pushed, ball.faces)
    assert len(found) > 0
    assert (np.isin(found, around).all(1) | (found == 0).any(1)).any()


def test_two_sheets_that_pass_through_each_other_are_found():
    low, high = grid_plane(5, 10.0), grid_plane(5, 10.0)
    turned = high.vertices[:, [0, 2, 1]] + [0.3, 0.2, 0.1]
    vertices = np.concatenate([low.vertices, turned])
    faces = np.concatenate([low.faces, high.faces + len(low.vertices)])
    assert len(crossing_edges(vertices, faces)) > 0
    apart = np.concatenate([low.vertices, turned + [0.0, 0.0, 20.0]])
    assert len(crossing_edges(apart, faces)) == 0


def test_folded_faces_are_unfolded():
    plane = grid_plane(9, 8.0)
    wanted = plane.vertices.copy()
    wanted[40, 0] += 1.6
    assert turned_faces(plane.vertices, wanted, plane.faces).any()
    placed = move_without_crossing(plane.vertices, wanted, plane.faces)
    assert not turned_faces(plane.vertices, placed, plane.faces).any()


def test_a_move_stops_before_it_cuts_and_goes_on_elsewhere(ball):
    wanted = 1.02 * ball.vertices
    aside = int(np.argmin(np.abs(ball.vertices @ ball.vertices[0])))
    wanted[0] = -1.2 * ball.vertices[0]
    placed = move_without_crossing(ball.vertices, wanted, ball.faces)
    assert len(crossing_edges(placed, ball.faces)) == 0
    assert not turned_faces(ball.vertices, placed, ball.faces).any()
    np.testing.assert_allclose(placed[aside], wanted[aside])


def test_a_move_that_is_held_back_somewhere_leaves_no_step():
    """A sheet that rises by 3 mm, but for a fold: from there it rises slowly, and farther off as it is wanted."""
    plane = grid_plane(41, 40.0)
    wanted = plane.vertices + [0.0, 0.0, 3.0]
    middle = int(np.argmin(np.abs(plane.vertices[:, :2] - plane.vertices[:, :2].mean(0)).sum(1)))
    wanted[middle, 0] += 1.6
    placed = move_without_crossing(plane.vertices, wanted, plane.faces)
    assert not turned_faces(plane.vertices, placed, plane.faces).any()
    rise, edges = placed[:, 2], mesh_edges(plane.faces)[0]
    assert rise[middle] < 2.0
    length = np.linalg.norm(plane.vertices[edges[:, 0]] - plane.vertices[edges[:, 1]], axis=1)
    assert (np.abs(rise[edges[:, 0]] - rise[edges[:, 1]]) < 0.31 * length).all()
    far = np.linalg.norm(plane.vertices - plane.vertices[middle], axis=1) > 15.0
    np.testing.assert_array_equal(placed[far], wanted[far])


def test_faces_that_rest_on_others_may_cross_them_but_not_turn(ball):
    """Two balls, one pushed into the other: it goes where it is wanted, and a face of it that would fold does not."""
    count = len(ball.vertices)
    start = np.concatenate([ball.vertices, ball.vertices + [60.0 * ball.vertices[:, 0].max() / 20.0, 0.0, 0.0]])
    faces = np.concatenate([ball.faces, ball.faces + count])
    wanted = start.copy()
    wanted[count:, 0] -= start[count:, 0].min() - 0.5 * ball.vertices[:, 0].max()
    resting = np.arange(len(faces)) >= len(ball.faces)
    assert len(crossing_edges(wanted, faces)) > 0
    assert len(crossing_edges(move_without_crossing(start, wanted, faces), faces)) == 0
    np.testing.assert_array_equal(move_without_crossing(start, wanted, faces, resting), wanted)
    folded = wanted.copy()
    folded[count] = wanted[count] - 2.4 * ball.vertices[0]
    placed = move_without_crossing(start, folded, faces, resting)
    assert turned_faces(start, folded, faces).any() and not turned_faces(start, placed, faces).any()
