"""The grid of rays about a head along which hair stands off, on a ball whose numbers are known."""

import numpy as np
import pytest
from shapes import sphere

from shared.geometry.mesh import face_normals
from shared.geometry.raycast import RayScene
from shared.hair.shell_grid import COLUMNS, ShellGrid

RADIUS = 80.0
BALL = sphere(RADIUS, 5)
NO_EARS = np.zeros(len(BALL.faces), bool)


@pytest.fixture(scope="module")
def grid():
    return ShellGrid.about(RayScene(BALL.vertices, BALL.faces), NO_EARS, np.zeros(3), -150.0)


def test_its_base_is_the_head(grid):
    """About the centre a ball is as far everywhere; below, horizontal rays meet it at sqrt(r^2 - y^2)."""
    assert np.allclose(grid.base[: grid.domed - 3], RADIUS, rtol=5e-3)
    row = grid.domed + 6
    height = grid.centres[row, 0, 1]
    assert grid.base[row] == pytest.approx(np.sqrt(RADIUS**2 - height**2), rel=0.02)


def test_below_the_mesh_it_goes_on(grid):
    beyond = grid.centres[:, 0, 1] < -RADIUS
    assert beyond.sum() > 10 and np.ptp(grid.base[beyond][3:]) < 0.1 and grid.base[beyond].min() > 15.0


def test_an_ear_does_not_count():
    """A bump on one side, named as an ear: the base runs through below it."""
    bump = np.exp(-np.sum((BALL.vertices / RADIUS - [1.0, 0, 0]) ** 2, axis=1) / 0.02)
    vertices = BALL.vertices * (1.0 + 0.25 * bump[:, None])
    ears = (bump[BALL.faces] > 0.01).any(1)
    scene = RayScene(vertices, BALL.faces)
    with_ears = ShellGrid.about(scene, ears, np.zeros(3), -100.0)
    assert ShellGrid.about(scene, NO_EARS, np.zeros(3), -100.0).base.max() > RADIUS + 12.0
    assert with_ears.base[: with_ears.domed].max() < RADIUS + 2.0


def test_the_mesh_is_one_closed_outward_sheet(grid):
    mesh = grid.mesh(grid.base + 5.0)
    area = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    assert area.min() > 0.0, "the crown is one vertex"
    domed = mesh.faces[(mesh.vertices[mesh.faces, 1] > 0).all(1)]
    outwards = (face_normals(mesh.vertices, domed) * mesh.vertices[domed].mean(1)).sum(1)
    assert (outwards > 0).all()
    assert mesh.uvs.min() >= 0.0 and mesh.uvs.max() <= 1.0
    corners = mesh.uvs[mesh.face_uvs]
    assert np.ptp(corners[..., 0], axis=1).max() < 2.0 / COLUMNS, "no face crosses the seam of the atlas"


def test_values_go_to_vertices_and_back(grid):
    values = np.arange(grid.base.size, dtype=float).reshape(grid.base.shape)
    values[0] = 7.0
    assert np.array_equal(grid.of_grid(grid.of_vertices(values)), values)
    assert len(grid.of_vertices(values)) == len(grid.mesh(grid.base).vertices)


def test_a_place_is_found_on_the_grid(grid):
    """What locate says of the grid's own places is their row, column and radius."""
    radius = grid.base + 6.0
    some = np.s_[3::7, ::11]
    row, column = (index[some].ravel() for index in np.indices(radius.shape))
    found = grid.locate(grid.at(radius)[some].reshape(-1, 3))
    keep = np.abs(row - grid.domed) > 1
    assert np.allclose(found[0][keep], row[keep], atol=1e-6)
    off = np.abs(found[1] - column)
    assert np.minimum(off, COLUMNS - off)[keep].max() < 1e-6
    assert np.allclose(found[2][keep], radius[row, column][keep])
    assert np.allclose(grid.read(radius, found[0], found[1])[keep], radius[row, column][keep])


def test_the_smoothest_field_keeps_what_is_known(grid):
    truth = 10.0 + 3.0 * np.cos(2 * np.pi * np.arange(COLUMNS) / COLUMNS)[None] * np.ones((len(grid.base), 1))
    known = np.zeros_like(truth)
    known[:, ::12] = 100.0
    found = grid.smoothest(truth, known, 0.4)
    assert np.abs(found - truth)[grid.domed // 2:].max() < 0.15
