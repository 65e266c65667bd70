"""Head and hair as one mesh with one set of maps, and as files."""

import numpy as np
import pytest
from field_check import field_faults
from shapes import sphere

from shared.contract.records import TRIANGLES
from shared.geometry.surface import Surface
from shared.hair.hair_files import read_hair, write_hair
from shared.hair.joined import HAIR_SEGMENT, HairSurface, joined_maps, joined_mesh, joined_surface
from shared.imaging.texture import sample_bilinear
from shared.io.arrays import load_arrays
from shared.io.meshes import write_obj

HEAD, HAIR = sphere(80.0, 2), sphere(95.0, 1)


@pytest.fixture
def hair():
    rng = np.random.default_rng(4)
    return HairSurface(HAIR, rng.uniform(size=(32, 32, 3)).astype(np.float32),
                       rng.uniform(size=(32, 32)).astype(np.float32))


def test_each_reads_its_own_maps(hair):
    rng = np.random.default_rng(5)
    maps = {"diffuse_albedo": rng.uniform(size=(32, 32, 3)).astype(np.float32),
            "specular_intensity": np.full((32, 32), 0.7, np.float32), "roughness": np.full((32, 32), 0.4, np.float32)}
    mesh, both = joined_mesh(HEAD, HAIR), joined_maps(maps, hair)
    for own, first, image in ((HEAD, 0, maps["diffuse_albedo"]), (HAIR, len(HEAD.faces), hair.albedo)):
        inside = np.clip(own.uvs[own.face_uvs].mean(1), 0.05, 0.95)
        joined = inside * [0.5, 1.0] + [0.5 * (first > 0), 0.0]
        middle = mesh.uvs[mesh.face_uvs[first : first + len(own.faces)]].mean(1)
        assert np.allclose(np.clip(middle[:, 0] % 0.5 * 2.0, 0.05, 0.95), inside[:, 0])
        assert np.allclose(sample_bilinear(both["diffuse_albedo"], joined), sample_bilinear(image, inside), atol=1e-5)
    assert np.array_equal(mesh.faces[: len(HEAD.faces)], HEAD.faces)
    assert np.array_equal(mesh.vertices[mesh.faces[len(HEAD.faces):]], HAIR.vertices[HAIR.faces])
    assert (both["alpha"][:, :32] == 1.0).all() and np.array_equal(both["alpha"][:, 32:], hair.alpha)
    assert (both["specular_intensity"][:, 32:] == 0.0).all()


def test_hair_is_a_segment_of_its_own():
    surface = Surface(HEAD, np.zeros(len(HEAD.faces), int), ("scalp",))
    both = joined_surface(surface, HAIR)
    assert both.faces_of((HAIR_SEGMENT,)).sum() == len(HAIR.faces)
    assert both.faces_of(("scalp",)).sum() == len(HEAD.faces)


def test_files_hold_what_was_written(hair, tmp_path):
    (tmp_path / "maps").mkdir()
    assert read_hair(tmp_path) is None
    write_hair(tmp_path, hair)
    found = read_hair(tmp_path)
    assert field_faults(load_arrays(tmp_path / "hair.npz"), TRIANGLES) == []
    assert np.array_equal(found.mesh.vertices, HAIR.vertices) and np.array_equal(found.mesh.face_uvs, HAIR.face_uvs)
    assert np.allclose(found.albedo, hair.albedo) and np.allclose(found.alpha, hair.alpha)
    (tmp_path / "hair.npz").unlink()
    write_obj(tmp_path / "hair.obj", hair.mesh)
    assert np.allclose(read_hair(tmp_path).mesh.vertices, HAIR.vertices, atol=1e-4)
