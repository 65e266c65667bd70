"""A neck's rim on one smooth curve: the head model's own, as tracking leaves it, and curves that are known."""

import numpy as np
import pytest

from shared.geometry.intersections import crossing_edges, turned_faces
from shared.geometry.mesh import Mesh, boundary_loop, mesh_edges, normalised
from shared.geometry.rim import HARMONICS, REACH_MM, smooth_curve, smooth_rim
from shared.geometry.transforms import rotation_from_vector
from shared.tracking.models import load_head_model


@pytest.fixture(scope="module", params=["mean", "another"])
def surface(request):
    """A head with the faces that tracking fits."""
    model = load_head_model().subdivided()
    codes = np.zeros(len(model.identity_basis))
    codes[:10] = 0.0 if request.param == "mean" else np.random.default_rng(0).normal(size=10)
    return model.surface(model.shape(codes))


def rim_of(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[boundary_loop(mesh.faces)]


def turns_deg(polygon: np.ndarray) -> np.ndarray:
    """[N] by how much a closed polygon [N, 3] turns at each corner: 360 together where it is flat and convex."""
    along = normalised(np.roll(polygon, -1, axis=0) - polygon)
    return np.degrees(np.arccos(np.clip((along * np.roll(along, 1, axis=0)).sum(1), -1.0, 1.0)))


def turning_points(heights: np.ndarray) -> int:
    """How often heights [N] along a closed curve begin to rise or to fall."""
    rising = np.roll(heights, -1) > heights
    return int((rising != np.roll(rising, 1)).sum())


def circle(angles: np.ndarray) -> np.ndarray:
    return np.stack([60.0 * np.cos(angles), 60.0 * np.sin(angles), 0.0 * angles], axis=1)


def test_the_rim_bends_gently_and_to_one_side(surface):
    """The model's own goes down and up twice more and turns by nearly two whole turns."""
    before, after = rim_of(surface.mesh), rim_of(smooth_rim(surface.mesh))
    assert turns_deg(before).sum() > 600.0 and turning_points(before[:, 1]) == 8
    assert turns_deg(after).sum() < 390.0 and turns_deg(after).max() < 10.0
    assert turning_points(after[:, 1]) <= 4
    assert np.linalg.norm(after - before, axis=1).max() < 10.0


def test_only_the_neck_near_the_rim_moves(surface):
    moved = np.linalg.norm(smooth_rim(surface.mesh).vertices - surface.mesh.vertices, axis=1)
    rim = rim_of(surface.mesh)
    near = np.linalg.norm(surface.mesh.vertices[:, None] - rim, axis=2).min(1) < REACH_MM
    others = [name for name in surface.segment_names if name != "neck"]
    assert moved[near].min() > 0.0 and moved[~near].max() == 0.0
    assert not (near & surface.vertices_of(others)).any()


def test_faces_stay_as_they_are_joined_and_none_turns_over(surface):
    mesh, smooth = surface.mesh, smooth_rim(surface.mesh)
    for kept in ("faces", "uvs", "face_uvs"):
        assert getattr(smooth, kept) is getattr(mesh, kept)
    assert not turned_faces(mesh.vertices, smooth.vertices, mesh.faces).any()
    neck = surface.faces_of(("neck",))
    assert len(crossing_edges(smooth.vertices, mesh.faces[neck])) == 0


def test_the_rim_takes_the_skin_above_it_along(surface):
    """Neighbours of which one is above the rim are moved less apart than some along the rim are."""
    mesh = surface.mesh
    edges = mesh_edges(mesh.faces)[0]
    moves = smooth_rim(mesh).vertices - mesh.vertices
    apart = np.linalg.norm(moves[edges[:, 0]] - moves[edges[:, 1]], axis=1)
    along = np.isin(edges, boundary_loop(mesh.faces)).all(1)
    assert 0.0 < apart[~along].max() < apart[along].max() < np.linalg.norm(moves, axis=1).max()


def test_a_turned_and_larger_head_has_the_same_rim():
    model = load_head_model().subdivided()
    turn, mesh = rotation_from_vector(np.array([0.3, -1.1, 0.4])), model.mesh()
    placed = mesh.replace(vertices=mesh.vertices @ turn.T + (5.0, -80.0, 700.0))
    expected = smooth_rim(mesh).vertices @ turn.T + (5.0, -80.0, 700.0)
    assert smooth_rim(placed).vertices == pytest.approx(expected, abs=1e-8)


def test_a_circle_is_its_own_curve_and_a_ripple_on_it_goes():
    angles = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)
    ring = circle(angles)
    assert smooth_curve(ring, HARMONICS) == pytest.approx(ring, abs=1e-9)
    rippled = ring + np.stack([0.0 * angles, 0.0 * angles, 0.5 * np.sin(9.0 * angles)], axis=1)
    assert smooth_curve(rippled, HARMONICS) == pytest.approx(ring, abs=0.05)


def test_crowded_points_do_not_draw_the_curve_to_them():
    angles = 2.0 * np.pi * np.concatenate([np.arange(60) / 60.0, (np.arange(600) + 0.5) / 6000.0])
    angles = np.sort(angles)
    raised = circle(angles) + np.outer(np.where(angles < np.pi / 5, 3.0, 0.0), [0.0, 0.0, 1.0])
    share = np.linalg.norm(np.roll(raised, -1, axis=0) - raised, axis=1)
    level = smooth_curve(raised, 0)[0, 2]
    assert level == pytest.approx(3.0 * share[angles < np.pi / 5].sum() / share.sum(), rel=0.1)


def test_a_closed_surface_has_no_rim():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    with pytest.raises(ValueError):
        smooth_rim(Mesh(corners, faces, corners[:, :2], faces))
