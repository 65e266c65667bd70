"""The head as a USD asset: one layer that a studio can reference and that any viewer opens.

    /<subject>        Xform, default prim, kind component, assetInfo
      geo/head        Mesh in millimetres, faceVarying UVs and normals
      mtl/skin        Material: UsdPreviewSurface and OpenPBR
      capture         camera and dome light, in the variant "clip" of the variant set "capture"

The variant "clip" (the default) replays the capture: the head's (or the camera's) motion as time samples, the
light at rest. The variant "still" leaves the head alone at head space's origin, for use in another scene.

References: USD Working Group, Guidelines for structuring USD assets; UsdGeomMesh, UsdGeomCamera,
UsdLuxDomeLight.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, Vt

from shared.errors import LimnError
from shared.io.usd_capture import Capture, animate, define_camera, define_dome_light, world_from_head_rigid
from shared.io.usd_material import define_material
from shared.mesh import Mesh, vertex_normals

METERS_PER_UNIT = 0.001
VARIANT_SET, VARIANT_CLIP, VARIANT_STILL = "capture", "clip", "still"


@dataclass(frozen=True)
class HeadAsset:
    """Everything that goes into head.usda. Paths are relative to the layer.

    maps: {name of usd_material.SHADER_INPUTS: path}; envmap: path; colour_space of the linear colour maps;
    metadata: nested dictionaries of strings, numbers and lists for the root prim's customData["limn"].
    """

    name: str
    mesh: Mesh
    maps: Mapping[str, str]
    envmap: str
    capture: Capture
    version: str = "1"
    colour_space: str = "lin_rec709_scene"
    metadata: Mapping[str, object] = field(default_factory=dict)


def prim_name(name: str) -> str:
    """A valid ASCII prim name for any subject name: accents dropped, the rest of the unusable characters as
    `_`.

    Newer USD allows Unicode identifiers, the tools in use do not all. A leading digit gets `_` before it; a
    name without one usable character becomes `head`.
    """
    ascii_name = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    cleaned = re.sub(r"[^A-Za-z0-9_]+", "_", ascii_name).strip("_")
    if not cleaned:
        return "head"
    return f"_{cleaned}" if cleaned[0].isdigit() else cleaned


def write_head_usda(path: Path | str, asset: HeadAsset) -> None:
    """Writes the layer; the same asset gives the same bytes. LimnError when USD cannot write it."""
    path = Path(path)
    stage = Usd.Stage.CreateInMemory(path.name)
    _stage_metadata(stage, asset)
    root = _define_root(stage, asset)
    root_path = root.GetPath()
    material_path = root_path.AppendPath("mtl/skin")
    UsdGeom.Scope.Define(stage, root_path.AppendChild("geo"))
    UsdGeom.Scope.Define(stage, root_path.AppendChild("mtl"))
    mesh = define_mesh(stage, str(root_path.AppendPath("geo/head")), asset.mesh)
    material = define_material(stage, str(material_path), asset.maps, asset.colour_space)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    _define_capture(stage, root, mesh, asset)
    if not stage.GetRootLayer().Export(str(path)):
        raise LimnError(f"{path}: USD could not write the layer")


def _stage_metadata(stage: Usd.Stage, asset: HeadAsset) -> None:
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, METERS_PER_UNIT)
    frames = asset.capture.frame_index
    stage.SetStartTimeCode(float(frames.min()))
    stage.SetEndTimeCode(float(frames.max()))
    stage.SetTimeCodesPerSecond(asset.capture.fps)
    stage.SetFramesPerSecond(asset.capture.fps)
    stage.GetRootLayer().documentation = (
        "A head recovered from a clip by Limn. Lengths in millimetres; time codes are frames of the clip. "
        "Variant set 'capture': 'clip' replays the clip with its camera and light, 'still' is the head alone."
    )


def _define_root(stage: Usd.Stage, asset: HeadAsset) -> Usd.Prim:
    name = prim_name(asset.name)
    prim = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(prim)
    model = Usd.ModelAPI(prim)
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(name)
    model.SetAssetIdentifier(Sdf.AssetPath("./head.usda"))
    model.SetAssetVersion(asset.version)
    prim.SetDisplayName(asset.name)
    prim.SetCustomDataByKey("limn", {"subject": asset.name, **asset.metadata})
    return prim


def define_mesh(stage: Usd.Stage, path: str, mesh: Mesh) -> UsdGeom.Mesh:
    """A polygon mesh (subdivisionScheme none) with indexed faceVarying UVs and normals, and its extent."""
    prim = UsdGeom.Mesh.Define(stage, path)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.vertices, np.float32))
    faces = Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.ravel(), np.int32))
    prim.CreatePointsAttr(points)
    prim.CreateFaceVertexIndicesAttr(faces)
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    prim.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    primvars = UsdGeom.PrimvarsAPI(prim)
    types, varying = Sdf.ValueTypeNames, UsdGeom.Tokens.faceVarying
    coordinates = primvars.CreatePrimvar("st", types.TexCoord2fArray, varying)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uvs, np.float32)))
    coordinates.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.face_uvs.ravel(), np.int32)))
    normals = primvars.CreatePrimvar("normals", types.Normal3fArray, varying)
    smooth = vertex_normals(mesh.vertices, mesh.faces)
    smooth[np.linalg.norm(smooth, axis=1) < 0.5] = (0.0, 0.0, 1.0)  # only faces without area around it: any unit vector
    normals.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(smooth, np.float32)))
    normals.SetIndices(faces)
    return prim


def _define_capture(stage: Usd.Stage, root: Usd.Prim, mesh: UsdGeom.Mesh, asset: HeadAsset) -> None:
    variants = root.GetVariantSets().AddVariantSet(VARIANT_SET)
    for name in (VARIANT_CLIP, VARIANT_STILL):
        variants.AddVariant(name)
    variants.SetVariantSelection(VARIANT_CLIP)
    scope = root.GetPath().AppendChild("capture")
    capture = asset.capture
    with variants.GetVariantEditContext():
        UsdGeom.Scope.Define(stage, scope)
        camera = define_camera(stage, str(scope.AppendChild("camera")), capture)
        camera.GetPrim().SetCustomDataByKey("limn", _camera_metadata(capture))
        define_dome_light(stage, str(scope.AppendChild("light")), asset.envmap, asset.colour_space)
        if capture.moves == "head":
            animate(mesh, world_from_head_rigid(capture), capture.frame_index)


def _camera_metadata(capture: Capture) -> dict:
    k = capture.intrinsics
    return {
        "resolution": Gf.Vec2i(int(capture.width), int(capture.height)),
        "focal_length_px": Gf.Vec2d(float(k[0, 0]), float(k[1, 1])),
        "principal_point_px": Gf.Vec2d(float(k[0, 2]), float(k[1, 2])),
    }
