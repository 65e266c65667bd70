"""Hair that stands off the head in the exported asset, read back as other programs would."""

import io
import json
import re
import struct
import zipfile

import cv2
import numpy as np
import pytest
import trimesh
from field_check import field_faults
from opened_asset import opened_root, placed
from pxr import Usd, UsdGeom, UsdShade
from toy_result import FRAMES, HAIR_RECORD, MAP_SIZE, ToyJob, toy_hair, toy_mesh, toy_poses, write_toy_work

from shared.contract.records import RUN
from shared.geometry.mesh import vertex_normals
from shared.imaging.color import encode_srgb
from shared.io.arrays import read_json
from shared.io.export_checks import check_export
from shared.io.images import read_exr, read_png
from shared.io.meshes import read_obj
from shared.io.usd import VARIANT_SET, VARIANT_STILL
from shared.io.usd_detail import DETAIL_SET
from shared.report.references import REFERENCES
from stages import export_usd

FILES = ("head.usda", "head.usdz")
KINDS = {"head": (False, "Xform"), "camera": (False, "Xform"), "eyes": (True, "Xform")}


@pytest.fixture(scope="module", params=KINDS)
def exported(request, tmp_path_factory):
    """(what it is of, the export of a head with hair), validated: the head moves, the camera does, or there are eyes
    that turn, too."""
    base = tmp_path_factory.mktemp(f"hair_{request.param}")
    moves = "camera" if request.param == "camera" else "head"
    job = ToyJob(write_toy_work(base / "work", moves, eyes=KINDS[request.param][0], hair=True), base / "export",
                 plates=False, png_copies="8")
    export_usd.run(job)
    export_usd.check(job)
    return request.param, job.out


@pytest.fixture(params=FILES)
def opened(request, exported):
    """(what it is of, the root prim of either file), its stage kept open."""
    for root in opened_root(exported[1] / request.param):
        yield exported[0], root


def world_from_head(kind, f):
    return np.eye(4) if kind == "camera" else np.diag([1.0, -1.0, -1.0, 1.0]) @ toy_poses()[f]


def test_it_is_a_mesh_of_its_own_in_every_variant(opened):
    kind, root = opened
    assert root.GetPrimAtPath("geo").GetTypeName() == KINDS[kind][1]
    mesh, details = toy_hair().mesh, root.GetVariantSet(DETAIL_SET)
    for level in details.GetVariantNames():
        details.SetVariantSelection(level)
        prim = UsdGeom.Mesh(root.GetPrimAtPath("geo/hair"))
        faces = np.array(prim.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        np.testing.assert_array_equal(faces, mesh.faces)
        np.testing.assert_allclose(prim.GetPointsAttr().Get(), mesh.vertices, atol=1e-4)
        np.testing.assert_allclose(prim.GetNormalsAttr().Get(), vertex_normals(mesh.vertices, mesh.faces), atol=1e-5)
        st = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").ComputeFlattened())
        np.testing.assert_allclose(st, mesh.uvs[mesh.face_uvs.ravel()], atol=1e-6)
        assert prim.GetDoubleSidedAttr().Get() and not prim.GetPrim().HasAPI("SkelBindingAPI")


def test_it_goes_with_the_head(opened):
    kind, root = opened
    for f, frame in enumerate(FRAMES):
        for name in ("head", "hair"):
            np.testing.assert_allclose(placed(root, name, float(frame)), world_from_head(kind, f), atol=1e-9)
    root.GetVariantSet(VARIANT_SET).SetVariantSelection(VARIANT_STILL)
    np.testing.assert_allclose(placed(root, "hair", Usd.TimeCode.Default()), np.eye(4), atol=1e-12)


def test_extents_hold_it(exported):
    stage = Usd.Stage.Open(str(exported[1] / "head.usda"), Usd.Stage.LoadNone)
    low, high = np.array(UsdGeom.ModelAPI(stage.GetDefaultPrim()).GetExtentsHint())
    points = toy_hair().mesh.vertices
    for f in range(len(FRAMES)):
        transform = world_from_head(exported[0], f)
        moved = points @ transform[:3, :3].T + transform[:3, 3]
        assert (moved > low - 1e-3).all() and (moved < high + 1e-3).all()


def test_it_can_be_hidden_alone(opened):
    root = opened[1]
    root.GetStage().SetEditTarget(root.GetStage().GetSessionLayer())
    hair, head = (UsdGeom.Imageable(root.GetPrimAtPath(f"geo/{name}")) for name in ("hair", "head"))
    before = hair.ComputeVisibility()
    hair.GetVisibilityAttr().Set("invisible")
    assert (before, hair.ComputeVisibility(), head.ComputeVisibility()) == ("inherited", "invisible", "inherited")


def source(surface, name):
    (found,) = surface.GetInput(name).GetConnectedSources()[0]
    return found.sourceName, UsdShade.Shader(found.source.GetPrim()).GetInput("file").Get().path


def test_its_material_has_opacity_and_no_highlights(opened):
    root = opened[1]
    bound = [UsdShade.MaterialBindingAPI(root.GetPrimAtPath(f"geo/{name}")).ComputeBoundMaterial()[0].GetPath().name
             for name in ("head", "hair")]
    assert bound == ["skin", "hair"]
    preview, openpbr = (UsdShade.Shader(root.GetPrimAtPath(f"mtl/hair/{name}_surface")) for name in (
        "preview", "openpbr"))
    suffix = "png" if root.GetStage().GetRootLayer().realPath.endswith("usdz") else "exr"
    for surface, colour, opacity, outputs in (
            (preview, "diffuseColor", "opacity", ("rgb", "r")),
            (openpbr, "base_color", "geometry_opacity", ("out", "out"))):
        for port, name, output in ((colour, "hair_albedo", outputs[0]), (opacity, "hair_alpha", outputs[1])):
            assert source(surface, port) == (output, f"./maps/{name}.{suffix}") or source(
                surface, port)[1].endswith(f"[maps/{name}.{suffix}]")
    assert (preview.GetInput("ior").Get(), preview.GetInput("opacityThreshold").Get()) == (1.0, 0.0)
    assert openpbr.GetInput("specular_weight").Get() == 0.0
    skin = [UsdShade.Shader(root.GetPrimAtPath(f"mtl/skin/{name}_surface")) for name in ("preview", "openpbr")]
    assert not skin[0].GetInput("opacity") and not skin[1].GetInput("geometry_opacity")


def test_obj_and_maps_read_back(exported):
    folder, hair = exported[1], toy_hair()
    mesh = read_obj(folder / "hair.obj")
    np.testing.assert_array_equal(mesh.faces, hair.mesh.faces)
    np.testing.assert_allclose(mesh.vertices, hair.mesh.vertices, atol=1e-4)
    np.testing.assert_allclose(mesh.uvs[mesh.face_uvs], hair.mesh.uvs[hair.mesh.face_uvs], atol=1e-6)
    assert len(read_obj(folder / "mesh.obj").faces) >= len(toy_mesh().faces)
    for name, values in (("hair_albedo", hair.albedo), ("hair_alpha", hair.alpha)):
        np.testing.assert_allclose(read_exr(folder / "maps" / f"{name}.exr"), values, atol=1e-3)
        coded = encode_srgb(values) if values.ndim == 3 else values
        np.testing.assert_allclose(read_png(folder / "maps" / "png" / f"{name}.png") / 255.0, coded, atol=0.51 / 255)
    assert export_usd.STAGE.output_of("hair.obj").optional


def test_the_package_has_its_alpha_in_eight_bits(exported):
    with zipfile.ZipFile(exported[1] / "head.usdz") as archive:
        picture = cv2.imdecode(np.frombuffer(archive.read("maps/hair_alpha.png"), np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint8 and picture.shape == (MAP_SIZE, MAP_SIZE)
    np.testing.assert_allclose(picture / 255.0, toy_hair().alpha, atol=0.51 / 255)


def glb_of(folder):
    data = (folder / "head.glb").read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20:20 + size]), data[28 + size:]


def test_gltf_has_a_node_below_the_head(exported):
    kind, folder = exported
    content, binary = glb_of(folder)
    names = [content["nodes"][k]["name"] for k in content["nodes"][0]["children"]]
    assert names == (["eye_right", "eye_left", "hair"] if kind == "eyes" else ["hair"])
    node = content["nodes"][content["nodes"][0]["children"][-1]]
    (primitive,) = content["meshes"][node["mesh"]]["primitives"]
    material = content["materials"][primitive["material"]]
    assert (node["name"], material["name"], material["doubleSided"]) == ("hair", "hair", True)
    assert (material["alphaMode"], material["alphaCutoff"]) == ("MASK", 0.5)
    assert material["extensions"]["KHR_materials_specular"]["specularFactor"] == 0.0
    texture = content["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
    view = content["bufferViews"][content["images"][texture["source"]]["bufferView"]]
    data = np.frombuffer(binary[view["byteOffset"]:view["byteOffset"] + view["byteLength"]], np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]] / 255.0
    hair = toy_hair()
    np.testing.assert_allclose(picture[..., :3], encode_srgb(hair.albedo), atol=0.51 / 255)
    np.testing.assert_allclose(picture[..., 3], hair.alpha, atol=0.51 / 255)
    scene = trimesh.load(io.BytesIO((folder / "head.glb").read_bytes()), file_type="glb")
    geometry = scene.geometry[scene.graph.get("hair")[1]]
    np.testing.assert_allclose(geometry.vertices[geometry.faces], hair.mesh.vertices[hair.mesh.faces] * 0.001,
                               atol=1e-6)


def test_pictures_show_it(exported, tmp_path):
    """From above, where the cap is, more of the picture is covered than without it, and its colour is there."""
    kind, folder = exported
    moves = "camera" if kind == "camera" else "head"
    bare = ToyJob(write_toy_work(tmp_path / "work", moves, eyes=KINDS[kind][0]), tmp_path / "export", usdz=False,
                  glb=False, plates=False)
    export_usd.run(bare)
    with_hair, without = (read_exr(out / "views" / "novel_above.exr") for out in (folder, bare.out))
    assert (with_hair > 0.0).any(-1).sum() != (without > 0.0).any(-1).sum()
    seen = np.median(with_hair[with_hair.max(-1) > 0.0], axis=0)
    assert seen.max() < 0.9 * np.median(without[without.max(-1) > 0.0], axis=0).max()  # its albedo is a third
    assert not (bare.out / "hair.obj").exists() and not list((bare.out / "maps").glob("hair_*"))
    assert "hair" not in read_json(bare.out / "run.json")
    stage = Usd.Stage.Open(str(bare.out / "head.usda"))
    assert not stage.GetDefaultPrim().GetPrimAtPath("geo/hair")


def test_records_and_page_tell_of_it(exported):
    folder = exported[1]
    run = read_json(folder / "run.json")
    assert run["hair"] == HAIR_RECORD
    assert [fault for fault in field_faults(run, RUN) if "hair" in fault] == []
    methods = " ".join((folder / "methods.txt").read_text().split())
    assert "14 mm (median) off the head" in methods
    assert all(REFERENCES[key] in methods for key in ("Laurentini1994", "He2013"))
    page = (folder / "report.html").read_text()
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S).group(1))
    hair = data["viewer"]["hair"]
    assert hair["mesh"]["count"] == 3 * len(toy_hair().mesh.faces)
    assert all(hair[name].startswith("data:image/jpeg") for name in ("albedo", "alpha"))
    assert 'id="viewer-hair"' in page and "<b>Hair</b>" in page


def test_checks_find_it_whole(exported):
    found = check_export(exported[1], expected=("head.usdz", "head.glb"))
    assert [fault for fault in found.faults if fault.fatal] == []
    assert f"hair of {len(toy_hair().mesh.faces)} faces" in found.facts
