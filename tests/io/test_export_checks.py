"""Every check of an export against one that breaks just it, and against exports that lack what may be lacking."""

import shutil

import numpy as np
import OpenEXR
import pytest
from pxr import Usd, UsdGeom
from shapes import turned
from toy_export import write_toy_export
from toy_result import MAP_SIZE, toy_hair

from shared.io.arrays import load_arrays, save_arrays
from shared.io.export_checks import check_export, rigid_motions
from shared.io.images import read_exr, write_exr
from shared.io.meshes import read_obj, write_obj

ATTRIBUTES = {"unit": "something", "content": "roughness"}


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return write_toy_export(tmp_path_factory.mktemp("checked"), plates=False, hair=True)


@pytest.fixture
def export(original, tmp_path):
    """A copy to be broken."""
    return shutil.copytree(original, tmp_path / "export")


def roughness(folder, values=None, colour_space="data", attributes=ATTRIBUTES, **options):
    values = np.full((MAP_SIZE, MAP_SIZE), 0.5) if values is None else values
    write_exr(folder / "maps" / "roughness.exr", values, colour_space=colour_space, attributes=attributes, **options)


def raw_exr(path, channels, **header):
    """An EXR as others may write it."""
    header |= {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def half(count=MAP_SIZE, channels=()):
    return np.full((count, count, *channels), 0.5, np.float16)


def displacement(folder, height):
    write_exr(folder / "maps" / "displacement.exr", np.full((4, 4), height), colour_space="data", half=False,
              attributes={"unit": "mm", "content": "displacement"})


def mesh(change):
    def plant(folder):
        write_obj(folder / "mesh.obj", change(read_obj(folder / "mesh.obj")))
    return plant


def hair(change):
    def plant(folder):
        write_obj(folder / "hair.obj", change(read_obj(folder / "hair.obj")))
    return plant


def alpha(values):
    def plant(folder):
        write_exr(folder / "maps" / "hair_alpha.exr", values, colour_space="data",
                  attributes={"unit": "x", "content": "hair_alpha"})
    return plant


def poses(**changes):
    def plant(folder):
        arrays = load_arrays(folder / "poses.npz")
        save_arrays(folder / "poses.npz", **arrays | {name: change(arrays[name]) for name, change in changes.items()})
    return plant


def mirrored(transforms):
    return transforms @ np.diag([1.0, 1.0, -1.0, 1.0])


def break_uvs(folder):
    layer = folder / "head_geo.usdc"
    stage = Usd.Stage.Open(str(layer))
    primvar = UsdGeom.PrimvarsAPI(stage.GetDefaultPrim().GetPrimAtPath("geo/head")).GetPrimvar("st")
    primvar.Set([uv * 2.5 for uv in primvar.Get()])
    stage.GetRootLayer().Export(str(folder / "new.usdc"))
    (folder / "new.usdc").replace(layer)
    stage.Reload()


def truncate(name, share=0.5):
    def plant(folder):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[:int(len(data) * share)])
    return plant


def remove(name):
    return lambda folder: (folder / name).unlink()


def negative_light(folder):
    values = read_exr(folder / "envmap.exr")
    values[3, 4] = -1.0
    write_exr(folder / "envmap.exr", values, colour_space="lin_rec709_scene", attributes=ATTRIBUTES, latlong=True)


def no_latlong(folder):
    write_exr(folder / "envmap.exr", np.ones((8, 8, 3)), colour_space="lin_rec709_scene", attributes=ATTRIBUTES)


def picture(file, channels):
    def plant(folder):
        (folder / file).parent.mkdir(exist_ok=True)
        write_exr(folder / file, half(channels=(channels,)), colour_space="lin_rec709_scene", attributes=ATTRIBUTES)
    return plant


def other_primaries(folder):
    stated = {"limn:unit": "x", "limn:content": "diffuse_albedo", "colorInteropID": "lin_rec709_scene"}
    raw_exr(folder / "maps" / "diffuse_albedo.exr", {"RGB": half(channels=(3,))},
            chromaticities=(0.7, 0.3, 0.2, 0.7, 0.1, 0.05, 0.31, 0.33), **stated)


def nan_map(folder):
    values = half()
    values[2, 3] = np.nan
    raw_exr(folder / "maps" / "roughness.exr", {"Y": values}, colorInteropID="data",
            **{"limn:unit": "x", "limn:content": "roughness"})


FAULTS = [
    ("maps/displacement.exr: values up to 12", lambda folder: displacement(folder, 12.0)),
    ("maps/displacement.exr: values down to -12", lambda folder: displacement(folder, -12.0)),
    ("mesh.obj: missing", remove("mesh.obj")),
    ("mesh.obj: UVs leave the unit square", mesh(lambda m: m.replace(uvs=m.uvs + 0.5))),
    ("mesh.obj: 2 mm is not the size of a head", mesh(lambda m: m.replace(vertices=m.vertices * 0.01))),
    ("mesh.obj: several faces cover", mesh(lambda m: m.replace(uvs=m.uvs * 0.0 + np.abs(m.uvs - 0.25)))),
    ("hair.obj: missing", remove("hair.obj")),
    ("hair.obj: UVs leave the unit square", hair(lambda m: m.replace(uvs=m.uvs + 0.5))),
    ("hair.obj: cannot be read: faces point outside", lambda folder: (folder / "hair.obj").write_text(
        "v 0 0 0\nvt 0 0\nf 1/1 2/1 3/1\n")),
    ("maps/hair_alpha.exr: missing", remove("maps/hair_alpha.exr")),
    ("maps/hair_albedo.exr: missing", remove("maps/hair_albedo.exr")),
    ("maps/hair_alpha.exr: values up to 1.5", alpha(np.full((16, 16), 1.5))),
    ("maps/hair_alpha.exr: 12 x 12 is not a square power of two", alpha(np.full((12, 12), 0.5))),
    ("maps/normal.exr: missing", remove("maps/normal.exr")),
    ("maps/roughness.exr: cannot be read", truncate("maps/roughness.exr", 0.1)),
    ("maps/roughness.exr: 12 x 12 is not a square power of two", lambda f: roughness(f, np.full((12, 12), 0.5))),
    ("maps/roughness.exr: 8 x 8, other maps 16 x 16", lambda f: roughness(f, np.full((8, 8), 0.5))),
    ("maps/roughness.exr: values up to 1.5", lambda f: roughness(f, np.full((16, 16), 1.5))),
    ("maps/roughness.exr: values down to -0.5", lambda f: roughness(f, np.full((16, 16), -0.5))),
    ("maps/roughness.exr: 1 values are not finite", nan_map),
    ("maps/roughness.exr: channels B, G, R, expected Y", lambda f: roughness(f, np.full((16, 16, 3), 0.5))),
    ("maps/roughness.exr: not all channels are floats", lambda f: raw_exr(
        f / "maps" / "roughness.exr", {"Y": np.zeros((16, 16), np.uint32)}, colorInteropID="data",
        **{"limn:unit": "x", "limn:content": "roughness"})),
    ("maps/roughness.exr: states the colour space lin_rec709_scene", lambda f: roughness(
        f, colour_space="lin_rec709_scene")),
    ("maps/roughness.exr: states the colour space srgb", lambda f: raw_exr(
        f / "maps" / "roughness.exr", {"Y": half()}, colorInteropID="srgb",
        **{"limn:unit": "x", "limn:content": "roughness"})),
    ("maps/roughness.exr: states normal as its content", lambda f: roughness(
        f, attributes={"unit": "x", "content": "normal"})),
    ("maps/roughness.exr: does not state limn:unit, limn:content", lambda f: roughness(f, attributes={})),
    ("maps/roughness.exr: does not state colorInteropID", lambda f: raw_exr(
        f / "maps" / "roughness.exr", {"Y": half()}, **{"limn:unit": "x", "limn:content": "roughness"})),
    ("maps/diffuse_albedo.exr: its chromaticities are not those of lin_rec709_scene", other_primaries),
    ("envmap.exr: radiance from -1", negative_light),
    ("envmap.exr: 8 x 8 of envmap None is no lat-long light", no_latlong),
    ("envmap.exr: does not state envmap", no_latlong),
    ("renders/0003.exr: channels A, B, G, R, expected R, G, B", picture("renders/0003.exr", 4)),
    ("layers/0003.exr: channels B, G, R, expected R, G, B, A", picture("layers/0003.exr", 3)),
    ("patches/0003.exr: channels B, G, R, expected R, G, B, A", picture("patches/0003.exr", 3)),
    ("poses.npz: not all poses are rigid: 5 of 5, the first in frame 3", poses(camera_from_head=lambda p: p * 1.01)),
    ("poses.npz: not all poses are rigid", poses(camera_from_head=mirrored)),
    ("poses.npz: camera_from_head is (4, 4, 4), expected (5, 4, 4)", poses(camera_from_head=lambda p: p[1:])),
    ("poses.npz: frame_index does not rise", poses(frame_index=lambda index: index[::-1].copy())),
    ("poses.npz: intrinsics are no lens", poses(intrinsics=lambda lens: -lens)),
    ("poses.npz: cannot be read", truncate("poses.npz")),
    ("head.usda: cannot be read", truncate("head.usda")),
    ("head.usda: /toy/geo/head: UVs leave the unit square", break_uvs),
    ("head.usda: missing", remove("head.usda")),
    ("head.usda: ", remove("head_mtl.usda")),
    ("head.usdz: cannot be read", truncate("head.usdz", 0.01)),
    ("head.glb: header: ", truncate("head.glb")),
]


def test_a_sound_export_has_no_faults(original):
    found = check_export(original, expected=("head.usdz", "head.glb"))
    assert found.faults == [] and found.unchecked == []
    assert found.facts == ["UV overlap 0.00%", f"hair of {len(toy_hair().mesh.faces)} faces", "7 maps of 16 px"]


@pytest.mark.parametrize(("words", "plant"), FAULTS, ids=[f"{k} {words}" for k, (words, _) in enumerate(FAULTS)])
def test_every_fault_is_named(export, words, plant):
    plant(export)
    found = [str(fault) for fault in check_export(export).faults]
    assert any(fault.startswith(words) for fault in found), found
    assert all("\n" not in fault for fault in found)


def test_a_displacement_need_not_have_the_size_of_the_other_maps(export):
    displacement(export, -3.0)
    assert check_export(export).faults == [] and (export / "maps" / "displacement.exr").is_file()


def test_maps_of_hair_need_not_have_the_size_of_the_other_maps(export):
    alpha(half(8))(export)
    assert check_export(export).faults == []


def test_only_overlap_is_no_reason_to_withhold_a_result(export):
    mesh(lambda m: m.replace(uvs=np.abs(m.uvs - 0.25)))(export)
    (fault,) = check_export(export).faults
    assert not fault.fatal and "lay out the UVs" in fault.hint


def test_what_is_switched_off_is_said_and_no_fault(export):
    for name in ("head.usdz", "head.glb"):
        (export / name).unlink()
    found = check_export(export)
    assert found.faults == []
    assert found.unchecked == ["head.usdz (not in this export)", "head.glb (not in this export)"]
    wanted = check_export(export, expected=("head.glb",))
    assert [str(fault) for fault in wanted.faults] == ["head.glb: missing"]


def test_what_older_versions_lack_is_said_and_no_fault(export):
    (export / "head.usdz").unlink()
    (export / "envmap.exr").unlink()
    roughness(export, attributes={})
    found = check_export(export, older=True)
    assert not [fault for fault in found.faults if fault.file != "head.usda"]  # its light names the file
    assert found.unchecked == ["limn:content, limn:unit of 1 EXR files (not stated)",
                               "envmap.exr (not in this export)", "head.usdz (not in this export)"]
    roughness(export, np.full((16, 16), 1.5), attributes={})
    assert "values up to 1.5" in " ".join(map(str, check_export(export, older=True).faults))


def test_damaged_files_stay_closed(export):
    """Neither they nor what uses them: a damaged layer could do more than be refused."""
    truncate("head_geo.usdc")(export)
    truncate("head.glb")(export)
    found = check_export(export, spoilt=("head_geo.usdc", "head.glb"))
    assert found.faults == []
    assert found.unchecked == ["head.usda (head_geo.usdc is not as published)",
                               "head.glb (not as published)"]


def test_rigid_motions():
    poses = turned(np.random.default_rng(2).normal(size=(4, 3)))
    assert rigid_motions(poses).all()
    broken = np.stack([poses[0] * [1, 1, 1, np.nan], mirrored(poses[1]), poses[2] + np.eye(4)[3], poses[3]])
    assert rigid_motions(broken).tolist() == [False, False, False, True]
    broken[3, 0, 0] = np.inf
    assert not rigid_motions(broken).any()


def test_usd_says_nothing_beside_the_sentences(export, capfd):
    (export / "maps" / "roughness.exr").unlink()
    assert any("roughness" in str(fault) for fault in check_export(export).faults if fault.file == "head.usda")
    assert capfd.readouterr() == ("", "")
