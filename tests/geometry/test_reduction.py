"""Fewer faces: nearness judged by pymeshlab, lines and map by what a subset has to keep, a plane and a ball exactly."""

import numpy as np
import pytest
from shapes import grid_plane, sphere, turned

from shared.geometry import reduction
from shared.geometry.eyeballs import eyeballs_of
from shared.geometry.mesh import Mesh, face_normals, interpolate, mesh_edges
from shared.geometry.mesh_checks import mesh_errors, uv_overlap
from shared.geometry.raycast import RayScene, camera_hits
from shared.geometry.reduction import reduced
from shared.geometry.surface import Surface
from shared.tracking.models import load_head_model

WANTED = (20000, 5000)


@pytest.fixture(scope="module")
def head():
    """The head model, 35,744 faces, with the segments, seams and the open neck of every solved head."""
    model = load_head_model().subdivided()
    mesh = Mesh(model.template, model.faces, model.uvs, model.face_uvs)
    return Surface(mesh, model.face_segment, tuple(model.segment_names))


@pytest.fixture(scope="module")
def heads(head):
    return reduced(head, WANTED)


def used_only(mesh):
    used, faces = np.unique(mesh.faces, return_inverse=True)
    return mesh.vertices[used], faces.reshape(-1, 3)


def distances(pymeshlab, source, target):
    """mm from points spread over the source to the target."""
    meshes = pymeshlab.MeshSet(verbose=False)
    for mesh in (source, target):
        vertices, faces = used_only(mesh)
        meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=vertices, face_matrix=faces))
    meshes.get_hausdorff_distance(sampledmesh=0, targetmesh=1, samplenum=20000, savesample=True, samplevert=False,
                                  sampleedge=False, sampleface=True)
    return np.abs(meshes.mesh(2).vertex_scalar_array())


def test_as_many_faces_as_wanted(head, heads):
    for found, wanted in zip(heads, WANTED, strict=True):
        assert wanted - 2 < len(found.mesh.faces) <= wanted and len(found.faces) == len(found.mesh.faces)
        assert found.mesh.uvs.shape == head.mesh.uvs.shape and found.mesh.vertices.shape == head.mesh.vertices.shape


def test_the_same_bits_again(head, heads):
    for one, other in zip(heads, reduced(head, WANTED), strict=True):
        for name in ("vertices", "faces", "uvs", "face_uvs"):
            np.testing.assert_array_equal(getattr(one.mesh, name), getattr(other.mesh, name))
        np.testing.assert_array_equal(one.faces, other.faces)


@pytest.mark.parametrize(("which", "largest_mm"), [(0, 0.1), (1, 0.4)])
def test_near_to_the_surface_both_ways(head, heads, which, largest_mm):
    """95 % of either surface, by another program's measure."""
    pymeshlab = pytest.importorskip("pymeshlab", reason="pymeshlab is not installed")
    for pair in ((head.mesh, heads[which].mesh), (heads[which].mesh, head.mesh)):
        assert np.percentile(distances(pymeshlab, *pair), 95) < largest_mm


def test_each_corner_has_the_uvs_of_its_vertex(head, heads):
    """So that both sides of a seam lie in the same vertices, and show there what they did."""
    def corners(mesh):
        return set(zip(mesh.faces.ravel().tolist(), mesh.face_uvs.ravel().tolist(), strict=True))

    for found in heads:
        assert corners(found.mesh) < corners(head.mesh)


def line_edges(surface, faces, face_uvs, segment, kind):
    """Edges [n, 2] of a kind of line, as pairs of vertices."""
    edges, edge, shared = mesh_edges(faces)
    if kind == "border":
        return edges[shared == 1]
    by_edge = {}
    for f, row in enumerate(edge):
        for k, own in enumerate(row):
            ends = {int(faces[f, k]): int(face_uvs[f, k]), int(faces[f, k - 2]): int(face_uvs[f, k - 2])}
            by_edge.setdefault(int(own), []).append(ends if kind == "seam" else int(segment[f]))
    differing = [own for own, sides in by_edge.items() if len(sides) == 2 and sides[0] != sides[1]]
    return edges[differing]


@pytest.mark.parametrize(("kind", "most_lost"), [("border", 0.01), ("seam", 0.02), ("outline", 0.03)])
def test_lines_stay(head, heads, kind, most_lost):
    """The open neck, the seams and the edges of the lips: along vertices of theirs, and hardly shorter."""
    lips = head.segment_names.index("lips")
    whole = line_edges(head, head.mesh.faces, head.mesh.face_uvs, head.face_segment == lips, kind)
    length = np.linalg.norm(np.diff(head.mesh.vertices[whole], axis=1), axis=-1).sum()
    assert length > 100.0
    for found in heads:
        left = line_edges(head, found.mesh.faces, found.mesh.face_uvs, head.face_segment[found.faces] == lips, kind)
        assert set(left.ravel()) <= set(whole.ravel())
        own = np.linalg.norm(np.diff(found.mesh.vertices[left], axis=1), axis=-1).sum()
        assert (1.0 - most_lost) * length < own < 1.01 * length


def seen_uvs(mesh, yaw_deg):
    """[160 * 160, 2] UVs that a camera sees before the head, NaN beside it."""
    pose = turned(np.radians([0.0, yaw_deg, 0.0]), (0.0, 0.0, 600.0))
    lens = np.array([[300.0, 0.0, 80.0], [0.0, 300.0, 80.0], [0.0, 0.0, 1.0]])
    face, bary, _ = camera_hits(RayScene(mesh.vertices, mesh.faces), pose, lens, 160, 160)
    uvs = interpolate(mesh.uvs, mesh.face_uvs, face.ravel(), bary.reshape(-1, 3))
    uvs[face.ravel() < 0] = np.nan
    return uvs


def texture_off_mm(mesh, whole, yaw_deg):
    """[n] how far beside each other, on the whole mesh, both show their texture to a camera."""
    flat = np.column_stack([whole.uvs, np.zeros(len(whole.uvs))])
    area, uv_area = (np.linalg.norm(face_normals(places, faces), axis=1).sum()
                     for places, faces in ((whole.vertices, whole.faces), (flat, whole.face_uvs)))
    off = np.linalg.norm(seen_uvs(mesh, yaw_deg) - seen_uvs(whole, yaw_deg), axis=-1)
    return off[np.isfinite(off)] * np.sqrt(area / uv_area)


@pytest.mark.parametrize(("which", "most_left"), [(0, 0.95), (1, 0.9)])
def test_uvs_are_fitted_and_those_of_seams_stay(head, heads, which, most_left):
    mesh = heads[which].mesh
    before, after = (texture_off_mm(each, head.mesh, 0.0) for each in (mesh.replace(uvs=head.mesh.uvs), mesh))
    assert np.mean(after[after < 20.0]) < most_left * np.mean(before[before < 20.0])
    seam = np.unique(line_edges(head, head.mesh.faces, head.mesh.face_uvs, head.face_segment, "seam"))
    own = head.mesh.face_uvs[np.isin(head.mesh.faces, seam)]
    np.testing.assert_array_equal(mesh.uvs[own], head.mesh.uvs[own])
    assert (mesh.uvs != head.mesh.uvs).any(1).mean() > 0.1


@pytest.mark.parametrize("yaw_deg", [-60.0, 0.0, 60.0])
@pytest.mark.parametrize(("which", "largest_mm"), [(0, 0.25), (1, 1.3)])
def test_the_texture_stays_where_it_was(head, heads, which, largest_mm, yaw_deg):
    """From the front and from the sides, where both show the same island of the map."""
    off_mm = texture_off_mm(heads[which].mesh, head.mesh, yaw_deg)
    assert len(off_mm) > 3000 and np.median(off_mm) < 0.35 * largest_mm
    assert np.percentile(off_mm[off_mm < 20.0], 95) < largest_mm and (off_mm > 20.0).mean() < 0.01


def test_of_few_faces_lids_and_lips_have_a_greater_share(head, heads, monkeypatch):
    """Of 5,000, not of 20,000; what the level before had taken away stays away."""
    monkeypatch.setattr(reduction, "FEW_WEIGHTS", {})
    plain = reduction.reduced(head, WANTED)
    own = head.faces_of(("lids", "lips"))
    counts = [[own[each.faces].sum() for each in both] for both in (heads, plain)]
    assert counts[0][0] == counts[1][0] and counts[0][1] > 1.25 * counts[1][1]
    np.testing.assert_array_equal(heads[0].mesh.faces, plain[0].mesh.faces)
    assert np.isin(heads[1].faces, heads[0].faces).all()


def topology(faces):
    edges, _, shared = mesh_edges(faces)
    return len(np.unique(faces)) - len(edges) + len(faces), shared.max()


def test_nothing_tears_or_turns_over(head, heads):
    """The same number of pieces, holes and handles; sound as a mesh; no face lies over another in the map."""
    texture = head.mesh.uvs[:, :2]

    def turns(mesh):
        a, b, c = np.moveaxis(texture[mesh.face_uvs], 1, 0)
        return np.sign(np.linalg.det(np.stack([b - a, c - a], axis=1)))

    assert set(turns(head.mesh)) == {1.0}
    for found in heads:
        assert topology(found.mesh.faces) == topology(head.mesh.faces)
        assert mesh_errors(found.mesh) == []
        assert set(turns(found.mesh)) == {1.0}
        assert uv_overlap(found.mesh, 1024)[0] < 1e-3


def test_eyeballs_stay_round_about_their_centres(head, heads):
    for found in heads:
        for whole in eyeballs_of(head):
            left = found.eyeball(whole)
            assert 50 < len(left.faces) < len(whole.faces) and left.centre is whole.centre
            np.testing.assert_array_equal(np.unique(found.mesh.faces[left.faces]), left.vertices)
            assert (head.face_segment[found.faces[left.faces]] == head.segment_names.index("eyes")).all()
            radius = np.linalg.norm(found.mesh.vertices[left.vertices] - left.centre, axis=1)
            before = np.linalg.norm(head.mesh.vertices[left.vertices] - left.centre, axis=1)
            np.testing.assert_allclose(radius, before, atol=0.5)


def test_a_plane_becomes_two_faces_with_the_same_map():
    plane = grid_plane(9, 40.0)
    (found,) = reduced(Surface(plane), [2])
    corners = found.mesh.vertices[np.unique(found.mesh.faces)]
    assert len(found.mesh.faces) == 2
    np.testing.assert_allclose(np.abs(corners), [[20.0, 20.0, 0.0]] * 4, atol=1e-6)
    assert np.linalg.norm(face_normals(found.mesh.vertices, found.mesh.faces), axis=1).sum() == pytest.approx(3200.0)
    places = found.mesh.vertices[found.mesh.faces][..., :2]
    np.testing.assert_allclose(found.mesh.uvs[found.mesh.face_uvs], places / 40.0 + 0.5, atol=1e-6)


def test_a_seam_across_a_plane_stays_straight():
    """The plane's right half has UVs of its own: what is left of it lies right of the line."""
    plane = grid_plane(9, 40.0)
    right = plane.vertices[plane.faces][..., 0].mean(1) > 0.0
    uvs = np.concatenate([plane.uvs * [0.4, 1.0], plane.uvs * [0.4, 1.0] + [0.5, 0.0]])
    face_uvs = plane.faces + np.where(right, len(plane.uvs), 0)[:, None]
    (found,) = reduced(Surface(plane.replace(uvs=uvs, face_uvs=face_uvs)), [4])
    own = right[found.faces]
    assert len(own) == 4 and own.sum() == 2
    x = found.mesh.vertices[found.mesh.faces][..., 0]
    assert x[own].min() == 0.0 and x[~own].max() == 0.0
    np.testing.assert_array_equal(found.mesh.face_uvs >= len(plane.uvs), own[:, None].repeat(3, axis=1))


def test_faces_of_a_ball_lie_about_it():
    """As often outside as inside, where those between points of the ball would all lie inside."""
    ball = sphere(50.0, 5)
    (found,) = reduced(Surface(ball), [800])
    inside = 50.0 - np.linalg.norm(ball.vertices[found.mesh.faces].mean(1), axis=1)
    after = 50.0 - np.linalg.norm(found.mesh.vertices[found.mesh.faces].mean(1), axis=1)
    assert inside.min() > 0.0 and inside.mean() > 0.15
    assert abs(after.mean()) < 0.5 * inside.mean()


def test_what_has_few_faces_stays_as_it_is():
    ball = sphere(50.0, 1)
    assert all(found.mesh is ball for found in reduced(Surface(ball), [1000, 500]))


def test_the_last_manifold_stays():
    """A tetrahedron cannot lose a vertex and stay a surface."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32)
    tetrahedron = Mesh(corners, faces, corners[:, :2], faces)
    assert reduced(Surface(tetrahedron), [1])[0].mesh is tetrahedron
