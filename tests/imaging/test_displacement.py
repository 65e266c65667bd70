"""A wavy plate as few quads and their displacement, put together again as renderers do: P' = P + height N."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shapes import sphere

from shared.geometry.blend_shapes import BlendShape
from shared.geometry.mesh import Mesh, is_subdivision, subdivide, vertex_normals
from shared.geometry.quads import LimitSurface, triangulated
from shared.geometry.raycast import RayScene
from shared.imaging.displacement import HEIGHT_TEXELS, LEAST_MOVE_MM, STEP_MM, displaced_base, surface_points
from shared.imaging.texture import sample_bilinear

SIDE, CELLS = 60.0, 8
TOLERANCE_MM = 0.02


def plate() -> tuple[Mesh, np.ndarray]:
    """A bent plate of 8 x 8 quads, each two triangles, subdivided twice, with waves of 0.2 mm that the quads cannot
    follow; and its coarse faces."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, CELLS + 1), np.linspace(0.0, 1.0, CELLS + 1))
    uvs = np.stack([x.ravel(), y.ravel()], axis=1)
    first = (np.arange(CELLS)[:, None] * (CELLS + 1) + np.arange(CELLS)).ravel()
    faces = triangulated(np.stack([first, first + 1, first + CELLS + 2, first + CELLS + 1], axis=1)).astype(np.int32)
    flat = SIDE * np.column_stack([uvs, 0.3 * np.sin(3.0 * uvs[:, 0]) * uvs[:, 1]])
    mesh = subdivide(subdivide(Mesh(flat, faces, 0.02 + 0.96 * uvs, faces)))
    waves = 0.2 * np.sin(mesh.vertices[:, 0] * 1.3) * np.sin(mesh.vertices[:, 1] * 1.1)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    return mesh.replace(vertices=mesh.vertices + waves[:, None] * normals), faces


MESH, COARSE = plate()
BASE = displaced_base(MESH, COARSE, COARSE)


def apart(points, mesh):
    """[N] mm from points to the mesh, along z: both are plates over the same square."""
    down = np.tile([0.0, 0.0, -1.0], (len(points), 1))
    face, _, distance = RayScene(mesh.vertices, mesh.faces).intersect(points - 40.0 * down, down)
    inside = (points[:, :2] > 1.0).all(1) & (points[:, :2] < SIDE - 1.0).all(1)
    met = inside & (face >= 0)  # a ray through an edge may pass between its faces
    assert met.sum() > max(500, 0.99 * inside.sum())
    return np.abs(distance[met] - 40.0)


def limit_of(cage, splits=4):
    surface = LimitSurface.of(cage, splits)
    uvs = np.zeros((surface.matrix.shape[0], 2))
    uvs[surface.faces] = surface.uvs[surface.face_uvs]
    return Mesh(surface.matrix @ cage.vertices, surface.faces, uvs, surface.faces)


def test_base_and_displacement_are_the_mesh():
    base = limit_of(BASE.cage)
    normals = vertex_normals(base.vertices, base.faces)
    raised = base.vertices + sample_bilinear(BASE.heights, base.uvs)[:, None] * normals
    without, with_it = apart(base.vertices, MESH), apart(raised, MESH)
    assert np.percentile(without, 95) > 5.0 * TOLERANCE_MM
    assert np.percentile(with_it, 99) < TOLERANCE_MM
    assert np.percentile(apart(MESH.vertices, base.replace(vertices=raised)), 99) < TOLERANCE_MM


def test_the_map_and_the_quads():
    assert BASE.heights.shape == (HEIGHT_TEXELS, HEIGHT_TEXELS) and BASE.heights.dtype == np.float32
    np.testing.assert_array_equal(BASE.heights / STEP_MM, np.round(BASE.heights / STEP_MM))
    assert BASE.cage.quads.shape == (CELLS**2, 4) and BASE.splits == 2
    np.testing.assert_array_equal(BASE.cage.uvs, MESH.uvs[: (CELLS + 1) ** 2])


def test_textures_stay_on():
    """The base has at a texture coordinate about what the mesh has there."""
    base = limit_of(BASE.cage, 2)
    off = np.linalg.norm(base.vertices - MESH.vertices[cKDTree(MESH.uvs).query(base.uvs)[1]], axis=1)
    inside = (base.uvs > 0.1).all(1) & (base.uvs < 0.9).all(1)
    assert np.percentile(off[inside], 95) < 0.5 < SIDE / CELLS / 4


def test_the_cage_follows_what_moves_the_mesh():
    moved = BASE.fit.follow(MESH.vertices @ np.diag([1.0, 2.0, 1.0]) + [0.0, 0.0, 5.0])
    np.testing.assert_allclose(moved, BASE.cage.vertices @ np.diag([1.0, 2.0, 1.0]) + [0.0, 0.0, 5.0], atol=1e-6)
    lift = np.tile([0.0, 0.0, 3.0], (len(MESH.vertices), 1))
    shape = BASE.fit.shape(BlendShape.of("up", lift, 0.0, ((0.5, 0.7 * lift),)))
    np.testing.assert_allclose(shape.offsets, np.tile([0.0, 0.0, 3.0], ((CELLS + 1) ** 2, 1)), atol=1e-5)
    np.testing.assert_allclose(shape.between[0][1], 0.7 * shape.offsets, atol=1e-5)
    near = np.exp(-np.square(MESH.vertices[:, :2] - 15.0).sum(1) / 50.0)[:, None] * [0.0, 0.0, 3.0]
    few = BASE.fit.shape(BlendShape.of("bump", near, LEAST_MOVE_MM))
    assert 0 < len(few.vertices) < (CELLS + 1) ** 2 / 2


def test_quads_without_some_of_the_faces():
    kept = BASE.quads_beside(np.arange(2 * 16, 4 * 16))
    assert kept.tolist() == [True, False] + [True] * (CELLS**2 - 2)
    assert BASE.quads_beside(np.zeros(0, int)).all()


def test_points_on_a_sphere_lie_on_it():
    """Within a tenth of what flat triangles are off."""
    ball = sphere(50.0, 3)
    face, bary = np.arange(len(ball.faces)), np.full((len(ball.faces), 3), 1.0 / 3.0)
    flat = np.linalg.norm(ball.vertices[ball.faces].mean(1), axis=1)
    places, normals = surface_points(ball, face, bary)
    assert 0.0 < np.abs(np.linalg.norm(places, axis=1) - 50.0).max() < np.abs(flat - 50.0).max() / 10.0
    np.testing.assert_allclose(normals, places / 50.0, atol=2e-2)


def test_only_a_subdivision_of_the_coarse_faces_is_taken_for_one():
    assert is_subdivision(MESH, COARSE, COARSE) and is_subdivision(MESH, MESH.faces, MESH.face_uvs)
    assert not is_subdivision(MESH, COARSE[::-1], COARSE)
    assert not is_subdivision(MESH.replace(face_uvs=MESH.face_uvs[::-1]), COARSE, COARSE)
    assert not is_subdivision(MESH, np.concatenate([COARSE, COARSE]), COARSE)


def test_faces_that_are_no_pairs_are_refused():
    with pytest.raises(ValueError, match="edge"):
        displaced_base(MESH, COARSE[np.r_[1 : len(COARSE), 0]], COARSE)
