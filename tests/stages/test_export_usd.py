"""The exported files, read back by USD, OpenEXR and zip as another program would."""

import os
import re
import shutil
import zipfile

import cv2
import numpy as np
import OpenEXR
import OpenImageIO
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade
from toy_result import (
    CROP,
    CROP_SIZE,
    FRAMES,
    INTRINSICS,
    MAP_SIZE,
    RENDERED,
    SOURCE_SIZE,
    VIEW_SIZE,
    ToyJob,
    toy_maps,
    toy_mesh,
    toy_poses,
    write_toy_work,
)

from shared.errors import LimnError
from shared.geometry.mesh import Mesh, vertex_normals
from shared.geometry.mesh_checks import mesh_errors, mesh_warnings
from shared.geometry.transforms import project, world_from_head
from shared.imaging.color import encode_srgb
from shared.io.arrays import load_arrays, read_json
from shared.io.export_maps import DISPLACEMENT, HAIR_MAPS, MAPS, acescg_from_rec709, paste_crop
from shared.io.images import read_exr, read_png, write_exr, write_png
from shared.io.meshes import read_obj
from shared.io.usd import VARIANT_SET, VARIANT_STILL, prim_name
from shared.io.usd_capture import BallLamp, UsdCapture, define_camera, define_dome_light, define_lamp
from shared.io.usd_detail import DETAIL_SET, FULL
from shared.io.usd_material import LOOK_SET, TextureFile, modulated_ior
from shared.io.usd_validate import package_errors, usd_errors
from shared.io.usdz import write_usdz
from shared.rendering.studio_lights import STUDIO_LIGHTS
from shared.rendering.view_set import NOVEL_VIEWS
from stages import export_usd

NAME = '1st "Zoë" <take> / été'


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """The folders of the stages before, once with a turning head and once with a moving camera."""
    base = tmp_path_factory.mktemp("toy")
    return {moves: write_toy_work(base / moves, moves) for moves in ("head", "camera")}


@pytest.fixture(scope="module")
def exported(work, tmp_path_factory):
    """{moves: published folder}, both exported under a difficult name."""
    folders = {}
    for moves, folder in work.items():
        job = ToyJob(folder, tmp_path_factory.mktemp(moves) / "export", NAME)
        export_usd.run(job)
        export_usd.check(job)
        folders[moves] = job.out
    return folders


@pytest.fixture
def stage(exported):
    """The exported layer of the turning head, opened."""
    return Usd.Stage.Open(str(exported["head"] / "head.usda"))


def shader(stage, name):
    """A shader of the one material."""
    return UsdShade.Shader(stage.GetDefaultPrim().GetPrimAtPath(f"mtl/skin/{name}"))


@pytest.mark.parametrize(("name", "expected"), [
    ("anna", "anna"), ("Zoë's  2nd take", "Zoe_s_2nd_take"), ("7up", "_7up"), ('a"b<c>/d\\e', "a_b_c_d_e"),
    ("été", "ete"), ("李", "head"), ("", "head"), ("../..", "head")])
def test_prim_name_is_valid_and_readable(name, expected):
    assert prim_name(name) == expected
    assert Sdf.Path.IsValidIdentifier(prim_name(name))


def test_every_file_of_the_contract_is_there(exported):
    files = {path.relative_to(exported["head"]).as_posix() for path in exported["head"].rglob("*") if path.is_file()}
    maps = {f"maps/{name}.exr" for name in MAPS if name not in (DISPLACEMENT, *HAIR_MAPS)}
    pictures = {f"renders/{frame:04d}.exr" for frame in RENDERED} | {f"plates/{frame:04d}.jpg" for frame in FRAMES}
    pictures |= {f"{folder}/{frame:04d}.exr" for frame in RENDERED for folder in ("layers", "patches")}
    pictures |= {f"views/novel_{name}.exr" for name in NOVEL_VIEWS}
    pictures |= {f"views/relit_{name}{kind}.exr" for kind in ("", "_light") for name in STUDIO_LIGHTS}
    layers = {"head.usda", "head_payload.usda", "head_geo.usdc", "head_mtl.usda", "head.usdz", "head.glb"}
    single = {"mesh.obj", "envmap.exr", "poses.npz", "run.json", "report.html", "methods.txt"}
    assert files == maps | pictures | layers | single
    assert all(export_usd.STAGE.output_of(file) for file in files)


def test_layer_says_what_studios_ask_for(stage):
    root = stage.GetDefaultPrim()
    assert root.GetName() == "_1st_Zoe_take_ete" and root.GetDisplayName() == NAME
    assert Usd.ModelAPI(root).GetKind() == "component"
    assert Usd.ModelAPI(root).GetAssetInfo()["identifier"].path == "./head.usda"
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 0.001
    assert stage.GetTimeCodesPerSecond() == 25.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (FRAMES[0], FRAMES[-1])
    assert root.GetPrimAtPath("geo").IsA(UsdGeom.Scope) and root.GetPrimAtPath("mtl").IsA(UsdGeom.Scope)
    assert root.GetInherits().GetAllDirectInherits() == [Sdf.Path("/__class__/_1st_Zoe_take_ete")]
    facts = root.GetCustomDataByKey("limn")
    assert facts["subject"] == NAME and facts["clip"]["name"] == 'a "clip".mp4'


def test_interface_stands_without_its_payload(exported):
    """Unloaded, the asset still has its place, its extents over the whole motion, camera, light and motion."""
    path = str(exported["head"] / "head.usda")
    unloaded, loaded = Usd.Stage.Open(path, Usd.Stage.LoadNone), Usd.Stage.Open(path)
    root = unloaded.GetDefaultPrim()
    assert not root.GetPrimAtPath("geo/head").IsA(UsdGeom.Mesh) and root.GetPrimAtPath("capture/camera")
    assert [asset.path for asset in Usd.ModelAPI(root).GetPayloadAssetDependencies()] == ["./head_payload.usda"]
    low, high = np.array(UsdGeom.ModelAPI(root).GetExtentsHint())
    mesh = UsdGeom.Imageable(loaded.GetDefaultPrim().GetPrimAtPath("geo/head"))
    for frame in FRAMES:
        world_from_head = np.array(mesh.ComputeLocalToWorldTransform(float(frame))).T
        moved = toy_mesh().vertices @ world_from_head[:3, :3].T + world_from_head[:3, 3]
        assert (moved >= low - 1e-3).all() and (moved <= high + 1e-3).all()
    assert (high - low < 2.0 * np.ptp(toy_mesh().vertices, axis=0)).all()


@pytest.mark.parametrize("moves", ["head", "camera"])
def test_plate_fills_the_crop_in_the_cameras_view(exported, moves):
    """The clip's card projects onto the crop's rectangle in every frame, behind the head, and shows that frame."""
    stage = Usd.Stage.Open(str(exported[moves] / "head.usda"))
    root = stage.GetDefaultPrim()
    card, camera = UsdGeom.Mesh(root.GetPrimAtPath("capture/plate/card")), root.GetPrimAtPath("capture/camera")
    assert UsdGeom.Imageable(card).ComputePurpose() == "guide"
    x0, y0, scale = CROP
    edges = [[x0, y0 + CROP_SIZE[1] / scale], [x0 + CROP_SIZE[0] / scale, y0]]
    picture = UsdShade.Shader(root.GetPrimAtPath("capture/plate/material/picture"))
    assert picture.GetInput("file").Get().path == f"./plates/{FRAMES[0]:04d}.jpg"
    for frame in FRAMES:
        frustum = UsdGeom.Camera(camera).GetCamera(float(frame)).frustum
        world = UsdGeom.Imageable(card).ComputeLocalToWorldTransform(float(frame))
        clip_from_card = world * frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        seen = np.array([clip_from_card.Transform(Gf.Vec3d(*point)) for point in card.GetPointsAttr().Get()])
        pixels = (seen[:, :2] * [0.5, -0.5] + 0.5) * SOURCE_SIZE
        np.testing.assert_allclose(pixels[[0, 2]], edges, atol=1e-2)
        file = picture.GetInput("file").Get(float(frame)).path
        assert file == f"./plates/{frame:04d}.jpg" and (exported[moves] / file).is_file()


def test_plates_show_the_frames(exported, work):
    """8-bit sRGB crops, here the clip's own codes but for the JPEG's loss."""
    place = list(FRAMES).index(8)
    clip = read_png(work["head"] / "sample_frames" / "frames" / f"{place:06d}.png")
    plate = cv2.imread(str(exported["head"] / "plates" / "0008.jpg"))[..., ::-1]
    assert plate.shape == clip.shape
    smooth = [cv2.blur(picture, (9, 9)).astype(float) for picture in (plate, clip)]
    assert np.abs(smooth[0] - smooth[1]).mean() < 4.0


def test_mesh_reads_back(stage):
    mesh, prim = toy_mesh(), UsdGeom.Mesh(stage.GetDefaultPrim().GetPrimAtPath("geo/head"))
    np.testing.assert_array_equal(np.array(prim.GetPointsAttr().Get()), mesh.vertices.astype(np.float32))
    np.testing.assert_array_equal(np.array(prim.GetFaceVertexIndicesAttr().Get()), mesh.faces.ravel())
    assert prim.GetSubdivisionSchemeAttr().Get() == "none"
    uvs, normals = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st"), np.array(prim.GetNormalsAttr().Get())
    assert (uvs.GetInterpolation(), prim.GetNormalsInterpolation()) == ("faceVarying", "vertex")
    np.testing.assert_allclose(np.array(uvs.ComputeFlattened()), mesh.uvs[mesh.face_uvs].reshape(-1, 2), atol=1e-7)
    np.testing.assert_allclose(normals, vertex_normals(mesh.vertices, mesh.faces), atol=1e-6)
    bounds = UsdGeom.Boundable(prim).GetExtentAttr().Get()
    np.testing.assert_allclose(np.array(bounds), [mesh.vertices.min(0), mesh.vertices.max(0)], atol=1e-4)


@pytest.mark.parametrize("moves", ["head", "camera"])
def test_camera_sees_what_the_clip_saw(exported, moves):
    """USD's own camera mathematics puts every vertex on the pixel that the poses and intrinsics give."""
    stage = Usd.Stage.Open(str(exported[moves] / "head.usda"))
    root, points = stage.GetDefaultPrim(), toy_mesh().vertices[::7]
    camera, mesh = UsdGeom.Camera(root.GetPrimAtPath("capture/camera")), UsdGeom.Mesh(root.GetPrimAtPath("geo/head"))
    for frame, pose in zip(FRAMES, toy_poses(), strict=True):
        frustum = camera.GetCamera(float(frame)).frustum
        world_from_head = UsdGeom.Imageable(mesh).ComputeLocalToWorldTransform(float(frame))
        clip_from_head = world_from_head * frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        seen = np.array([clip_from_head.Transform(Gf.Vec3d(*point)) for point in points.tolist()])
        pixels = (seen[:, :2] * [0.5, -0.5] + 0.5) * SOURCE_SIZE
        np.testing.assert_allclose(pixels, project(points, pose, INTRINSICS)[0], atol=1e-3)


def test_lens_in_tenths_of_a_millimetre(stage):
    camera = UsdGeom.Camera(stage.GetDefaultPrim().GetPrimAtPath("capture/camera"))
    assert camera.GetHorizontalApertureAttr().Get() == pytest.approx(223.0)
    focal_mm = INTRINSICS[0, 0] * 22.3 / SOURCE_SIZE[0]
    assert camera.GetFocalLengthAttr().Get() == pytest.approx(10.0 * focal_mm)


@pytest.mark.parametrize("moves", ["head", "camera"])
def test_light_stands_still_while_the_head_turns(exported, moves):
    stage = Usd.Stage.Open(str(exported[moves] / "head.usda"))
    light = UsdLux.DomeLight(stage.GetDefaultPrim().GetPrimAtPath("capture/light"))
    mesh = UsdGeom.Imageable(stage.GetDefaultPrim().GetPrimAtPath("geo/head"))
    assert light.GetTextureFormatAttr().Get() == "latlong" and light.GetIntensityAttr().Get() == 1.0
    assert light.GetTextureFileAttr().Get().path == "./envmap.exr"
    for frame, expected in zip(FRAMES, world_from_head(toy_poses(), moves), strict=True):
        assert light.ComputeLocalToWorldTransform(float(frame)) == Gf.Matrix4d(1.0)
        turned = np.array(mesh.ComputeLocalToWorldTransform(float(frame))).T[:3, :3]
        np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_a_lamp_at_the_camera_goes_with_it():
    capture = UsdCapture(toy_poses(), FRAMES, 25.0, INTRINSICS, *SOURCE_SIZE, "camera", light_with_camera=True)
    stage = Usd.Stage.CreateInMemory()
    light = define_dome_light(stage, "/light", TextureFile("./envmap.exr"), capture)
    camera = define_camera(stage, "/camera", capture)
    for frame in FRAMES:
        first, second = (prim.ComputeLocalToWorldTransform(float(frame)) for prim in (light, camera))
        np.testing.assert_allclose(np.array(first)[:3, :3], np.array(second)[:3, :3], atol=1e-12)
    assert not np.allclose(np.array(first)[:3, :3], np.eye(3), atol=0.01)


def test_a_near_lamp_stands_at_its_place():
    """As a ball whose colour times intensity is its radiance; with the camera, where that carries it."""
    lamp = BallLamp((-500.0, 160.0, -700.0), 35.0, (8.0, 4.0, 2.0))
    for with_camera in (False, True):
        moves = "camera" if with_camera else "head"
        capture = UsdCapture(toy_poses(), FRAMES, 25.0, INTRINSICS, *SOURCE_SIZE, moves, light_with_camera=with_camera)
        stage = Usd.Stage.CreateInMemory()
        light, camera = define_lamp(stage, "/lamp", lamp, capture), define_camera(stage, "/camera", capture)
        assert light.GetRadiusAttr().Get() == 35.0
        radiance = np.array(light.GetColorAttr().Get()) * light.GetIntensityAttr().Get()
        np.testing.assert_allclose(radiance, lamp.radiance, rtol=1e-6)
        for frame in FRAMES:
            place = np.array(light.ComputeLocalToWorldTransform(float(frame)))[3, :3]
            expected = np.array([*lamp.position, 1.0]) if with_camera else np.array(lamp.position)
            if with_camera:
                expected = (expected @ np.array(camera.ComputeLocalToWorldTransform(float(frame))))[:3]
            np.testing.assert_allclose(place, expected, atol=1e-9)


def test_solve_json_says_where_a_lamp_stands():
    said = {"near": True, "position_mm": [1.0, 2.0, 3.0], "radius_mm": 4.0, "radiance": [5.0, 6.0, 7.0]}
    assert export_usd.near_lamp({"lamp": said}) == BallLamp((1.0, 2.0, 3.0), 4.0, (5.0, 6.0, 7.0))
    assert export_usd.near_lamp({"lamp": {"near": False}}) is None and export_usd.near_lamp({}) is None


def test_dome_light_layout_is_that_of_the_environment_map():
    """OpenEXR: longitude +pi at the left edge; longitude 0 is +z, pi/2 is +x; latitude pi/2 (+y) on top."""
    u, v = np.random.default_rng(0).uniform(size=(2, 100))
    longitude, latitude = np.pi - 2 * np.pi * u, np.pi / 2 - np.pi * v
    across = np.cos(latitude)
    open_exr = np.stack([np.sin(longitude) * across, np.sin(latitude), np.cos(longitude) * across])
    ring = np.sin(np.pi * v)
    ours = np.stack([np.sin(2 * np.pi * u) * ring, np.cos(np.pi * v), -np.cos(2 * np.pi * u) * ring])
    np.testing.assert_allclose(ours, open_exr, atol=1e-12)


def test_motion_between_samples_stays_rigid(stage):
    mesh = UsdGeom.Imageable(stage.GetDefaultPrim().GetPrimAtPath("geo/head"))
    for time in np.linspace(FRAMES[0], FRAMES[-1], 23):
        rotation = np.array(mesh.ComputeLocalToWorldTransform(float(time)))[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_still_variant_is_the_head_alone(stage):
    root = stage.GetDefaultPrim()
    root.GetVariantSets().SetSelection(VARIANT_SET, VARIANT_STILL)
    assert not root.GetPrimAtPath("capture")
    mesh = UsdGeom.Imageable(root.GetPrimAtPath("geo/head"))
    assert mesh.ComputeLocalToWorldTransform(float(FRAMES[-1])) == Gf.Matrix4d(1.0)


def test_material_reads_the_maps(stage):
    material = UsdShade.MaterialBindingAPI(stage.GetDefaultPrim().GetPrimAtPath("geo/head")).ComputeBoundMaterial()[0]
    assert material.ComputeSurfaceSource()[0].GetShaderId() == "UsdPreviewSurface"
    assert material.ComputeSurfaceSource("mtlx")[0].GetShaderId() == "ND_open_pbr_surface_surfaceshader"
    for name in ("diffuse_albedo", "specular_ior", "roughness", "normal"):
        texture = shader(stage, f"preview_{name}")
        assert texture.GetInput("file").Get().path == f"./maps/{name}.exr"
        assert texture.GetInput("sourceColorSpace").Get() == "raw"
    assert shader(stage, "preview_normal").GetInput("scale").Get() == Gf.Vec4f(2, 2, 2, 1)
    assert shader(stage, "preview_normal").GetInput("bias").Get() == Gf.Vec4f(-1, -1, -1, 0)
    spaces = {name: shader(stage, f"openpbr_{name}").GetInput("file").GetAttr().GetColorSpace() for name in
              ("diffuse_albedo", "specular_intensity", "roughness", "normal")}
    assert spaces.pop("diffuse_albedo") == "lin_rec709_scene" and set(spaces.values()) == {"data"}


def test_both_materials_reflect_alike(stage, exported):
    """F0 is 0.04 times the specular intensity in either: OpenPBR by its weight, the preview by its index map."""
    surface = shader(stage, "openpbr_surface")
    ior = surface.GetInput("specular_ior").Get()
    assert ((ior - 1) / (ior + 1)) ** 2 == pytest.approx(0.04)
    intensity = np.array([0.0, 0.3, 1.0, 2.0])
    index = modulated_ior(intensity)
    np.testing.assert_allclose(((index - 1) / (index + 1)) ** 2, 0.04 * intensity, rtol=1e-5, atol=1e-12)
    written = read_exr(exported["head"] / "maps" / "specular_ior.exr")
    np.testing.assert_allclose(written, modulated_ior(toy_maps()["specular_intensity"]), atol=1e-3)


def test_asset_passes_all_validators(exported):
    for folder in exported.values():
        assert usd_errors(folder / "head.usda") == []
        assert usd_errors(folder / "head.usdz") == []


def break_index(stage):
    attribute = UsdGeom.Mesh(stage.GetDefaultPrim().GetPrimAtPath("geo/head")).GetFaceVertexIndicesAttr()
    attribute.Set([*attribute.Get()][:-1] + [99999])


def break_uvs(stage):
    primvar = UsdGeom.PrimvarsAPI(stage.GetDefaultPrim().GetPrimAtPath("geo/head")).GetPrimvar("st")
    primvar.Set([uv * 1.5 for uv in primvar.Get()])


DAMAGES = {
    "point outside of their array": break_index,
    "leave the unit square": break_uvs,
    "do not decode a normal map": lambda stage: shader(stage, "preview_normal").GetInput("scale").GetAttr().Block(),
    "knows no node ND_image_flaot": lambda stage: shader(stage, "openpbr_roughness").CreateIdAttr("ND_image_flaot"),
    "no such port": lambda stage: shader(stage, "openpbr_surface").CreateInput(
        "specular_wieght", Sdf.ValueTypeNames.Float),
    "is not relative": lambda stage: shader(stage, "preview_roughness").GetInput("file").Set(
        Sdf.AssetPath(os.path.abspath("roughness.exr"))),
    "metersPerUnit": lambda stage: stage.ClearMetadata("metersPerUnit"),
}


@pytest.mark.parametrize("words", DAMAGES)
def test_damaged_assets_are_told(exported, tmp_path, words):
    stage = Usd.Stage.Open(str(exported["head"] / "head.usda"), Usd.Stage.LoadAll)
    DAMAGES[words](stage)
    for name in ("maps", "plates", "envmap.exr", "head_payload.usda", "head_geo.usdc", "head_mtl.usda"):
        (tmp_path / name).symlink_to(exported["head"] / name)
    stage.GetRootLayer().Export(str(tmp_path / "head.usda"))
    stage.Reload()
    assert any(words in error for error in usd_errors(tmp_path / "head.usda"))


def test_usdz_is_stored_and_aligned(exported):
    package = exported["head"] / "head.usdz"
    with zipfile.ZipFile(package) as archive:
        members = archive.infolist()
        used = {"diffuse_albedo.png", "roughness.png", "normal.png", "specular_intensity.exr", "specular_ior.exr"}
        assert members[0].filename == "head.usdc"
        assert {member.filename for member in members[1:]} == {f"maps/{name}" for name in used} | {"envmap.exr"}
        for member in members:
            assert member.compress_type == zipfile.ZIP_STORED
            content = archive.read(member)
            assert package.read_bytes().index(content) % 64 == 0


def test_usdz_holds_the_same_asset(exported):
    """One layer with all variants but the full mesh, the same reduced mesh, motion, camera and light; textures within
    8-bit coding."""
    whole, packed = (Usd.Stage.Open(str(exported["head"] / name)) for name in ("head.usda", "head.usdz"))
    levels = packed.GetDefaultPrim().GetVariantSet(DETAIL_SET)
    assert (levels.GetVariantSelection(), levels.GetVariantNames()) == ("20k", ["20k", "5k"])
    whole.SetEditTarget(whole.GetSessionLayer())
    assert whole.GetDefaultPrim().GetVariantSet(DETAIL_SET).SetVariantSelection("20k")
    assert len(packed.GetLayerStack(includeSessionLayers=False)) == 1 and len(packed.GetUsedLayers()) <= 2
    for name in ("geo/head", "capture/camera", "capture/light", "mtl/skin/openpbr_surface"):
        first, second = (stage.GetDefaultPrim().GetPrimAtPath(name) for stage in (whole, packed))
        assert first.GetTypeName() == second.GetTypeName() != ""
        for attribute in first.GetAuthoredAttributes():
            other = second.GetAttribute(attribute.GetName())
            if attribute.GetTypeName() != Sdf.ValueTypeNames.Asset:
                assert attribute.Get(float(FRAMES[2])) == other.Get(float(FRAMES[2])), attribute.GetPath()
    assert set(packed.GetDefaultPrim().GetVariantSets().GetNames()) == {VARIANT_SET, DETAIL_SET, LOOK_SET}
    assert shader(packed, "preview_diffuse_albedo").GetInput("sourceColorSpace").Get() == "sRGB"
    with zipfile.ZipFile(exported["head"] / "head.usdz") as archive:
        codes = cv2.imdecode(np.frombuffer(archive.read("maps/diffuse_albedo.png"), np.uint8), cv2.IMREAD_UNCHANGED)
    coded = encode_srgb(toy_maps()["diffuse_albedo"])
    np.testing.assert_allclose(codes[..., ::-1] / 255.0, coded, atol=0.5 / 255 + 1e-6)


def test_package_rules_are_checked(exported, tmp_path):
    assert package_errors(exported["head"] / "head.usdz") == []
    write_usdz(tmp_path / "text.usdz", exported["head"] / "head.usda")
    found = " ".join(package_errors(tmp_path / "text.usdz"))
    assert "expected one .usdc" in found and "diffuse_albedo.exr is no PNG" in found


def test_usdz_refuses_a_missing_texture(exported, tmp_path):
    (tmp_path / "head_mtl.usda").write_bytes((exported["head"] / "head_mtl.usda").read_bytes())
    with pytest.raises(LimnError, match="missing"):
        write_usdz(tmp_path / "head.usdz", tmp_path / "head_mtl.usda")


def test_maps_keep_values_and_say_what_they_are(exported):
    for name, values in toy_maps().items():
        path = exported["head"] / "maps" / f"{name}.exr"
        np.testing.assert_allclose(read_exr(path), values, rtol=1e-3)
        with OpenEXR.File(str(path)) as file:  # closing it empties the header
            header, channel = dict(file.header()), next(iter(file.channels().values()))
        assert channel.pixels.dtype == np.float16
        assert header["colorInteropID"] == ("lin_rec709_scene" if name == "diffuse_albedo" else "data")
        assert header["limn:stage"] == "export_usd" and header["limn:stage_version"] == export_usd.STAGE.version
        assert header["limn:unit"] and header["limn:content"] == name and header["limn:source"] == "inverse_render"
        assert ("chromaticities" in header) == (name == "diffuse_albedo")
    with OpenEXR.File(str(exported["head"] / "envmap.exr")) as file:
        assert file.header()["envmap"] == OpenEXR.ENVMAP_LATLONG


def test_udim_names(work, tmp_path):
    """Maps are named as tile 1001, the materials read that tile, and the asset still validates."""
    job = ToyJob(work["head"], tmp_path / "export", udim=True, map_layout="mipmap")
    export_usd.run(job)
    export_usd.check(job)
    assert {path.name for path in (job.out / "maps").iterdir()} == {
        f"{name}.1001.exr" for name in MAPS if name not in (DISPLACEMENT, *HAIR_MAPS)}
    stage = Usd.Stage.Open(str(job.out / "head.usda"))
    for name in ("preview_diffuse_albedo", "openpbr_diffuse_albedo"):
        assert shader(stage, name).GetInput("file").Get().path == "./maps/diffuse_albedo.1001.exr"
    assert OpenImageIO.ImageBuf(str(job.out / "maps" / "normal.1001.exr")).nmiplevels == 5


def test_choices_of_format(work, tmp_path):
    options = {"map_format": "float", "acescg": True, "png_copies": "16", "usdz": False, "glb": False}
    options |= {"plates": False, "views": False}
    job = ToyJob(work["head"], tmp_path / "export", **options)
    export_usd.run(job)
    export_usd.check(job)
    assert not any((job.out / name).exists() for name in ("head.usdz", "head.glb", "plates", "views"))
    assert not Usd.Stage.Open(str(job.out / "head.usda")).GetDefaultPrim().GetPrimAtPath("capture/plate")
    albedo = toy_maps()["diffuse_albedo"]
    np.testing.assert_allclose(read_exr(job.out / "maps" / "diffuse_albedo.exr"), acescg_from_rec709(albedo), atol=1e-6)
    np.testing.assert_array_equal(read_exr(job.out / "maps" / "roughness.exr"), toy_maps()["roughness"])
    with OpenEXR.File(str(job.out / "maps" / "diffuse_albedo.exr")) as file:
        assert file.header()["colorInteropID"] == "lin_ap1_scene"
    stage = Usd.Stage.Open(str(job.out / "head.usda"))
    assert shader(stage, "preview_diffuse_albedo").GetInput("file").GetAttr().GetColorSpace() == "lin_ap1_scene"
    copy = read_png(job.out / "maps" / "png" / "confidence.png")
    assert copy.dtype == np.uint16
    np.testing.assert_allclose(copy / 65535.0, toy_maps()["confidence"], atol=1e-5)


def test_renders_fill_the_source_frame(exported):
    render = read_exr(exported["head"] / "renders" / f"{RENDERED[1]:04d}.exr")
    assert render.shape == (SOURCE_SIZE[1], SOURCE_SIZE[0], 3)
    x0, y0, scale = CROP
    rows, columns = np.nonzero(render[..., 0] > 0.2)
    edges = [columns.min(), columns.max() + 1, rows.min(), rows.max() + 1]
    np.testing.assert_allclose(edges, [20 / scale + x0, 70 / scale + x0, 20 / scale + y0, 60 / scale + y0], atol=1.0)


def test_renders_are_the_solved_ones_without_alpha(exported, work):
    for frame in RENDERED:
        with OpenEXR.File(str(exported["head"] / "renders" / f"{frame:04d}.exr")) as file:
            (found,) = (channel.pixels for name, channel in file.channels().items() if name == "RGB")
        crop = read_exr(work["head"] / "inverse_render" / "renders" / f"{frame:06d}.exr")
        np.testing.assert_array_equal(found, paste_crop(crop, CROP, SOURCE_SIZE).astype(np.float16))


def test_layers_are_premultiplied(exported):
    """Where there is alpha, colours over it are those of the re-render; patches lie in the same frame."""
    for frame in RENDERED:
        paths = [exported["head"] / folder / f"{frame:04d}.exr" for folder in ("layers", "patches")]
        for path in paths:
            with OpenEXR.File(str(path)) as file:
                assert file.header()["limn:alpha"] == "premultiplied"
        layer, patch = (OpenEXR.File(str(path)).channels()["RGBA"].pixels.astype(np.float32) for path in paths)
        assert layer.shape == patch.shape == (SOURCE_SIZE[1], SOURCE_SIZE[0], 4)
        some = layer[..., 3] > 0.1
        assert some.any() and layer[..., 3].max() <= 1.0 and layer[..., 3].min() == 0.0
        expected = np.broadcast_to(np.float32([0.4, 0.3, 0.25]), (np.count_nonzero(some), 3))
        np.testing.assert_allclose(layer[some][:, :3] / layer[some][:, 3:], expected, rtol=0.01)
        assert layer[layer[..., 3] == 0.0].max() == 0.0


def test_masks_of_something_else_are_warned_of(work, tmp_path):
    """Then alpha is the mesh's alone, here up to the re-render's straight border, and the frame stays as it is."""
    other = shutil.copytree(work["head"], tmp_path / "work")
    for path in (other / "sample_frames" / "masks").iterdir():
        write_png(path, np.zeros(CROP_SIZE[::-1], np.uint8))
    job = ToyJob(other, tmp_path / "export", views=False, usdz=False, glb=False)
    export_usd.run(job)
    texts = [row["text"] for row in read_json(job.out / "run.json")["warnings"] if row["stage"] == "export_usd"]
    assert any("person masks miss" in text and "in 3 of 3" in text for text in texts) and set(texts) <= {*job.warnings}
    layer, patch = (OpenEXR.File(str(job.out / folder / f"{RENDERED[0]:04d}.exr")).channels()["RGBA"].pixels
                    for folder in ("layers", "patches"))
    assert patch.max() == 0.0 and layer[..., 3].max() == 1.0


def test_views_are_files(exported):
    """Each picture shows the head before black; the relit ones differ by their light alone."""
    folder = exported["head"] / "views"
    pictures = {path.stem: read_exr(path) for path in folder.glob("*.exr")}
    for name, picture in pictures.items():
        assert np.isfinite(picture).all() and picture.max() > 0.05, name
        if not name.endswith("light"):
            assert picture.shape == (VIEW_SIZE, VIEW_SIZE, 3) and picture[0, 0].max() == 0.0
    covered = [(pictures[f"relit_{name}"] > 0).any(-1) for name in STUDIO_LIGHTS]
    assert all((mask == covered[0]).mean() > 0.99 for mask in covered)
    left, right = (pictures["relit_low_sun"][:, part].sum() for part in (slice(0, 32), slice(32, 64)))
    assert right > 1.3 * left


def test_obj_and_poses_read_back(exported):
    mesh, back = toy_mesh(), read_obj(exported["head"] / "mesh.obj")
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-4)
    np.testing.assert_allclose(back.uvs, mesh.uvs, atol=1e-6)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    poses = load_arrays(exported["head"] / "poses.npz")
    np.testing.assert_array_equal(poses["camera_from_head"], toy_poses())
    np.testing.assert_array_equal(poses["frame_index"], FRAMES)
    np.testing.assert_array_equal(poses["intrinsics"], INTRINSICS)


def test_run_record(exported):
    record = read_json(exported["head"] / "run.json")
    assert record["subject"] == NAME and set(record["stages"]) == {*export_usd.STAGE.inputs, "export_usd"}
    assert record["stages"]["inverse_render"]["wall_s"] == 1.5
    assert record["stages"]["sample_frames"]["parameters"] == {"size": 64}
    assert record["residuals"]["held_out"] == 0.023 and record["model"]["light"] == "cubemap 16"
    assert {"stage": "sample_frames", "text": "the focal length is not given"} in record["warnings"]


def test_same_input_same_bytes(exported, work, tmp_path):
    job = ToyJob(work["head"], tmp_path / "export", NAME)
    export_usd.run(job)
    for path in sorted(job.out.rglob("*")):
        name = path.relative_to(job.out).as_posix()
        if path.is_file() and not export_usd.STAGE.output_of(name).volatile:
            assert path.read_bytes() == (exported["head"] / name).read_bytes(), name


def test_check_refuses_what_no_one_could_use(exported, work, tmp_path):
    job = ToyJob(work["head"], tmp_path / "export")
    export_usd.run(job)
    write_exr(job.out / "maps" / "roughness.exr", np.full((12, 12), 1.5), colour_space="data")
    with pytest.raises(LimnError, match="roughness.exr: 12 x 12 is not a square power of two.*values up to 1.5"):
        export_usd.check(job)
    assert MAP_SIZE & (MAP_SIZE - 1) == 0


def test_check_wants_the_files_that_are_switched_on(work, tmp_path):
    job = ToyJob(work["head"], tmp_path / "export", plates=False, views=False)
    export_usd.run(job)
    for name in ("head.usdz", "head.glb"):
        (job.out / name).unlink()
    with pytest.raises(LimnError, match="head.usdz: missing; head.glb: missing"):
        export_usd.check(job)


def test_check_notes_what_keeps_no_result_back(work, tmp_path, monkeypatch):
    """The toy's UVs are folded over; its log says so, and the result is published."""
    job, notes = ToyJob(work["head"], tmp_path / "export", plates=False, views=False), []
    monkeypatch.setattr(job, "note", notes.append)
    export_usd.run(job)
    export_usd.check(job)
    (note,) = notes
    assert re.match(r"mesh.obj: several faces cover [\d.]+% of the texels, .*lay out the UVs", note)


def test_mesh_errors_and_warnings():
    mesh = toy_mesh()
    assert mesh_errors(mesh) == [] and mesh_warnings(mesh) == []
    assert "point outside" in mesh_errors(mesh.replace(faces=mesh.faces + 1))[0]
    assert "not finite" in mesh_errors(mesh.replace(vertices=mesh.vertices * np.nan))[0]
    assert "unit square" in mesh_errors(mesh.replace(uvs=mesh.uvs - 0.5))[0]
    assert "have no area" in mesh_errors(mesh.replace(vertices=mesh.vertices * [1.0, 0.0, 0.0]))[0]
    tripled = Mesh(mesh.vertices, np.repeat(mesh.faces, 3, axis=0), mesh.uvs, np.repeat(mesh.face_uvs, 3, axis=0))
    assert "more than two faces" in mesh_warnings(tripled)[0]
    turned = mesh.faces.copy()
    turned[0] = turned[0, ::-1]
    assert mesh_warnings(mesh.replace(faces=turned)) == ["3 edges join faces of opposite winding"]


def test_capture_without_a_lens_assumes_full_frame():
    capture = UsdCapture(toy_poses(), FRAMES, 25.0, INTRINSICS, *SOURCE_SIZE, "head")
    assert capture.film_width_mm == 36.0


def test_levels_of_detail_can_be_left_out(work, exported, tmp_path):
    """Nothing else changes: the meshes that are chosen and the page are the same."""
    job = ToyJob(work["head"], tmp_path / "plain", NAME, detail=False, plates=False, views=False)
    export_usd.run(job)
    export_usd.check(job)
    for name, chosen in (("head.usda", FULL), ("head.usdz", "20k")):
        plain, whole = (Usd.Stage.Open(str(folder / name)) for folder in (job.out, exported["head"]))
        assert set(plain.GetDefaultPrim().GetVariantSets().GetNames()) == {VARIANT_SET, LOOK_SET}
        assert whole.GetDefaultPrim().GetVariantSet(DETAIL_SET).GetVariantSelection() == chosen
        points = [UsdGeom.Mesh(stage.GetDefaultPrim().GetPrimAtPath("geo/head")).GetPointsAttr().Get()
                  for stage in (plain, whole)]
        assert points[0] == points[1] and len(points[0]) == len(toy_mesh().vertices)
