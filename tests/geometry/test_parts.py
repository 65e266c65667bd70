"""A mesh taken apart into head and eyeballs, and the runs of faces that belong to each."""

import numpy as np
from toy_result import EYE_CENTRES, toy_eyed_surface, toy_mesh

from shared.geometry.eyeballs import eyeballs_of
from shared.geometry.mesh import shading_normals
from shared.geometry.parts import head_parts, part_runs

SURFACE = toy_eyed_surface()
MESH, EYES = SURFACE.mesh, eyeballs_of(SURFACE)


def test_the_parts_together_are_the_mesh():
    """Corner by corner the same places, texture coordinates and normals, each face once."""
    parts = head_parts(MESH, EYES)
    assert [part.name for part in parts] == ["head", "eye_right", "eye_left"]
    order = np.concatenate([np.nonzero(SURFACE.face_segment == 0)[0], *(np.sort(eye.faces) for eye in EYES)])
    for of_part, of_mesh in (
        (lambda part: (part.mesh.vertices + part.pivot)[part.mesh.faces], MESH.vertices[MESH.faces]),
        (lambda part: part.mesh.uvs[part.mesh.face_uvs], MESH.uvs[MESH.face_uvs]),
        (lambda part: part.normals[part.mesh.faces], shading_normals(MESH)[MESH.faces]),
    ):
        np.testing.assert_allclose(np.concatenate([of_part(part) for part in parts]), of_mesh[order], atol=1e-12)
    assert all(set(part.mesh.faces.ravel()) == set(range(len(part.mesh.vertices))) for part in parts)


def test_vertices_and_uvs_are_numbered_as_faces_use_them():
    for part in head_parts(MESH, EYES):
        for corners in (part.mesh.faces.ravel(), part.mesh.face_uvs.ravel()):
            _, first = np.unique(corners, return_index=True)
            assert (np.diff(first) > 0).all()


def test_a_reduced_mesh_leaves_out_what_it_does_not_use():
    """The normals that are given stay with their vertices."""
    few = MESH.replace(faces=MESH.faces[:40], face_uvs=MESH.face_uvs[:40])
    normals = shading_normals(MESH)
    (head,) = head_parts(few, (), normals)
    assert len(head.mesh.vertices) == len(np.unique(few.faces)) and len(head.mesh.uvs) == len(np.unique(few.face_uvs))
    np.testing.assert_array_equal(head.mesh.vertices[head.mesh.faces], MESH.vertices[few.faces])
    np.testing.assert_array_equal(head.normals, normals[head.vertices])


def test_eyes_turn_about_their_centres():
    head, *eyes = head_parts(MESH, EYES)
    np.testing.assert_array_equal(head.pivot, 0.0)
    for eye, centre in zip(eyes, EYE_CENTRES, strict=True):
        np.testing.assert_allclose(eye.pivot, centre, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(eye.mesh.vertices, axis=1), 12.0, atol=1e-9)


def test_without_eyes_the_head_is_the_mesh():
    mesh = toy_mesh()
    (head,) = head_parts(mesh)
    assert head.mesh is mesh and head.name == "head"
    assert part_runs(len(mesh.faces), ()) == [("head", 0, len(mesh.faces))]


def test_runs_follow_the_order_of_the_faces():
    assert part_runs(len(MESH.faces), EYES) == [("head", 0, 512), ("eye_left", 512, 640), ("eye_right", 640, 768)]
    left, right = EYES[1], EYES[0]
    mixed = [type(right)(e.vertices, e.faces[::2], e.centre, e.radius) for e in (right, left)]
    runs = part_runs(len(MESH.faces), mixed)
    assert [after for _, _, after in runs[:-1]] == [first for _, first, _ in runs[1:]]
    assert sum(after - first for name, first, after in runs if name == "eye_left") == len(mixed[1].faces)
