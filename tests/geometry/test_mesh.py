"""Normals, Laplacian, subdivision, texels."""

import numpy as np
import pytest
from shapes import grid_plane, sphere

from shared.geometry import mesh as m


def test_vertex_normals_of_a_sphere_point_outwards():
    ball = sphere(2.0, levels=4)
    assert ((m.vertex_normals(ball.vertices, ball.faces) * m.normalised(ball.vertices)).sum(1) > 0.999).all()


def test_angle_weights_make_a_cubes_corner_symmetric():
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0.0]])
    faces = np.array([[0, 4, 1], [0, 2, 4], [0, 1, 3], [0, 3, 2]])  # the z = 0 square is split, the others are not
    assert np.allclose(m.vertex_normals(corner, faces)[0], -np.ones(3) / np.sqrt(3))


def test_laplacian_of_a_linear_function_vanishes_inside():
    plane = grid_plane(7)
    inside = (np.abs(plane.vertices[:, :2]) < 0.49).all(1)
    assert np.abs((m.uniform_laplacian(plane.faces, len(plane.vertices)) @ plane.vertices)[inside]).max() < 1e-12


def test_both_laplacians_know_the_number_of_neighbours():
    """Of a fan of three triangles about vertex 0, whose neighbours are all others."""
    faces, values = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]]), np.array([10.0, 1.0, 2.0, 3.0, 4.0])
    whole, mean = (f(faces, 5) for f in (m.graph_laplacian, m.uniform_laplacian))
    assert (whole != whole.T).nnz == 0 and not (whole @ np.ones(5)).any()
    assert (whole @ values)[0] == 4 * 10.0 - (1.0 + 2.0 + 3.0 + 4.0)
    assert np.allclose(mean @ values, (whole @ values) / whole.diagonal())


def test_the_rim_of_a_surface_in_its_faces_orientation():
    plane = grid_plane(4)
    rim = m.boundary_loop(plane.faces)
    steps = set(zip(rim.tolist(), np.roll(rim, -1).tolist(), strict=True))
    assert len(rim) == len(steps) == 4 * 3 and rim[0] == rim.min()
    assert steps <= set(map(tuple, m.half_edges(plane.faces).tolist()))
    two = np.concatenate([plane.faces, plane.faces + len(plane.vertices)])
    with pytest.raises(ValueError, match="more than one boundary"):
        m.boundary_loop(two)


def test_midpoints_lie_in_the_middle_and_keep_the_area():
    plane = grid_plane(4)
    matrix, faces = m.midpoint_subdivision(plane.faces, len(plane.vertices))
    area = np.linalg.norm(m.face_normals(matrix @ plane.vertices, faces), axis=1).sum() / 2
    assert len(faces) == 4 * len(plane.faces)
    assert area == pytest.approx(1.0)


def test_loop_reproduces_planes_and_keeps_orientation():
    plane = grid_plane(6)
    matrix, faces = m.loop_subdivision(plane.faces, len(plane.vertices))
    assert np.allclose(np.asarray(matrix.sum(1)).ravel(), 1)
    assert np.abs((matrix @ plane.vertices)[:, 2]).max() < 1e-12
    assert (m.face_normals(matrix @ plane.vertices, faces)[:, 2] > 0).all()


def test_loop_agrees_with_pymeshlab():
    pymeshlab = pytest.importorskip("pymeshlab", reason="pymeshlab is not installed")
    ball = sphere(10.0, levels=2)
    bumpy = ball.vertices * (1 + 0.1 * np.sin(ball.vertices.sum(1)))[:, None]
    reference = pymeshlab.MeshSet()
    reference.add_mesh(pymeshlab.Mesh(vertex_matrix=bumpy, face_matrix=ball.faces))
    reference.meshing_surface_subdivision_loop(
        iterations=1, threshold=pymeshlab.PercentageValue(0), loopweight="Loop"
    )
    matrix, _ = m.loop_subdivision(ball.faces, len(bumpy))
    ours, theirs = matrix @ bumpy, reference.current_mesh().vertex_matrix()
    assert len(ours) == len(theirs)
    distance = np.linalg.norm(ours[:, None] - theirs[None], axis=-1).min(1)
    assert distance[len(bumpy) :].max() < 1e-4  # edge points share one rule; vertex weights differ between variants


def test_subdivide_keeps_uvs_on_the_same_surface():
    finer = m.subdivide(grid_plane(5))
    assert np.allclose(finer.uvs[finer.face_uvs].mean((0, 1)), 0.5)
    assert finer.face_uvs.shape == finer.faces.shape


def test_rasterized_texels_lie_where_their_barycentrics_say():
    plane = grid_plane(5)
    size = 32
    face, bary = m.rasterize_uv(plane, size)
    assert (face >= 0).all()
    uv = m.interpolate(plane.uvs, plane.face_uvs, face.ravel(), bary.reshape(-1, 3)).reshape(size, size, 2)
    centres = (np.arange(size) + 0.5) / size
    assert np.allclose(uv[..., 0], centres[None, :], atol=1e-5)
    assert np.allclose(uv[..., 1], 1 - centres[:, None], atol=1e-5)


def test_rasterize_leaves_uncovered_texels_empty():
    plane = grid_plane(3)
    half = plane.replace(uvs=plane.uvs * 0.5)
    face, bary = m.rasterize_uv(half, 16)
    assert (face[8:, :8] >= 0).all()
    assert (face[:8] < 0).all() and (face[:, 8:] < 0).all()
    assert (bary[face < 0] == 0).all()


@pytest.mark.parametrize("width", [2, 3, 4])
def test_vectors_of_any_length_are_normalised(width):
    vectors = np.random.default_rng(1).normal(size=(5, 7, width))
    vectors[0, 0] = 0.0
    unit = m.normalised(vectors)
    assert np.linalg.norm(unit.reshape(-1, width)[1:], axis=1) == pytest.approx(1.0)
    assert (unit[0, 0] == 0.0).all()
