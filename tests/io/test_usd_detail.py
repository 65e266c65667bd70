"""Levels of detail in USD, chosen and read back as another program would."""

from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade, UsdSkel, Vt
from toy_result import FRAMES, INTRINSICS, SOURCE_SIZE, toy_eyed_surface, toy_gaze, toy_poses

from shared.geometry.blend_shapes import BlendShape, with_normals
from shared.geometry.eyeballs import eyeballs_of
from shared.geometry.mesh import shading_normals
from shared.geometry.reduction import reduced
from shared.geometry.surface import Surface
from shared.io.usd import HeadAsset, write_head_usda, write_single_layer
from shared.io.usd_capture import UsdCapture
from shared.io.usd_detail import DETAIL_SET, FULL
from shared.io.usd_material import SHADER_INPUTS, TextureFile
from shared.io.usd_validate import usd_errors

MAPS = {name: TextureFile(f"./maps/{name}.exr") for name in SHADER_INPUTS}
FACES = {"some": 500, "few": 200}
SURFACE = toy_eyed_surface()


def actions(count):
    random = np.random.default_rng(4)
    jaw, shut, half = (np.zeros((count, 3)) for _ in range(3))
    jaw[:200] = random.normal(0.0, 9.0, (200, 3))
    shut[50:150], half[50:150] = random.normal(0.0, 4.0, (2, 100, 3))
    return BlendShape.of("jawOpen", jaw, 0.0), BlendShape.of("eyeBlinkLeft", shut, 0.0, ((0.5, half),))


def asset(eyes: bool) -> HeadAsset:
    capture = UsdCapture(toy_poses(), FRAMES, 25.0, INTRINSICS, *SOURCE_SIZE, "head",
                         eye_turn=toy_gaze() if eyes else None)
    details = dict(zip(FACES, reduced(SURFACE, tuple(FACES.values())), strict=True))
    return HeadAsset("toy", SURFACE.mesh, MAPS, TextureFile("./envmap.exr"), capture, details=details,
                     eyes=eyeballs_of(SURFACE) if eyes else (), levels=(FULL, *details),
                     actions=with_normals(actions(len(SURFACE.mesh.vertices)), SURFACE.mesh))


@pytest.fixture(scope="module", params=[(True, "layers"), (True, "one"), (False, "layers")],
                ids=["layers", "one layer", "one mesh"])
def written(request, tmp_path_factory):
    """(the asset, its file)."""
    eyes, kind = request.param
    own, folder = asset(eyes), tmp_path_factory.mktemp("detail")
    if kind == "layers":
        write_head_usda(folder, own)
    else:
        write_single_layer(folder / "head.usda", own)
    return own, folder / "head.usda"


def opened(path, detail=None):
    """Changes stay with the stage: its layers may be open elsewhere."""
    stage = Usd.Stage.Open(str(path))
    stage.SetEditTarget(stage.GetSessionLayer())
    if detail is not None:
        assert stage.GetDefaultPrim().GetVariantSet(DETAIL_SET).SetVariantSelection(detail)
    return stage


def meshes_of(stage):
    """{name: mesh} below geo."""
    geo = stage.GetDefaultPrim().GetPrimAtPath("geo")
    return {prim.GetName(): UsdGeom.Mesh(prim) for prim in geo.GetChildren() if prim.IsA(UsdGeom.Mesh)}


def face_count(stage):
    return sum(len(mesh.GetFaceVertexCountsAttr().Get()) for mesh in meshes_of(stage).values())


def test_the_variants_and_how_many_faces_they_have(written):
    own, path = written
    stage = opened(path)
    variants = stage.GetDefaultPrim().GetVariantSet(DETAIL_SET)
    assert set(variants.GetVariantNames()) == {FULL, *FACES} and variants.GetVariantSelection() == FULL
    assert face_count(stage) == len(own.mesh.faces)
    for detail, wanted in FACES.items():
        assert wanted - 2 < face_count(opened(path, detail)) <= wanted


def test_they_can_be_chosen_before_anything_is_loaded(written):
    stage = Usd.Stage.Open(str(written[1]), Usd.Stage.LoadNone)
    assert set(stage.GetDefaultPrim().GetVariantSet(DETAIL_SET).GetVariantNames()) == {FULL, *FACES}


def test_the_full_head_is_the_one_without_variants(written, tmp_path):
    own, path = written
    write_single_layer(tmp_path / "plain.usda", replace(own, details={}, levels=(FULL,)))
    plain = opened(tmp_path / "plain.usda")
    assert DETAIL_SET not in plain.GetDefaultPrim().GetVariantSets().GetNames()
    for detail in (None, FULL):
        stage = opened(path, detail)
        assert {str(prim.GetPath()) for prim in stage.Traverse()} == {str(prim.GetPath()) for prim in plain.Traverse()}
        for prim in plain.GetDefaultPrim().GetPrimAtPath("geo").GetAllChildren():
            for attribute in prim.GetAuthoredAttributes():
                assert attribute.Get() == stage.GetAttributeAtPath(attribute.GetPath()).Get(), attribute


@pytest.mark.parametrize("detail", FACES)
def test_reduced_meshes_have_the_full_ones_normals_and_no_vertex_too_many(written, detail):
    """Corner by corner, head and eyes at rest."""
    own, path = written
    few, smooth = own.details[detail], shading_normals(own.mesh)
    corners = {tuple(np.round(few.mesh.vertices[v], 3)): smooth[v] for v in np.unique(few.mesh.faces)}
    stage = opened(path, detail)
    for mesh in meshes_of(stage).values():
        translate = mesh.GetTranslateOp() if mesh.GetOrderedXformOps() else None
        pivot = np.array(translate.Get()) if translate and translate.Get() is not None else np.zeros(3)
        points, faces = (np.array(each.Get()) for each in (mesh.GetPointsAttr(), mesh.GetFaceVertexIndicesAttr()))
        normals = np.array(mesh.GetNormalsAttr().Get())
        assert set(faces) == set(range(len(points)))
        for point, normal in zip(points + pivot, normals, strict=True):
            nearest = min(corners, key=lambda corner: np.square(np.array(corner) - point).sum())
            np.testing.assert_allclose(nearest, point, atol=2e-3)
            np.testing.assert_allclose(corners[nearest], normal, atol=1e-5)


@pytest.mark.parametrize("detail", FACES)
def test_motion_gaze_and_materials_are_those_of_the_full_head(written, detail):
    own, path = written
    full, few = opened(path), opened(path, detail)
    parts = meshes_of(full)
    assert parts.keys() == meshes_of(few).keys() and len(parts) == (3 if own.eyes else 1)
    for name, mesh in meshes_of(few).items():
        for time in (Usd.TimeCode.Default(), *map(float, FRAMES)):
            places = [UsdGeom.Imageable(each).ComputeLocalToWorldTransform(time) for each in (mesh, parts[name])]
            np.testing.assert_array_equal(*map(np.array, places))
        bound = [UsdShade.MaterialBindingAPI(each).ComputeBoundMaterial()[0].GetPath() for each in (mesh, parts[name])]
        assert bound[0] == bound[1] and bound[0].name == ("skin" if name == "head" else "eye")
    if own.eyes:
        eye = meshes_of(few)["eye_left"]
        turns = [np.array(eye.ComputeLocalToWorldTransform(float(frame))) for frame in FRAMES[:2]]
        assert np.abs(turns[0] - turns[1]).max() > 0.01


@pytest.mark.parametrize("detail", FACES)
def test_usd_plays_the_actions_on_what_is_left(written, detail):
    own, path = written
    stage = opened(path, detail)
    rest = np.array(meshes_of(stage)["head"].GetPointsAttr().Get(), np.float64)
    animation = UsdSkel.Animation(stage.GetDefaultPrim().GetPrimAtPath("geo/skeleton/actions"))
    animation.GetBlendShapeWeightsAttr().Set(Vt.FloatArray([0.3, 0.8]))
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetDefaultPrim().GetPrimAtPath("geo")))
    found = np.array(meshes_of(stage)["head"].GetPointsAttr().Get(Usd.TimeCode.EarliestTime()))
    jaw, blink = own.actions
    vertices = own.details[detail].mesh.vertices
    moved = blink.applied(jaw.applied(vertices, 0.3), 0.8) - vertices
    nearest = np.argmin(np.square(rest[:, None] - vertices).sum(-1), axis=1)
    np.testing.assert_allclose(vertices[nearest], rest, atol=1e-4)
    np.testing.assert_allclose(found - rest, moved[nearest], atol=1e-3)
    assert np.linalg.norm(found - rest, axis=1).max() > 1.0


def test_every_variant_is_sound_and_one_that_is_not_is_named(written, tmp_path):
    def faults(path):
        return [error for error in usd_errors(path) if "envmap" not in error and "/maps/" not in error]

    own, path = written
    assert faults(path) == []
    few = own.details["few"]
    broken = replace(few, mesh=few.mesh.replace(uvs=few.mesh.uvs + 2.0))
    write_single_layer(tmp_path / "head.usda", replace(own, details=own.details | {"few": broken}))
    found = faults(tmp_path / "head.usda")
    assert found and all("detail=few" in fault for fault in found)


def test_a_surface_without_segments_has_levels_too(tmp_path):
    details = {"some": reduced(Surface(SURFACE.mesh), [500])[0]}
    write_single_layer(tmp_path / "head.usda", replace(asset(False), details=details, levels=(FULL, "some")))
    assert 498 < face_count(opened(tmp_path / "head.usda", "some")) <= 500
