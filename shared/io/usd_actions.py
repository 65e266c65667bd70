"""Blend shapes of a head in USD.

    geo                 SkelRoot: below it UsdSkel deforms meshes
      head              Mesh with SkelBindingAPI, the names of its actions and where they are
        <action>        BlendShape: offsets of the points that move and of their normals, in-betweens
      skeleton          Skeleton, as UsdSkel wants one; its only joint, the head itself, moves nothing
        actions         SkelAnimation with the weight of each action, 0: the head at rest

The clip's blinks, and lids that follow the gaze, are time samples of these weights. Whoever animates the face sets
`blendShapeWeights` of `actions`, or writes a SkelAnimation of their own and binds that one to the skeleton.

Reference: UsdSkel, Schemas (Blend Shapes).
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from shared.geometry.blend_shapes import BlendShape
from shared.geometry.parts import HEAD
from shared.io.usd_capture import UsdCapture

SKELETON, ANIMATION, JOINT = "skeleton", "actions", "head"
HALF_WEIGHT, HALF_NAME = 0.5, "half"


def define_skeleton(stage: Usd.Stage, root: Sdf.Path, shapes: Sequence[BlendShape]) -> Sdf.Path:
    """The skeleton below the SkelRoot at root, and what animates the shapes -> its path. Their weights are
    set_weights'."""
    path, names = root.AppendChild(SKELETON), [shape.name for shape in shapes]
    skeleton = UsdSkel.Skeleton.Define(stage, path)
    rest = Vt.Matrix4dArray([Gf.Matrix4d(1.0)])
    skeleton.CreateJointsAttr([JOINT])
    skeleton.CreateBindTransformsAttr(rest)
    skeleton.CreateRestTransformsAttr(rest)
    animation = UsdSkel.Animation.Define(stage, path.AppendChild(ANIMATION))
    animation.CreateBlendShapesAttr(names)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    return path


def set_weights(root: Usd.Prim, shapes: Sequence[BlendShape], capture: UsdCapture | None) -> None:
    """The head at rest; capture: whose actions become time samples, None: no one's. root: the SkelRoot."""
    path = root.GetPath().AppendPath(f"{SKELETON}/{ANIMATION}")
    weights = UsdSkel.Animation(root.GetStage().GetPrimAtPath(path)).GetBlendShapeWeightsAttr()
    weights.Set(Vt.FloatArray(len(shapes), 0.0))
    if capture is None or not capture.moves_actions:
        return
    moving = capture.weights_of([shape.name for shape in shapes]).astype(np.float32)
    for time, row in zip(capture.frame_index, moving, strict=True):
        weights.Set(Vt.FloatArray.FromNumpy(row), float(time))


def bind_actions(mesh: UsdGeom.Mesh, skeleton: Sdf.Path, shapes: Sequence[BlendShape]) -> None:
    """Binds the shapes to the mesh, whose vertices are theirs, and both to the skeleton."""
    stage = mesh.GetPrim().GetStage()
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton])
    binding.CreateBlendShapesAttr([shape.name for shape in shapes])
    paths = [_define_shape(stage, mesh.GetPath().AppendChild(shape.name), shape) for shape in shapes]
    binding.CreateBlendShapeTargetsRel().SetTargets(paths)


def _define_shape(stage: Usd.Stage, path: Sdf.Path, shape: BlendShape) -> Sdf.Path:
    prim = UsdSkel.BlendShape.Define(stage, path)
    prim.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(shape.vertices, np.int32)))
    prim.CreateOffsetsAttr(_vectors(shape.offsets))
    if shape.normals is not None:
        prim.CreateNormalOffsetsAttr(_vectors(shape.normals[0]))
    for k, (weight, offsets) in enumerate(shape.between):
        between = prim.CreateInbetween(HALF_NAME if weight == HALF_WEIGHT else f"at_{round(100 * weight)}")
        between.SetWeight(weight)
        between.SetOffsets(_vectors(offsets))
        if shape.normals is not None:
            between.SetNormalOffsets(_vectors(shape.normals[1 + k]))
    return path


def _vectors(offsets: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(offsets, np.float32))


def read_actions(path: Path | str, head: np.ndarray, only: Container[str]) -> tuple[BlendShape, ...]:
    """The shapes of these names that a head.usda has, for the whole mesh that it was made from. head [n] int: which
    vertices of that are geo/head, in its order. Normals are not read. Empty where there are none, or where geo/head has
    another number of points."""
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetPrimAtPath(f"geo/{HEAD}"))
    if not mesh or len(mesh.GetPointsAttr().Get() or ()) != len(head):
        return ()
    shapes = [UsdSkel.BlendShape(prim) for prim in mesh.GetPrim().GetChildren() if prim.IsA(UsdSkel.BlendShape)]
    return tuple(_read_shape(shape, head) for shape in shapes if shape.GetPrim().GetName() in only)


def _read_shape(prim: UsdSkel.BlendShape, head: np.ndarray) -> BlendShape:
    vertices = head[np.array(prim.GetPointIndicesAttr().Get())]
    order = np.argsort(vertices)
    between = [(each.GetWeight(), np.array(each.GetOffsets(), np.float32)[order]) for each in prim.GetInbetweens()]
    return BlendShape(prim.GetPrim().GetName(), vertices[order].astype(np.int32),
                      np.array(prim.GetOffsetsAttr().Get(), np.float32)[order],
                      tuple(sorted(between, key=lambda each: each[0])))
