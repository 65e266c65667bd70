"""How far out hair reaches by its outlines: a larger ball about the head's, seen as a disc."""

import numpy as np
import pytest
from shapes import nods, sphere

from shared.geometry.raycast import RayScene, camera_hits
from shared.hair.hull import hull_radius
from shared.hair.shell_grid import ShellGrid
from shared.imaging.views import Views

HEAD_MM, HAIR_MM = 80.0, 97.0
LENS = np.array([[400.0, 0, 60], [0, 400.0, 60], [0, 0, 1]])
SIZE = (120, 120)


@pytest.fixture(scope="module")
def seen():
    head, hair = sphere(HEAD_MM, 4), sphere(HAIR_MM, 5)
    scene = RayScene(hair.vertices, hair.faces)
    views = Views.in_one_light(nods(np.linspace(-60.0, 60.0, 13)), LENS, SIZE, "head", None, None)
    solids = {f: (camera_hits(scene, pose, LENS, *SIZE)[0] >= 0).astype(np.float32)
              for f, pose in enumerate(views.camera_from_head)}
    grid = ShellGrid.about(RayScene(head.vertices, head.faces), np.zeros(len(head.faces), bool), np.zeros(3), -60.0)
    return grid, solids, views


def test_outlines_are_met(seen):
    """Where frames see the ball edge-on its radius is right to a third of a pixel (2.3 mm), and smooth between."""
    grid, solids, views = seen
    radius, said = hull_radius(grid, solids, views)
    domed = np.s_[4: grid.domed - 2]
    told = said[domed] > 0.02
    assert told.mean() > 0.5
    assert np.median(np.abs(radius[domed][told] - HAIR_MM)) < 0.8
    assert np.abs(radius[domed][told] - HAIR_MM).max() < 4.0


def test_where_no_outline_tells_hair_is_as_thick_as_elsewhere(seen):
    grid, solids, views = seen
    some = {f: solids[f] for f in (5, 6, 7)}
    radius, said = hull_radius(grid, some, views)
    row = grid.domed - 4
    untold = said[row] == 0.0
    assert untold.any()
    assert np.abs(radius[row][untold] - HAIR_MM).max() < 6.0


def test_held_places_lie_on_the_head(seen):
    grid, solids, views = seen
    held = np.zeros(grid.base.shape, bool)
    held[10:25, :10] = True
    radius, _ = hull_radius(grid, solids, views, held)
    free, _ = hull_radius(grid, solids, views)
    assert (radius - grid.base)[14:20, 3:6].max() < 3.0
    assert (free - grid.base)[14:20, 3:6].min() > 10.0
