"""The export as Blender sees it: what arrives, and a Cycles render against our own.

Skipped unless LIMN_BLENDER_PYTHON names a Python with the bpy wheel (see tools/bench/peers/blender.py).
"""

import os

import numpy as np
import pytest
from toy_result import (
    EYE_CENTRES,
    FRAMES,
    INTRINSICS,
    MAP_SIZE,
    SOURCE_SIZE,
    ToyJob,
    toy_gaze,
    toy_mesh,
    toy_poses,
    write_toy_work,
)

from shared.geometry.eyeballs import gaze_rotation
from shared.geometry.mesh import vertex_normals
from shared.geometry.transforms import rigid
from shared.io.images import write_png
from stages import export_usd
from tools.bench.peers.blender import VARIABLE, blender_python, compare_render, comparison_picture, probe

pytestmark = pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"needs Blender: set {VARIABLE} to its Python")

NAME = '1st "Zoë" <take> / été'
USD_FILES, CLOSE_DB = ("head.usda", "head.usdz"), 28.0


@pytest.fixture(scope="module", params=["head", "camera"])
def exported(request, tmp_path_factory):
    """(what moves, the toy's export under a difficult name)."""
    base = tmp_path_factory.mktemp(f"blender_{request.param}")
    job = ToyJob(write_toy_work(base / "work", request.param), base / "export", NAME)
    export_usd.run(job)
    return request.param, job.out


@pytest.fixture(scope="module", params=[*USD_FILES, "head.glb"])
def seen(request, exported):
    """(file, what moves, what Blender made of it). glTF starts at 0 s, at the toy's frame 3."""
    frames = [int(frame) for frame in FRAMES]
    moves, folder = exported
    return request.param, moves, probe(blender_python(), folder / request.param, frames)


def test_mesh_and_uvs_arrive(seen):
    """Corner by corner the same triangles, texture coordinates and normals."""
    file, _, found = seen
    mesh, arrays = toy_mesh(), found.mesh
    corners = arrays["vertices"][arrays["corners"]]
    expected = mesh.vertices[mesh.faces].reshape(-1, 3)
    if file == "head.glb":  # the importer turns y up into z up, and metres are Blender's own unit
        expected = 0.001 * expected @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    order = [np.lexsort(np.round(side, 3 if file != "head.glb" else 6).T) for side in (corners, expected)]
    np.testing.assert_allclose(corners[order[0]], expected[order[1]], atol=2e-3)
    if file == "head.glb":
        return
    np.testing.assert_allclose(corners, expected, atol=1e-4)
    np.testing.assert_allclose(arrays["uvs"], mesh.uvs[mesh.face_uvs].reshape(-1, 2), atol=1e-6)
    smooth = vertex_normals(mesh.vertices, mesh.faces)[mesh.faces].reshape(-1, 3)
    np.testing.assert_allclose(arrays["normals"], smooth, atol=2e-3)  # Blender keeps them in 16 bits
    assert len(found.facts["meshes"]) == 1  # the clip's card is a guide and stays out


def test_textures_arrive_in_their_colour_spaces(seen):
    """Linear colours and data as they are (Blender's scene is linear Rec.709), 8-bit colours by their sRGB curve."""
    file, _, found = seen
    maps = found.facts["material"]["maps"]
    assert all(image["loaded"] and image["size"] == [MAP_SIZE, MAP_SIZE] for image in maps.values() if image)
    spaces = {name: image and image["colour_space"] for name, image in maps.items()}
    coded = file != "head.usda"
    assert spaces["diffuse_albedo"] == ("sRGB" if coded else "Non-Color")
    assert spaces["roughness"] == spaces["normal"] == "Non-Color"
    if file != "head.glb":
        assert spaces["specular_ior"] == "Non-Color"
        assert {image["extension"] for image in maps.values()} == {"EXTEND"}
    assert "NORMAL_MAP" in found.facts["material"]["nodes"]


def test_camera_arrives(seen):
    """Lens and film back; the principal point as a shift of the lens, which glTF has not."""
    file, _, found = seen
    lens, (width, height) = found.facts["camera"], SOURCE_SIZE
    if file == "head.glb":
        assert lens["sensor_fit"] == "VERTICAL" and lens["shift"] == [0.0, 0.0]
        assert lens["lens"] / lens["sensor_height"] * height == pytest.approx(INTRINSICS[1, 1], rel=1e-4)
        return
    focal_px = lens["lens"] / lens["sensor_width"] * width
    assert lens["sensor_fit"] == "HORIZONTAL" and lens["sensor_width"] == pytest.approx(22.3, rel=1e-5)
    assert focal_px == pytest.approx(INTRINSICS[0, 0], rel=1e-5)
    assert lens["shift"][0] == pytest.approx(0.5 - INTRINSICS[0, 2] / width, abs=1e-6)
    squeeze = INTRINSICS[0, 0] / INTRINSICS[1, 1]  # pixels that are not square are the scene's affair, not the lens's
    assert lens["shift"][1] == pytest.approx((INTRINSICS[1, 2] - height / 2) / width * squeeze, abs=1e-6)


def test_motion_arrives(seen):
    """In every frame of the clip the head stands before the camera as tracked."""
    file, _, found = seen
    if file == "head.glb":
        return  # Blender resamples it to its own 24 frames a second; test_gltf.py reads the samples themselves
    for frame, pose in zip(FRAMES, toy_poses(), strict=True):
        expected = np.diag([1.0, -1.0, -1.0, 1.0]) @ pose
        np.testing.assert_allclose(found.facts["poses"][str(frame)], expected, atol=2e-3)
    assert found.facts["frames"] == [FRAMES[0], FRAMES[-1]]


def test_light_arrives(seen):
    file, _, found = seen
    light = found.facts["light"]
    if file == "head.glb":
        assert light is None or light["image"] is None  # glTF knows no environment light
        return
    assert light["image"]["loaded"] and light["image"]["colour_space"] == "Linear Rec.709"
    assert light["strength"] == pytest.approx(1.0)


def test_what_blender_drops(seen):
    """The list of docs/blender.md: when a later Blender keeps one of these, this test says so."""
    file, _, found = seen
    if file == "head.glb":
        return
    assert found.facts["material"]["nodes"].count("TEX_IMAGE") == 4  # the preview's four, none of OpenPBR's
    assert found.facts["fps"] == 24.0
    assert not any("limn" in name for name in found.facts["properties"])


@pytest.fixture(scope="module", params=[*USD_FILES, "head.glb"])
def eyed(request, tmp_path_factory):
    """(file, what Blender made of the toy with eyes)."""
    base = tmp_path_factory.mktemp("blender_eyes")
    job = ToyJob(write_toy_work(base / "work", eyes=True), base / "export")
    export_usd.run(job)
    return request.param, probe(blender_python(), job.out / request.param, [int(frame) for frame in FRAMES])


def test_eyes_arrive(eyed):
    """Meshes and materials of their own, and, in USD, the gaze about the eyeballs' centres in every frame."""
    file, found = eyed
    assert found.facts["meshes"] == ["eye_left", "eye_right", "head"]
    for material in found.facts["eye_materials"].values():
        assert material["maps"]["diffuse_albedo"]["loaded"] and not material["maps"]["roughness"]
        assert material["values"]["roughness"] == pytest.approx(0.08)
        assert material["values"]["specular_ior"] == pytest.approx(1.376)
    if file == "head.glb":
        return  # see test_motion_arrives
    gaze = toy_gaze()
    for f in np.nonzero(np.isfinite(gaze).all((1, 2)))[0]:
        for k, name in enumerate(("eye_right", "eye_left")):
            expected = rigid(gaze_rotation(gaze[f, k]), EYE_CENTRES[k])
            np.testing.assert_allclose(found.facts["eyes"][str(FRAMES[f])][name], expected, atol=1e-3)


def test_cycles_agrees_with_our_render(tiny_run, tmp_path):
    """The tiny subject's middle frame, rendered by Cycles from the clip's camera: 28 dB on the face skin."""
    rendered = sorted(int(path.stem) for path in (tiny_run / "export" / "renders").glob("*.exr"))
    found = compare_render(tiny_run, blender_python(), rendered[len(rendered) // 2], width=160, samples=32)
    write_png(tmp_path / "comparison.png", comparison_picture(found))
    assert found.skin.sum() > 500
    assert found.psnr_srgb > CLOSE_DB and found.psnr_linear > CLOSE_DB, f"see {tmp_path / 'comparison.png'}"
    assert np.abs(np.array(found.ratio) - 1.0).max() < 0.08
