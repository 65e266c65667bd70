"""Meshes of other programs: what of Wavefront's format is read, and what is refused with one line."""

import numpy as np
import pytest
from shapes import sphere

from shared.errors import InputError
from shared.io.arrays import save_arrays
from shared.io.meshes import load_mesh, read_obj, write_obj

CORNERS = "v 0 0 0\nv 1 0 0 0.5 0.5 0.5\nv 1 1 0\nv 0 1 0\nv 0 2 0\nvt 0 0\nvt 1 0\nvt 1 1 0\nvt 0 1\n"


def read(folder, text):
    (folder / "mesh.obj").write_text(text)
    return read_obj(folder / "mesh.obj")


def test_what_is_written_comes_back(tmp_path):
    ball = sphere(3.0)
    write_obj(tmp_path / "mesh.obj", ball)
    back = read_obj(tmp_path / "mesh.obj")
    assert np.allclose(back.vertices, ball.vertices, atol=1e-4) and np.allclose(back.uvs, ball.uvs, atol=1e-6)
    assert (back.faces == ball.faces).all() and (back.face_uvs == ball.face_uvs).all()


def test_polygons_become_fans(tmp_path):
    mesh = read(tmp_path, CORNERS + "# a comment\nusemtl skin\nf 1/1 2/2 3/3 4/4\nf 1/1 2/2\nf 3/3/1 4/4/1 5/4/1\n")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [2, 3, 4]]
    assert mesh.face_uvs.tolist() == [[0, 1, 2], [0, 2, 3], [2, 3, 3]]
    assert mesh.vertices[1].tolist() == [1.0, 0.0, 0.0] and mesh.uvs[2].tolist() == [1.0, 1.0]


def test_indices_may_count_from_the_end_and_uvs_be_left_out(tmp_path):
    mesh = read(tmp_path, CORNERS + "f -5 -4//1 -3/\n")
    assert mesh.faces.tolist() == [[0, 1, 2]] and mesh.face_uvs.tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("text, message", [
    ("v 0 0 0\n", "no vertices or no faces"),
    (CORNERS + "f 1 2\n", "no vertices or no faces"),
    (CORNERS + "f 1 2 9\n", "point outside"),
    (CORNERS + "f 1 2 99999999999999999999\n", "not a mesh"),
    (CORNERS + "f 1 2 4294967297\n", "point outside"),
    (CORNERS + "f 1 2 three\n", "not a mesh"),
    ("v 0 0\n" + CORNERS + "f 1 2 3\n", "not a mesh"),
    ("v 0 0 zero\n" + CORNERS + "f 1 2 3\n", "not a mesh"),
])
def test_what_cannot_be_read_is_one_line(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read(tmp_path, text)


def test_arrays_of_any_whole_type_are_a_mesh(tmp_path):
    corner = np.array([[0, 1, 2]], np.int64)
    save_arrays(tmp_path / "mesh.npz", vertices=np.eye(3), faces=corner, uvs=np.zeros((3, 2)), face_uvs=corner)
    mesh = load_mesh(tmp_path / "mesh.npz")
    assert mesh.faces.dtype == np.int32 and mesh.face_uvs.dtype == np.int32 and mesh.faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("changes, message", [
    ({"faces": np.zeros(0, np.int32)}, "faces are no part of a mesh"),
    ({"faces": np.array([[0.0, 1.0, 2.0]])}, "expected whole numbers"),
    ({"faces": np.array([["a", "b", "c"]])}, "faces are no part"),
    ({"face_uvs": np.zeros((2, 3), np.int32)}, "not as many triangles"),
    ({"vertices": np.zeros((3, 2))}, "vertices are no part"),
    ({"vertices": np.full((3, 3), np.nan)}, "vertices are not finite"),
    ({"uvs": np.full((3, 2), np.inf)}, "uvs are not finite"),
    ({"faces": np.array([[0, 1, 3]])}, "point outside"),
])
def test_arrays_that_are_no_mesh_are_one_line(tmp_path, changes, message):
    whole = {"vertices": np.eye(3), "faces": np.array([[0, 1, 2]]), "uvs": np.zeros((3, 2)),
             "face_uvs": np.array([[0, 1, 2]])}
    arrays = whole | changes
    save_arrays(tmp_path / "mesh.npz", vertices=arrays["vertices"], faces=arrays["faces"], uvs=arrays["uvs"],
                face_uvs=arrays["face_uvs"])
    with pytest.raises(InputError, match=message):
        load_mesh(tmp_path / "mesh.npz")
