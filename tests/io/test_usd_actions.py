"""Blend shapes in USD, read back and played by UsdSkel itself."""

from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdSkel, Vt
from toy_result import FRAMES, INTRINSICS, SOURCE_SIZE, toy_eyed_surface, toy_gaze, toy_hair, toy_mesh, toy_poses

from shared.geometry.blend_shapes import BlendShape, with_normals
from shared.geometry.eyeballs import eyeballs_of
from shared.geometry.mesh import vertex_normals
from shared.geometry.parts import head_parts
from shared.io.usd import HeadAsset, write_head_usda, write_single_layer
from shared.io.usd_actions import read_actions
from shared.io.usd_capture import UsdCapture, world_from_head_rigid
from shared.io.usd_material import HAIR_INPUTS, SHADER_INPUTS, TextureFile
from shared.io.usd_validate import usd_errors

MAPS = {name: TextureFile(f"./maps/{name}.exr") for name in SHADER_INPUTS}


def shapes(count: int) -> tuple[BlendShape, ...]:
    """A jaw and a blink with an in-between, of the first vertices of a mesh."""
    random = np.random.default_rng(4)
    jaw, shut, half = (np.zeros((count, 3)) for _ in range(3))
    jaw[5:90] = random.normal(0.0, 9.0, (85, 3))
    shut[20:60], half[20:60] = random.normal(0.0, 4.0, (2, 40, 3))
    return BlendShape.of("jawOpen", jaw, 0.0), BlendShape.of("eyeBlinkLeft", shut, 0.0, ((0.5, half),))


def asset(eyes: bool) -> HeadAsset:
    surface = toy_eyed_surface()
    mesh = surface.mesh if eyes else toy_mesh()
    capture = UsdCapture(toy_poses(), FRAMES, 25.0, INTRINSICS, *SOURCE_SIZE, "head",
                         eye_turn=toy_gaze() if eyes else None)
    return HeadAsset("toy", mesh, MAPS, TextureFile("./envmap.exr"), capture,
                     eyes=eyeballs_of(surface) if eyes else (),
                     actions=with_normals(shapes(len(mesh.vertices)), mesh))


@pytest.fixture(params=[True, False], ids=["eyes", "one mesh"])
def opened(request, tmp_path):
    """(the asset, its stage in one layer)."""
    own = asset(request.param)
    write_single_layer(tmp_path / "head.usda", own)
    stage = Usd.Stage.Open(str(tmp_path / "head.usda"))
    yield own, stage
    del stage


def head_of(stage):
    return UsdGeom.Mesh(stage.GetDefaultPrim().GetPrimAtPath("geo/head"))


def head_actions(own):
    """The shapes in the numbers that the head's vertices have in its own mesh."""
    head = head_parts(own.mesh, own.eyes)[0]
    return [shape.of_part(head.vertices) for shape in own.actions]


def baked(stage, **weights):
    """Points of the head where UsdSkel has baked these weights."""
    animation = UsdSkel.Animation(stage.GetDefaultPrim().GetPrimAtPath("geo/skeleton/actions"))
    names = list(animation.GetBlendShapesAttr().Get())
    animation.GetBlendShapeWeightsAttr().Set(Vt.FloatArray([weights.get(name, 0.0) for name in names]))
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetDefaultPrim().GetPrimAtPath("geo")))
    head = head_of(stage)
    return np.array(head.GetPointsAttr().Get(Usd.TimeCode.EarliestTime()))


def test_names_and_offsets(opened):
    own, stage = opened
    head = head_of(stage)
    binding = UsdSkel.BindingAPI(head.GetPrim())
    assert list(binding.GetBlendShapesAttr().Get()) == ["jawOpen", "eyeBlinkLeft"]
    targets = binding.GetBlendShapeTargetsRel().GetTargets()
    for shape, path in zip(head_actions(own), targets, strict=True):
        prim = UsdSkel.BlendShape(stage.GetPrimAtPath(path))
        assert path.name == shape.name
        np.testing.assert_array_equal(prim.GetPointIndicesAttr().Get(), shape.vertices)
        np.testing.assert_array_equal(prim.GetOffsetsAttr().Get(), shape.offsets)
        np.testing.assert_array_equal(prim.GetNormalOffsetsAttr().Get(), shape.normals[0])
        found = prim.GetInbetweens()
        assert len(found) == len(shape.between)
        for between, (weight, offsets), normals in zip(found, shape.between, shape.normals[1:], strict=True):
            assert between.GetWeight() == weight
            np.testing.assert_array_equal(between.GetOffsets(), offsets)
            np.testing.assert_array_equal(between.GetNormalOffsets(), normals)


def test_the_head_at_rest_is_the_one_without_actions(opened, tmp_path):
    """To the last bit: points, faces, texture coordinates and normals."""
    own, stage = opened
    write_single_layer(tmp_path / "without.usda", replace(own, actions=()))
    without = Usd.Stage.Open(str(tmp_path / "without.usda"))
    for attribute in head_of(without).GetPrim().GetAuthoredAttributes():
        if not attribute.GetName().startswith(("xformOp", "skel")):
            assert attribute.Get() == head_of(stage).GetPrim().GetAttribute(attribute.GetName()).Get()
    animation = UsdSkel.Animation(stage.GetDefaultPrim().GetPrimAtPath("geo/skeleton/actions"))
    assert not any(animation.GetBlendShapeWeightsAttr().Get())
    assert not without.GetDefaultPrim().GetPrimAtPath("geo/skeleton")


def test_hair_below_the_skeleton_is_rigid(opened, tmp_path):
    """A plain mesh that goes with the SkelRoot: no action moves it, and the validators take it."""
    own = replace(opened[0], hair=toy_hair().mesh, maps=MAPS | {name: TextureFile(f"./maps/{name}.exr")
                                                               for name in HAIR_INPUTS})
    write_single_layer(tmp_path / "hair.usda", own)
    faults = [error for error in usd_errors(tmp_path / "hair.usda") if "/maps/" not in error and "envmap" not in error]
    assert faults == []
    stage = Usd.Stage.Open(str(tmp_path / "hair.usda"))
    hair = UsdGeom.Mesh(stage.GetDefaultPrim().GetPrimAtPath("geo/hair"))
    rest = np.array(hair.GetPointsAttr().Get())
    moved = baked(stage, jawOpen=1.0)
    assert np.ptp(moved - np.array(head_of(opened[1]).GetPointsAttr().Get())) > 1.0
    np.testing.assert_array_equal(hair.GetPointsAttr().Get(Usd.TimeCode.EarliestTime()), rest)
    expected = world_from_head_rigid(own.capture)
    for f, frame in enumerate(FRAMES):
        found = np.array(UsdGeom.Imageable(hair).ComputeLocalToWorldTransform(float(frame))).T
        np.testing.assert_allclose(found, expected[f], atol=1e-9)


@pytest.mark.parametrize("weight", [-0.6, 0.0, 0.25, 0.5, 0.8, 1.0, 1.4])
def test_usd_plays_what_the_shape_says(opened, weight):
    own, stage = opened
    rest = np.array(head_of(stage).GetPointsAttr().Get(), np.float64)
    found = baked(stage, eyeBlinkLeft=weight, jawOpen=0.3)
    jaw, blink = head_actions(own)
    np.testing.assert_allclose(found, blink.applied(jaw.applied(rest, 0.3), weight), atol=1e-4)


@pytest.mark.parametrize("name", ["jawOpen", "eyeBlinkLeft"])
def test_usd_turns_normals_to_those_of_the_moved_head(opened, name):
    own, stage = opened
    baked(stage, **{name: 1.0})
    found = np.array(head_of(stage).GetNormalsAttr().Get(Usd.TimeCode.EarliestTime()))
    head, shape = head_parts(own.mesh, own.eyes)[0], next(each for each in head_actions(own) if each.name == name)
    expected = vertex_normals(shape.applied(head.mesh.vertices, 1.0), head.mesh.faces)
    np.testing.assert_allclose(found[shape.vertices], expected[shape.vertices], atol=1e-5)


def test_head_and_eyes_move_together(opened):
    """The motion is that of geo, whatever hangs below it."""
    own, stage = opened
    for f, frame in enumerate(FRAMES):
        transform = UsdGeom.Imageable(head_of(stage)).ComputeLocalToWorldTransform(float(frame))
        np.testing.assert_allclose(np.array(transform).T, world_from_head_rigid(own.capture)[f], atol=1e-6)


def test_the_layered_asset_is_sound(opened, tmp_path):
    (tmp_path / "layers").mkdir()
    write_head_usda(tmp_path / "layers", opened[0])
    errors = [error for error in usd_errors(tmp_path / "layers" / "head.usda")
              if "envmap" not in error and "/maps/" not in error]
    assert errors == []


@pytest.mark.parametrize("layers", [write_single_layer, write_head_usda])
def test_the_clip_blinks_and_the_still_head_does_not(tmp_path, layers):
    own, left = asset(eyes=True), np.linspace(0.0, 1.0, len(FRAMES))
    own = replace(own, capture=replace(own.capture, action_weights={"eyeBlinkLeft": left}))
    layers(tmp_path / "head.usda" if layers is write_single_layer else tmp_path, own)
    stage = Usd.Stage.Open(str(tmp_path / "head.usda"))
    root = stage.GetDefaultPrim()
    weights = UsdSkel.Animation(root.GetPrimAtPath("geo/skeleton/actions")).GetBlendShapeWeightsAttr()
    assert weights.GetTimeSamples() == [float(frame) for frame in FRAMES]
    for frame, weight in zip(FRAMES, left, strict=True):
        np.testing.assert_allclose(weights.Get(float(frame)), [0.0, weight], atol=1e-7)
    head, blink = head_of(stage), head_actions(own)[1]
    rest = np.array(head.GetPointsAttr().Get(), np.float64)
    assert UsdSkel.BakeSkinning(UsdSkel.Root(root.GetPrimAtPath("geo")))
    shut = np.array(head.GetPointsAttr().Get(float(FRAMES[-1])))
    np.testing.assert_allclose(shut, blink.applied(rest, 1.0), atol=1e-4)
    root.GetVariantSet("capture").SetVariantSelection("still")
    assert not any(weights.Get()) and not weights.GetTimeSamples()


@pytest.mark.parametrize("eyes", [True, False])
def test_shapes_are_read_as_they_were_written(tmp_path, eyes):
    """In the whole mesh's numbers, but for what moves of eyeballs, which are meshes of their own."""
    own = asset(eyes)
    write_head_usda(tmp_path, own)
    head = head_parts(own.mesh, own.eyes)[0].vertices
    (found,) = read_actions(tmp_path / "head.usda", head, ("eyeBlinkLeft", "eyeBlinkRight"))
    (blink,) = (shape for shape in own.actions if shape.name == "eyeBlinkLeft")
    kept = np.isin(blink.vertices, head)
    assert found.name == blink.name and found.between[0][0] == 0.5
    np.testing.assert_array_equal(found.vertices, blink.vertices[kept])
    np.testing.assert_array_equal(found.offsets, blink.offsets[kept])
    np.testing.assert_array_equal(found.between[0][1], blink.between[0][1][kept])
    assert read_actions(tmp_path / "head.usda", head[:-1], ("eyeBlinkLeft",)) == ()
    assert read_actions(tmp_path / "head.usda", head, ("eyeLookUpLeft",)) == ()
