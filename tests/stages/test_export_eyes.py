"""Eyes in the exported asset, read back by USD as another program would."""

import numpy as np
import pytest
from field_check import field_faults
from opened_asset import opened_root, placed
from pxr import Gf, Usd, UsdGeom, UsdShade
from toy_result import EYE_CENTRES, FRAMES, ToyJob, toy_eyed_surface, toy_gaze, toy_poses, write_toy_work

from shared.contract.records import EXPORTED_POSES
from shared.geometry.eyeballs import eyeballs_of, gaze_rotation
from shared.geometry.mesh import vertex_normals
from shared.geometry.transforms import rigid
from shared.io.arrays import load_arrays, save_arrays
from shared.io.meshes import read_obj, read_obj_groups
from shared.io.usd import VARIANT_SET, VARIANT_STILL
from stages import export_usd

NAMES = ("eye_right", "eye_left")
FILES = ("head.usda", "head.usdz")
OPEN = np.isfinite(toy_gaze()).all((1, 2))


@pytest.fixture(scope="module", params=["head", "camera"])
def exported(request, tmp_path_factory):
    """(what moves, the export of a head with eyes whose gaze is known), validated."""
    base = tmp_path_factory.mktemp(f"eyes_{request.param}")
    job = ToyJob(write_toy_work(base / "work", request.param, eyes=True), base / "export")
    export_usd.run(job)
    export_usd.check(job)
    return request.param, job.out


@pytest.fixture(params=FILES)
def opened(request, exported):
    """(what moves, the root prim of either file), its stage kept open."""
    for root in opened_root(exported[1] / request.param):
        yield exported[0], root


def corners(root, name, time):
    """[3 m, 3] places of a part's corners in the asset's world, with their UVs and normals."""
    prim, transform = UsdGeom.Mesh(root.GetPrimAtPath(f"geo/{name}")), placed(root, name, time)
    points = np.array(prim.GetPointsAttr().Get(), np.float64) @ transform[:3, :3].T + transform[:3, 3]
    uvs, faces = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st"), np.array(prim.GetFaceVertexIndicesAttr().Get())
    return points[faces], np.array(uvs.ComputeFlattened()), np.array(prim.GetNormalsAttr().Get())[faces]


def test_parts_at_the_default_pose_are_the_mesh(opened):
    """Head and eyes, straight ahead, corner by corner: places, texture coordinates and normals of the one mesh."""
    surface = toy_eyed_surface()
    mesh, eyes = surface.mesh, eyeballs_of(surface)
    order = np.concatenate([np.nonzero(surface.face_segment == 0)[0], *(np.sort(eye.faces) for eye in eyes)])
    smooth = vertex_normals(mesh.vertices, mesh.faces)
    expected = mesh.vertices[mesh.faces], mesh.uvs[mesh.face_uvs], smooth[mesh.faces]
    found = zip(*(corners(opened[1], name, Usd.TimeCode.Default()) for name in ("head", *NAMES)), strict=True)
    for of_parts, of_mesh, tolerance in zip(found, expected, (1e-5, 1e-6, 1e-6), strict=True):
        np.testing.assert_allclose(np.concatenate(of_parts), of_mesh[order].reshape(-1, of_mesh.shape[-1]),
                                   atol=tolerance)


def test_eyes_turn_to_the_gaze_about_their_centres(opened):
    """In each frame: the head's motion, then the rotation of the gaze about the eyeball's centre."""
    moves, root = opened
    camera_turn = np.diag([1.0, -1.0, -1.0, 1.0])
    for k, name in enumerate(NAMES):
        for f in np.nonzero(OPEN)[0]:
            head = camera_turn @ toy_poses()[f] if moves == "head" else np.eye(4)
            expected = head @ rigid(gaze_rotation(toy_gaze()[f, k]), EYE_CENTRES[k])
            np.testing.assert_allclose(placed(root, name, float(FRAMES[f])), expected, atol=1e-5)
            np.testing.assert_allclose(placed(root, "head", float(FRAMES[f])), head, atol=1e-9)


def test_a_blink_is_passed_on_the_shortest_way(opened):
    """In the frame in which both eyes are shut they are on their way between the frames around it."""
    root, shut = opened[1], int(np.nonzero(~OPEN)[0][0])
    share = (FRAMES[shut] - FRAMES[shut - 1]) / (FRAMES[shut + 1] - FRAMES[shut - 1])
    for k, name in enumerate(NAMES):
        before, after = (gaze_rotation(toy_gaze()[f, k]) for f in (shut - 1, shut + 1))
        half = Gf.Slerp(float(share), *(Gf.Matrix3d(*turn.T.ravel()).ExtractRotation().GetQuat()
                                        for turn in (before, after)))
        turn = np.array(UsdGeom.Xformable(root.GetPrimAtPath(f"geo/{name}")).GetLocalTransformation(
            float(FRAMES[shut]))).T[:3, :3]
        np.testing.assert_allclose(turn, np.array(Gf.Matrix3d(Gf.Rotation(half))).T, atol=1e-6)


def test_still_eyes_look_straight_ahead(opened):
    root = opened[1]
    root.GetVariantSets().GetVariantSet(VARIANT_SET).SetVariantSelection(VARIANT_STILL)
    for k, name in enumerate(NAMES):
        for time in (Usd.TimeCode.Default(), Usd.TimeCode(float(FRAMES[1]))):
            np.testing.assert_allclose(placed(root, name, time), rigid(np.eye(3), EYE_CENTRES[k]), atol=1e-9)
    root.GetVariantSets().GetVariantSet(VARIANT_SET).SetVariantSelection("clip")


def test_eyes_have_a_material_of_their_own(opened):
    """The shared map of the albedo under one smooth dielectric, in both models; the head keeps skin's."""
    root = opened[1]
    bound = [UsdShade.MaterialBindingAPI(root.GetPrimAtPath(f"geo/{name}")).ComputeBoundMaterial()[0].GetPath().name
             for name in ("head", *NAMES)]
    assert bound == ["skin", "eye", "eye"]
    preview, openpbr = (UsdShade.Shader(root.GetPrimAtPath(f"mtl/eye/{name}_surface")) for name in (
        "preview", "openpbr"))
    assert preview.GetInput("ior").Get() == openpbr.GetInput("specular_ior").Get() == pytest.approx(1.376)
    assert preview.GetInput("roughness").Get() == openpbr.GetInput("specular_roughness").Get() == pytest.approx(0.08)
    for colour in (preview.GetInput("diffuseColor"), openpbr.GetInput("base_color")):
        texture = UsdShade.Shader(colour.GetConnectedSources()[0][0].source.GetPrim())
        skin = UsdShade.Shader(root.GetPrimAtPath(f"mtl/skin/{texture.GetPrim().GetName()}"))
        assert texture.GetInput("file").Get() == skin.GetInput("file").Get()


def test_obj_and_poses_hold_the_eyes(exported):
    surface, folder = toy_eyed_surface(), exported[1]
    back, groups = read_obj(folder / "mesh.obj"), read_obj_groups(folder / "mesh.obj")
    assert {name: len(faces) for name, faces in groups.items()} == {"head": 512, "eye_left": 128, "eye_right": 128}
    np.testing.assert_array_equal(back.faces, surface.mesh.faces)
    np.testing.assert_allclose(back.vertices, surface.mesh.vertices, atol=1e-4)
    for name, ball in zip(("eye_right", "eye_left"), eyeballs_of(surface), strict=True):
        np.testing.assert_array_equal(groups[name], np.sort(ball.faces))
    poses = load_arrays(folder / "poses.npz")
    np.testing.assert_array_equal(poses["gaze"], toy_gaze())
    np.testing.assert_array_equal(poses["eye_turn"], toy_gaze())
    np.testing.assert_array_equal(poses["lids"], np.where(OPEN, 0.0, 1.0)[:, None] * np.ones(2))
    assert field_faults(poses, EXPORTED_POSES) == []


def test_eyes_whose_gaze_is_not_known_stay_in_the_head(tmp_path):
    """Without a gaze, the mesh with eyes is exported as one; only mesh.obj says which faces they are."""
    work = write_toy_work(tmp_path / "work", eyes=True)
    poses = load_arrays(work / "inverse_render" / "poses.npz")
    del poses["gaze"], poses["eye_turn"]
    save_arrays(work / "inverse_render" / "poses.npz", **poses)
    job = ToyJob(work, tmp_path / "export", usdz=False, glb=False, plates=False, views=False)
    export_usd.run(job)
    export_usd.check(job)
    stage = Usd.Stage.Open(str(job.out / "head.usda"))
    root = stage.GetDefaultPrim()
    assert [prim.GetName() for prim in root.GetPrimAtPath("geo").GetChildren()] == ["head"]
    assert [prim.GetName() for prim in root.GetPrimAtPath("mtl").GetChildren()] == ["skin"]
    assert root.GetPrimAtPath("geo").IsA(UsdGeom.Scope) and "gaze" not in load_arrays(job.out / "poses.npz")
    groups = [line[2:] for line in (job.out / "mesh.obj").read_text().splitlines() if line.startswith("g ")]
    assert set(groups) == {"head", "eye_right", "eye_left"}


def test_eyes_that_never_open_look_straight_ahead(tmp_path):
    work = write_toy_work(tmp_path / "work", eyes=True)
    poses = load_arrays(work / "inverse_render" / "poses.npz")
    shut = dict.fromkeys(("gaze", "eye_turn"), np.full_like(poses["gaze"], np.nan))
    save_arrays(work / "inverse_render" / "poses.npz", **poses | shut)
    job = ToyJob(work, tmp_path / "export", plates=False, views=False)
    export_usd.run(job)
    export_usd.check(job)
    for file in FILES:
        stage = Usd.Stage.Open(str(job.out / file))
        orient = stage.GetDefaultPrim().GetPrimAtPath("geo/eye_left").GetAttribute("xformOp:orient")
        assert orient.GetNumTimeSamples() == 0 and orient.Get(float(FRAMES[2])) == Gf.Quatd(1.0)
