"""Irradiance near a wall's shadow: where the border lies elsewhere it changes by about as much as is expected."""

import numpy as np
import pytest
from shapes import grid_plane

from shared.geometry.mesh import Mesh, normalised
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import fibonacci_sphere
from shared.rendering.irradiance_errors import irradiance_slope, irradiance_vectors, places_around, shadow_uncertainty
from shared.rendering.transfer import Points, bounce_nodes, irradiance, mesh_points, trace_transfer

DIRECTIONS = fibonacci_sphere(3000)
FLOOR, REACH = grid_plane(41, 80.0), 3.0
POINTS = mesh_points(FLOOR)
LAMP = normalised(np.array([1.0, 0.0, 1.0]))
WALL_X, WALL_HEIGHT = 15.0, 20.0
"""The lamp shines at 45 degrees from +x: the wall's shadow ends at x = WALL_X - WALL_HEIGHT."""


def lamp_light():
    """[J, 1]: a lamp of some 5 degrees; [J, 1]: the same from all sides."""
    return np.exp(200.0 * (DIRECTIONS @ LAMP - 1.0))[:, None] * 100.0, np.ones((len(DIRECTIONS), 1))


def floor_transfer(wall_x):
    """The floor's transfer with a wall of no thickness across it at x = wall_x."""
    side = np.array([[wall_x, y, z] for y in (-200.0, 200.0) for z in (0.2, WALL_HEIGHT)])
    count = len(FLOOR.vertices)
    vertices = np.concatenate([FLOOR.vertices, side])
    faces = np.concatenate([FLOOR.faces, count + np.array([[0, 1, 2], [2, 1, 3]])])
    mesh = Mesh(vertices, faces, vertices[:, :2], faces)
    return trace_transfer(RayScene(vertices, faces), POINTS, bounce_nodes(mesh, 20), DIRECTIONS)


@pytest.fixture(scope="module")
def wall():
    return floor_transfer(WALL_X)


def inner():
    """[P]: away from the floor's edges, beyond which nothing lies beside a point; and on the shadow's side."""
    return (np.abs(POINTS.positions[:, :2]) < 35.0).all(1) & (POINTS.positions[:, 0] < WALL_X - 3.0)


def test_a_shadow_may_end_a_little_elsewhere(wall):
    """Over walls moved to both sides the irradiance changes as the uncertainty says, and nowhere else."""
    light, _ = lamp_light()
    uncertainty = shadow_uncertainty(POINTS, wall, light, DIRECTIONS, REACH)[:, 0]
    here = irradiance(wall, light)[:, 0]
    steps = REACH * np.array([-1.0, -0.5, 0.5, 1.0])
    moved = [irradiance(floor_transfer(WALL_X + step), light)[:, 0] for step in steps]
    change = np.sqrt(np.mean(np.square(np.array(moved) - here), axis=0))
    border = np.abs(POINTS.positions[:, 0] - (WALL_X - WALL_HEIGHT))
    lit = np.median(here[inner() & (border > 15.0) & (POINTS.positions[:, 0] < 0.0)])
    near, far = inner() & (border < 2.0), inner() & (border > 12.0)
    assert uncertainty[near].mean() > 0.1 * lit and uncertainty[far].max() < 0.02 * lit
    assert 0.5 < uncertainty[near].mean() / change[near].mean() < 1.5
    along = np.corrcoef(uncertainty[inner()], change[inner()])[0, 1]
    assert along > 0.8


def test_light_from_all_sides_casts_no_borders(wall):
    _, even = lamp_light()
    uncertainty = shadow_uncertainty(POINTS, wall, even, DIRECTIONS, REACH)[:, 0]
    far = inner() & (POINTS.positions[:, 0] < WALL_X - 12.0)
    assert uncertainty[far].max() < 0.04 * irradiance(wall, even)[far].min()


def test_places_lie_around_on_the_same_side():
    """Up to the reach away in all directions; a sheet just below, facing the other way, is none."""
    below = Points(POINTS.positions - [0.0, 0.0, 0.5], -POINTS.normals)
    both = Points(*(np.concatenate(pair) for pair in zip(
        (POINTS.positions, POINTS.normals), (below.positions, below.normals), strict=True)))
    middle = np.abs(both.positions[:, :2]).max(1) < 30.0
    near = places_around(both, REACH)[middle]
    own = np.nonzero(middle)[0]
    assert ((near < len(POINTS)) == (own < len(POINTS))[:, None]).all()
    away = both.positions[near] - both.positions[own][:, None]
    distance = np.linalg.norm(away, axis=2)
    assert 0.3 * REACH < distance.min() and distance.max() < 1.5 * REACH
    assert np.linalg.norm(away.mean(1), axis=1).max() < 0.5 * REACH


def test_vectors_and_their_slope(wall):
    """n . W is the irradiance, and what a small turn of the normal changes is at most the slope."""
    light = np.concatenate(lamp_light(), axis=1)
    vectors = irradiance_vectors(wall, light, DIRECTIONS)
    assert np.allclose(np.einsum("pxn,px->pn", vectors, POINTS.normals), irradiance(wall, light), rtol=0.01, atol=0.01)
    slope = irradiance_slope(wall, POINTS.normals, light, DIRECTIONS)
    step = 1e-3 * np.array([1.0, 0.0, 0.0])
    change = np.einsum("pxn,x->pn", vectors, step) / 1e-3
    assert (np.abs(change) <= slope * 1.0001).all()
    lit = inner() & (POINTS.positions[:, 0] < -25.0)
    assert np.allclose(np.abs(change[lit, 0]), slope[lit, 0], rtol=0.05), "the lamp lies along x"
