"""head.glb, read back by trimesh and by the container's own rules."""

import io
import json
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from toy_result import (
    EYE_CENTRES,
    FRAMES,
    INTRINSICS,
    SOURCE_SIZE,
    toy_eyed_surface,
    toy_gaze,
    toy_maps,
    toy_mesh,
    toy_poses,
)

from shared.geometry.blend_shapes import BlendShape, with_normals
from shared.geometry.eyeballs import eyeballs_of, gaze_rotation
from shared.geometry.mesh import uv_tangents, vertex_normals
from shared.geometry.parts import head_parts
from shared.imaging.color import encode_srgb
from shared.io.gltf import write_glb
from shared.io.gltf_validate import glb_errors
from shared.io.usd_capture import UsdCapture, world_from_head_rigid, world_from_usd_camera

NAME = '1st "Zoë" <take> / été'


def capture(moves):
    return UsdCapture(toy_poses(), FRAMES, 25.0, INTRINSICS, *SOURCE_SIZE, moves)


@pytest.fixture(params=["head", "camera"])
def moves(request):
    return request.param


@pytest.fixture
def file(tmp_path, moves):
    write_glb(tmp_path / "head.glb", NAME, head_parts(toy_mesh()), toy_maps(), capture(moves))
    return tmp_path / "head.glb"


def chunks(path):
    """The JSON and the binary chunk, by the specification of the container."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    content = json.loads(data[20 : 20 + size])
    binary_size, binary_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert binary_kind == b"BIN\0" and 28 + size + binary_size == len(data)
    return content, data[28 + size :]


def accessor(content, binary, index):
    """An accessor's values."""
    row = content["accessors"][index]
    view = content["bufferViews"][row["bufferView"]]
    assert view["byteOffset"] % 4 == 0
    kind = {5126: "<f4", 5125: "<u4"}[row["componentType"]]
    columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[row["type"]]
    values = np.frombuffer(binary, kind, row["count"] * columns, view["byteOffset"]).reshape(-1, columns)
    assert values.nbytes == view["byteLength"]
    for bound, reduce in (("min", np.min), ("max", np.max)):
        if bound in row:
            np.testing.assert_allclose(reduce(values, axis=0), row[bound], rtol=1e-6)
    return values


def picture(content, binary, texture):
    view = content["bufferViews"][content["images"][content["textures"][texture]["source"]]["bufferView"]]
    data = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return decoded[..., [2, 1, 0, 3][: decoded.shape[2]]] / 255.0


def test_geometry_in_metres_with_v_downwards(file):
    mesh = toy_mesh()
    primitive = next(iter(chunks(file)[0]["meshes"]))["primitives"][0]
    content, binary = chunks(file)
    index = accessor(content, binary, primitive["indices"]).reshape(-1, 3)
    positions, normals, uvs = (accessor(content, binary, primitive["attributes"][name])[index] for name in (
        "POSITION", "NORMAL", "TEXCOORD_0"))
    np.testing.assert_allclose(positions, mesh.vertices[mesh.faces] * 0.001, atol=1e-7)
    np.testing.assert_allclose(normals, vertex_normals(mesh.vertices, mesh.faces)[mesh.faces], atol=1e-6)
    np.testing.assert_allclose(uvs * [1, -1] + [0, 1], mesh.uvs[mesh.face_uvs], atol=1e-6)


def test_tangents_are_those_of_the_normal_map(file):
    """Corner by corner the direction of growing u, and of growing v as the map's rows have it, upwards."""
    mesh = toy_mesh()
    content, binary = chunks(file)
    primitive = content["meshes"][0]["primitives"][0]
    index = accessor(content, binary, primitive["indices"])[:, 0]
    normals, tangents = (accessor(content, binary, primitive["attributes"][name])[index].astype(float)
                         for name in ("NORMAL", "TANGENT"))
    np.testing.assert_allclose(np.linalg.norm(tangents[:, :3], axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose((tangents[:, :3] * normals).sum(1), 0.0, atol=1e-5)
    face, bary = np.repeat(np.arange(len(mesh.faces)), 3), np.tile(np.eye(3), (len(mesh.faces), 1))
    expected = uv_tangents(mesh, normals, face, bary)
    known = np.linalg.norm(expected[:, 0], axis=1) > 0.5
    assert known.mean() > 0.9
    np.testing.assert_allclose(tangents[known, :3], expected[known, 0], atol=1e-5)
    up = np.cross(normals, tangents[:, :3]) * tangents[:, 3:]
    # The toy's faces that span its map from side to side are mirrored there, at corners that they share.
    assert (np.abs(up[known] - expected[known, 1]).max(1) < 1e-4).mean() > 0.9


def test_another_reader_agrees(file):
    """trimesh: the same triangles, texture coordinates (turned back) and material."""
    scene, mesh = trimesh.load(io.BytesIO(file.read_bytes()), file_type="glb"), toy_mesh()
    (geometry,) = scene.geometry.values()
    assert geometry.faces.shape == mesh.faces.shape
    np.testing.assert_allclose(geometry.vertices[geometry.faces], mesh.vertices[mesh.faces] * 0.001, atol=1e-6)
    np.testing.assert_allclose(geometry.visual.uv[geometry.faces], mesh.uvs[mesh.face_uvs], atol=1e-5)
    material = geometry.visual.material
    assert (material.name, material.metallicFactor, material.roughnessFactor) == ("skin", 0.0, 1.0)
    assert set(scene.graph.nodes) >= {"head", "camera"}


def test_textures_say_what_the_maps_say(file):
    content, binary = chunks(file)
    maps, material = toy_maps(), content["materials"][0]
    surface, specular = material["pbrMetallicRoughness"], material["extensions"]["KHR_materials_specular"]
    albedo = picture(content, binary, surface["baseColorTexture"]["index"])
    np.testing.assert_allclose(albedo, encode_srgb(maps["diffuse_albedo"]), atol=0.5 / 255 + 1e-6)
    rough = picture(content, binary, surface["metallicRoughnessTexture"]["index"])[..., 1]
    np.testing.assert_allclose(rough * surface["roughnessFactor"], maps["roughness"], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(picture(content, binary, material["normalTexture"]["index"]), maps["normal"],
                               atol=0.5 / 255 + 1e-6)
    weight = picture(content, binary, specular["specularTexture"]["index"])[..., 3]
    # F0 = min(0.04 specularColor, 1) specular, where specular is the texture's alpha
    f0 = 0.04 * specular["specularColorFactor"][0] * weight
    np.testing.assert_allclose(f0, 0.04 * maps["specular_intensity"], atol=0.04 * 1.4 * 0.5 / 255 + 1e-6)
    assert "KHR_materials_specular" in content["extensionsUsed"]


def test_motion_and_lens(file, moves):
    content, binary = chunks(file)
    animation = content["animations"][0]
    node = {"head": 0, "camera": 1}[moves]
    expected = world_from_head_rigid(capture(moves)) if moves == "head" else world_from_usd_camera(capture(moves))
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        assert channel["target"]["node"] == node
        seconds = accessor(content, binary, sampler["input"])[:, 0]
        np.testing.assert_allclose(seconds, (FRAMES - FRAMES[0]) / 25.0, atol=1e-6)
        values = accessor(content, binary, sampler["output"])
        if channel["target"]["path"] == "translation":
            np.testing.assert_allclose(values, expected[:, :3, 3] * 0.001, atol=1e-6)
        else:
            x, y, z, w = values.T
            third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
            np.testing.assert_allclose(third, expected[:, :3, 2], atol=1e-6)
            assert ((values[1:] * values[:-1]).sum(1) > 0).all()
    lens = content["cameras"][0]["perspective"]
    assert np.tan(lens["yfov"] / 2) == pytest.approx(SOURCE_SIZE[1] / 2 / INTRINSICS[1, 1])
    assert np.tan(lens["yfov"] / 2) * lens["aspectRatio"] == pytest.approx(SOURCE_SIZE[0] / 2 / INTRINSICS[0, 0])


def eye_rotations(content, binary, node):
    """Seconds [n] and rotations [n, 3, 3] of the animation of a node."""
    animation = content["animations"][0]
    (channel,) = (row for row in animation["channels"] if row["target"]["node"] == node)
    assert channel["target"]["path"] == "rotation"
    sampler = animation["samplers"][channel["sampler"]]
    assert sampler["interpolation"] == "LINEAR"
    seconds, values = (accessor(content, binary, sampler[side]) for side in ("input", "output"))
    return seconds[:, 0], Rotation.from_quat(values).as_matrix()


@pytest.fixture
def eyed(tmp_path, moves):
    surface = toy_eyed_surface()
    write_glb(tmp_path / "eyes.glb", NAME, head_parts(surface.mesh, eyeballs_of(surface)), toy_maps(),
              replace(capture(moves), eye_turn=toy_gaze()))
    return tmp_path / "eyes.glb"


def test_eyes_turn_below_the_head(eyed):
    """Nodes at the eyeballs' centres whose rotation is the gaze's, in the frames in which they are open."""
    content, binary = chunks(eyed)
    assert [content["nodes"][k]["name"] for k in content["nodes"][0]["children"]] == ["eye_right", "eye_left"]
    assert content["scenes"][0]["nodes"] == [0, 1]
    for k, node in enumerate(content["nodes"][0]["children"]):
        np.testing.assert_allclose(content["nodes"][node]["translation"], EYE_CENTRES[k] * 0.001, atol=1e-9)
        assert "rotation" not in content["nodes"][node]
        is_open = np.isfinite(toy_gaze()[:, k]).all(1)
        seconds, rotations = eye_rotations(content, binary, node)
        np.testing.assert_allclose(seconds, (FRAMES[is_open] - FRAMES[0]) / 25.0, atol=1e-6)
        np.testing.assert_allclose(rotations, gaze_rotation(toy_gaze()[is_open, k]), atol=1e-6)


def test_parts_at_rest_are_the_mesh(eyed):
    """trimesh places head and eyes: together the triangles of the one mesh, and every texture coordinate."""
    scene, surface = trimesh.load(io.BytesIO(eyed.read_bytes()), file_type="glb"), toy_eyed_surface()
    mesh, eyes = surface.mesh, eyeballs_of(surface)
    order = np.concatenate([np.nonzero(surface.face_segment == 0)[0], *(np.sort(eye.faces) for eye in eyes)])
    for name, faces in (("head", order[:512]), ("eye_right", order[512:640]), ("eye_left", order[640:])):
        transform, key = scene.graph.get(name)
        geometry = scene.geometry[key]
        places = geometry.vertices @ transform[:3, :3].T + transform[:3, 3]
        np.testing.assert_allclose(places[geometry.faces], mesh.vertices[mesh.faces[faces]] * 0.001, atol=1e-6)
        np.testing.assert_allclose(geometry.visual.uv[geometry.faces], mesh.uvs[mesh.face_uvs[faces]], atol=1e-5)


def test_eyes_have_a_material_of_their_own(eyed):
    content, _ = chunks(eyed)
    assert [content["meshes"][k]["primitives"][0]["material"] for k in range(3)] == [0, 1, 1]
    skin, eye = content["materials"]
    assert eye["pbrMetallicRoughness"]["baseColorTexture"] == skin["pbrMetallicRoughness"]["baseColorTexture"]
    assert eye["pbrMetallicRoughness"]["roughnessFactor"] == 0.08
    assert eye["extensions"]["KHR_materials_ior"]["ior"] == 1.376
    assert content["extensionsUsed"] == ["KHR_materials_ior", "KHR_materials_specular"]


def test_eyes_without_a_gaze_stay_at_rest(tmp_path):
    surface = toy_eyed_surface()
    write_glb(tmp_path / "a.glb", NAME, head_parts(surface.mesh, eyeballs_of(surface)), toy_maps(), capture("head"))
    assert {row["target"]["node"] for row in chunks(tmp_path / "a.glb")[0]["animations"][0]["channels"]} == {0}


def toy_actions(count):
    """A jaw, and a blink with an in-between."""
    random = np.random.default_rng(4)
    jaw, shut, half = (np.zeros((count, 3)) for _ in range(3))
    jaw[5:90] = random.normal(0.0, 9.0, (85, 3))
    shut[20:60], half[20:60] = random.normal(0.0, 4.0, (2, 40, 3))
    return BlendShape.of("jawOpen", jaw, 0.0), BlendShape.of("eyeBlinkLeft", shut, 0.0, ((0.5, half),))


def dense(content, binary, index):
    """[N, 3] of a sparse accessor over zeros."""
    row, values = content["accessors"][index], None
    assert "bufferView" not in row and row["componentType"] == 5126
    parts = []
    for part, kind, columns in (("indices", "<u2", 1), ("values", "<f4", 3)):
        view = content["bufferViews"][row["sparse"][part]["bufferView"]]
        assert part == "values" or row["sparse"][part]["componentType"] == 5123
        assert "target" not in view and view["byteOffset"] % 4 == 0
        parts.append(np.frombuffer(binary, kind, row["sparse"]["count"] * columns, view["byteOffset"]))
    assert (np.diff(parts[0].astype(int)) > 0).all()
    values = np.zeros((row["count"], 3))
    values[parts[0]] = parts[1].reshape(-1, 3)
    np.testing.assert_allclose([values.min(0), values.max(0)], [row["min"], row["max"]], rtol=1e-6)
    return values


@pytest.mark.parametrize("eyes", [False, True])
def test_actions_are_named_morph_targets(tmp_path, eyes):
    """Corner by corner the offsets of the shapes, those of the in-between what it adds to the straight way."""
    surface = toy_eyed_surface()
    mesh, balls = (surface.mesh, eyeballs_of(surface)) if eyes else (toy_mesh(), ())
    actions, parts = with_normals(toy_actions(len(mesh.vertices)), mesh), head_parts(mesh, balls)
    write_glb(tmp_path / "a.glb", NAME, parts, toy_maps(), capture("head"), actions)
    write_glb(tmp_path / "b.glb", NAME, parts, toy_maps(), capture("head"))
    (content, binary), (plain, _) = chunks(tmp_path / "a.glb"), chunks(tmp_path / "b.glb")
    head = content["meshes"][0]
    assert head["extras"]["targetNames"] == ["jawOpen", "eyeBlinkLeft", "eyeBlinkLeft_50"]
    assert head["weights"] == [0.0, 0.0, 0.0]
    (primitive,) = head["primitives"]
    places = accessor(content, binary, primitive["attributes"]["POSITION"])
    jaw, blink = actions
    half = BlendShape("", blink.vertices, blink.between[0][1] - 0.5 * blink.offsets,
                      normals=blink.normals[1:] - 0.5 * blink.normals[:1])
    rest = mesh.vertices * 0.001
    own = {tuple(place): k for k, place in enumerate(rest.astype(np.float32))}
    vertex = [own[tuple(place)] for place in places]
    for shape, target in zip((jaw, blink, half), primitive["targets"], strict=True):
        expected = shape.applied(np.zeros_like(rest), 1.0)[vertex] * 0.001
        np.testing.assert_allclose(dense(content, binary, target["POSITION"]), expected, atol=1e-8)
        turned = replace(shape, offsets=shape.normals[0]).applied(np.zeros_like(rest), 1.0)[vertex]
        np.testing.assert_allclose(dense(content, binary, target["NORMAL"]), turned, atol=1e-6)
    assert "targets" not in plain["meshes"][0]["primitives"][0] and set(plain["meshes"][0]) == {"name", "primitives"}
    assert all("targets" not in each["primitives"][0] for each in content["meshes"][1:])


def test_names_and_bytes(file, tmp_path, moves):
    assert chunks(file)[0]["scenes"][0]["name"] == NAME
    write_glb(tmp_path / "again.glb", NAME, head_parts(toy_mesh()), toy_maps(), capture(moves))
    assert (tmp_path / "again.glb").read_bytes() == file.read_bytes()


def test_the_animation_blinks(tmp_path):
    """Blend weights of each frame; the in-between has all of its own where the eye is half shut."""
    mesh, left = toy_mesh(), np.linspace(0.0, 1.0, len(FRAMES))
    blinking = replace(capture("head"), action_weights={"eyeBlinkLeft": left})
    actions = with_normals(toy_actions(len(mesh.vertices)), mesh)
    write_glb(tmp_path / "a.glb", NAME, head_parts(mesh), toy_maps(), blinking, actions)
    write_glb(tmp_path / "b.glb", NAME, head_parts(mesh), toy_maps(), blinking)
    content, binary = chunks(tmp_path / "a.glb")
    animation = content["animations"][0]
    (channel,) = (row for row in animation["channels"] if row["target"]["path"] == "weights")
    assert channel["target"]["node"] == 0
    weights = accessor(content, binary, animation["samplers"][channel["sampler"]]["output"]).reshape(len(FRAMES), 3)
    np.testing.assert_allclose(weights, np.stack([0 * left, left, 1 - np.abs(2 * left - 1)], axis=1), atol=1e-6)
    assert glb_errors(tmp_path / "a.glb") == []
    without = chunks(tmp_path / "b.glb")[0]["animations"][0]
    assert all(row["target"]["path"] != "weights" for row in without["channels"])
