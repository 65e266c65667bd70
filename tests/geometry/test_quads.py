"""Catmull-Clark subdivision against closed forms."""

import numpy as np
import pytest

from shared.geometry.quads import (
    LimitSurface,
    QuadMesh,
    bilinear_subdivision,
    catmull_clark,
    limit_matrix,
    paired_quads,
    triangulated,
)

CUBE = np.array([[x, y, z] for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
CUBE_QUADS = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])


def grid(count: int) -> QuadMesh:
    """count x count quads of size 1 in the plane z = 0, UVs over the unit square."""
    x, y = np.meshgrid(np.arange(count + 1.0), np.arange(count + 1.0))
    places = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    first = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    quads = np.stack([first, first + 1, first + count + 2, first + count + 1], axis=1)
    return QuadMesh(places, quads, places[:, :2] / count, quads)


def test_pairs_of_triangles_are_the_quads_they_were_made_of():
    quads = grid(3).quads
    found = paired_quads(triangulated(quads))
    shift = np.argmax(found == quads[:, :1], axis=1)
    np.testing.assert_array_equal([np.roll(row, -k) for row, k in zip(found, shift, strict=True)], quads)


@pytest.mark.parametrize("faces", [[[0, 1, 2]], [[0, 1, 2], [3, 4, 5]], [[0, 1, 2], [2, 1, 0]]])
def test_what_is_no_pair_is_refused(faces):
    with pytest.raises(ValueError, match="pair|edge"):
        paired_quads(np.array(faces))


def test_one_step_on_a_cube():
    """Faces' middles at 1, edges' at 3/4 twice, corners at 5/9: (F + 2 R) / 3 with F = 1/3 and R = 2/3 in each axis."""
    matrix, quads = catmull_clark(CUBE_QUADS, 8)
    moved = matrix @ CUBE
    np.testing.assert_allclose(moved[:8], CUBE * 5.0 / 9.0)
    np.testing.assert_allclose(np.sort(np.abs(moved[8:20]), axis=1), np.tile([0.0, 0.75, 0.75], (12, 1)))
    np.testing.assert_allclose(np.sort(np.abs(moved[20:]), axis=1), np.tile([0.0, 0.0, 1.0], (6, 1)))
    assert quads.shape == (24, 4)
    corners = moved[quads]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    assert ((outward * corners.mean(1)).sum(1) > 0.0).all()


@pytest.mark.parametrize("mesh", [QuadMesh(CUBE, CUBE_QUADS, CUBE[:, :2], CUBE_QUADS), grid(4)], ids=["cube", "grid"])
def test_the_limit_is_where_further_steps_lead(mesh):
    """Old vertices have the same limit after a step, and ten steps come near it."""
    count = len(mesh.vertices)
    limit = limit_matrix(mesh.quads, count) @ mesh.vertices
    step, quads = catmull_clark(mesh.quads, count)
    np.testing.assert_allclose((limit_matrix(quads, step.shape[0]) @ step @ mesh.vertices)[:count], limit, atol=1e-12)
    moved = mesh.vertices
    quads = mesh.quads
    for _ in range(5):
        step, quads = catmull_clark(quads, len(moved))
        moved = step @ moved
    np.testing.assert_allclose(moved[:count], limit, atol=2e-3)


def test_inside_a_regular_grid_it_is_the_cubic_spline():
    """Control heights x^2 give the limit x^2 + 1/3, and a linear function itself; on the rim likewise along it."""
    flat = grid(8)
    raised = flat.vertices + np.outer(flat.vertices[:, 0] ** 2, [0.0, 0.0, 1.0])
    limit = limit_matrix(flat.quads, len(raised)) @ raised
    x, y = flat.vertices[:, 0], flat.vertices[:, 1]
    inner = (x > 0) & (x < 8)
    np.testing.assert_allclose(limit[inner, 0], x[inner])
    np.testing.assert_allclose(limit[inner, 2], x[inner] ** 2 + 1.0 / 3.0)
    assert (inner & ((y == 0) | (y == 8))).any()


def test_texture_coordinates_stay_where_they_are():
    mesh = grid(3)
    matrix, quads = bilinear_subdivision(mesh.quad_uvs, len(mesh.uvs))
    middles = (matrix @ mesh.uvs)[quads].mean(1)
    own = mesh.uvs[mesh.quad_uvs]
    expected = [[0.5625 * own[q, k] + 0.1875 * (own[q, k - 1] + own[q, (k + 1) % 4]) + 0.0625 * own[q, (k + 2) % 4]
                 for k in range(4)] for q in range(len(own))]
    np.testing.assert_allclose(middles, np.reshape(expected, (-1, 2)))


def test_the_surface_of_a_cube_follows_its_cage():
    cage = QuadMesh(CUBE, CUBE_QUADS, CUBE[:, :2], CUBE_QUADS)
    surface = LimitSurface.of(cage, 3)
    assert surface.faces.shape == surface.face_uvs.shape == (6 * 64 * 2, 3)
    np.testing.assert_allclose(surface.matrix @ (2.0 * CUBE + 1.0), 2.0 * (surface.matrix @ CUBE) + 1.0, atol=1e-12)
    assert (surface.matrix.data >= 0.0).all()
