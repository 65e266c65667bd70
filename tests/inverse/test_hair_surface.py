"""Hair that stands off a ball of a head, in drawn pictures: found, measured, and lit with the head."""

from types import SimpleNamespace

import numpy as np
import pytest
from field_check import below, field_faults
from toy_hair import HAIR_MM, HAIRLINE_MM, HEAD_MM, hairy_ball, toy_surface

from shared.compute.run_context import RunContext
from shared.contract.records import RUN, SOLVE
from shared.geometry.mesh import face_normals, vertex_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import fibonacci_sphere
from shared.imaging.image_sampling import SurfaceViewer
from shared.inverse.hair_surface import SHADOW_SPREAD, find_hair, light_kept_off
from shared.inverse.problem import FACE_SKIN
from shared.rendering.transfer import mesh_points


@pytest.fixture(scope="module")
def found():
    surface, views, materials, _ = hairy_ball(haired=True)
    return surface, find_hair(SurfaceViewer.of(surface.mesh), surface, materials, views, 128)


def test_hair_lies_where_its_outline_is(found):
    """16 mm of hair to a pixel (1.5 mm) and a little, its own share all over the crown."""
    _, hair = found
    assert hair.record["thickness_mm"] == pytest.approx(HAIR_MM - HEAD_MM, abs=2.0)
    crown = hair.mesh.vertices[:, 1] > 50.0
    radius = np.linalg.norm(hair.mesh.vertices, axis=1)
    assert np.median(np.abs(radius[crown] - HAIR_MM)) < 2.0
    assert hair.share[hair.mesh.vertices[:, 1] > 60.0].min() > 0.9


def test_the_record_is_as_declared(found):
    assert field_faults(found[1].record, below(SOLVE, "hair")) == []
    assert below(SOLVE, "hair") == below(RUN, "hair")


def test_the_face_is_left_free(found):
    _, hair = found
    _, y, z = hair.mesh.vertices.T
    front = (z > 60.0) & (y < HAIRLINE_MM - 12.0) & (y > -50.0)
    assert hair.share[front].max(initial=0.0) < 0.5


def test_faces_are_outward_and_use_all_vertices(found):
    _, hair = found
    mesh = hair.mesh
    outwards = (face_normals(mesh.vertices, mesh.faces) * mesh.vertices[mesh.faces].mean(1)).sum(1)
    assert (outwards[(mesh.vertices[mesh.faces, 1] > 0.0).all(1)] > 0.0).mean() > 0.99
    assert set(mesh.faces.ravel()) == set(range(len(mesh.vertices))) and len(hair.share) == len(mesh.vertices)


def test_what_hair_covers_lies_beneath(found):
    """No ear of the head comes out of hair; the face stays where it was."""
    surface, hair = found
    places, before = hair.head.vertices, surface.mesh.vertices
    ears = surface.vertices_of(("ears",)) & (before[:, 2] < 10.0) & (before[:, 1] > -30.0)
    scene = RayScene(hair.mesh.vertices, hair.mesh.faces)
    outwards = places[ears] / np.linalg.norm(places[ears], axis=1, keepdims=True)
    covered = scene.occluded(places[ears], outwards)
    assert covered.mean() > 0.95
    face = surface.vertices_of(("nose", "chin", "neck")) & ~surface.vertices_of(("scalp", "ears", "forehead"))
    assert np.array_equal(places[face], before[face])


def test_a_bare_head_has_no_hair():
    surface, views, materials, _ = hairy_ball(haired=False)
    assert find_hair(SurfaceViewer.of(surface.mesh), surface, materials, views, 64) is None


def test_hair_whose_end_no_frame_shows_has_no_surface(monkeypatch):
    """Outlines that say nothing, as where the head fills the picture."""
    def silent(grid, *_):
        return grid.base + 8.0, np.zeros(grid.base.shape)

    monkeypatch.setattr("shared.inverse.hair_surface.hull_radius", silent)
    surface, views, materials, _ = hairy_ball(haired=True)
    notes = []
    context = RunContext(lambda items, label: items, notes.append)
    assert find_hair(SurfaceViewer.of(surface.mesh), surface, materials, views, 64, context) is None
    assert len(notes) == 1 and "no outline tells" in notes[0]


def test_what_light_a_wall_of_hair_keeps_off_is_known():
    """Hair that stands beside the head as one great plane x = 100 mm covers (1 + n_x) / 2 of a place of normal n under
    an even light. What it takes from the face is in the light that was solved there."""
    surface = toy_surface()
    mesh, directions = surface.mesh, fibonacci_sphere(1500)
    index = np.nonzero(mesh.vertices[:, 1] > -70.0)[0]
    points = mesh_points(mesh, index)
    direct = np.maximum(points.normals @ directions.T, 0.0) * 4.0 / len(directions)
    shading = SimpleNamespace(index=index, points=points, directions=directions,
                              transfer=SimpleNamespace(direct=direct), light_along=np.ones((len(directions), 3, 3)))
    wall = 100.0 * np.array([[1, -500, -500], [1, 500, -500], [1, 500, 500], [1, -500, 500]])
    scene = RayScene(np.concatenate([mesh.vertices, wall]),
                     np.concatenate([mesh.faces, len(mesh.vertices) + np.array([[0, 1, 2], [0, 2, 3]])]))
    found = light_kept_off(SimpleNamespace(viewer=SimpleNamespace(scene=scene)), surface, shading)
    covered = (1.0 + vertex_normals(mesh.vertices, mesh.faces)[:, 0]) / 2.0
    face = surface.vertices_of(FACE_SKIN)
    expected = SHADOW_SPREAD * np.abs(covered - np.median(covered[index][face[index]]))
    ears = surface.vertices_of(("ears",))  # not convex
    at = index[~ears[index]]
    assert np.abs(found[at] - expected[at]).mean() < 0.03
    assert np.corrcoef(found[at], expected[at])[0, 1] > 0.97
    assert (found[np.setdiff1d(np.arange(len(found)), index)] == 0.0).all()
