"""The head as a USD asset: one folder that a studio can reference and that any viewer opens.

    head.usda           the interface: default prim, kind, assetInfo, extents, variants; loads in no time
      payload           head_payload.usda, sublayers of head_geo.usdc and head_mtl.usda

    /<subject>          Xform, default prim, kind component, assetInfo, inherits /__class__/<subject>
      geo               SkelRoot where the head has facial actions (usd_actions)
      geo/head          Mesh in millimetres, UVs per face corner, normals per vertex
      geo/eye_right     Mesh about the eyeball's centre, which it turns about; geo/eye_left likewise
      geo/hair          Mesh, seen from both sides, where hair stands off the head; `visibility` hides it
      mtl/skin          Material: UsdPreviewSurface and OpenPBR; mtl/eye and mtl/hair likewise
      capture           camera, lights and the clip's card, in the variant "clip" of the variant set "capture"

    What a mesh is made of lies in the variants of the set "detail" (usd_detail), what light does to the skin in those
    of the set "look" (usd_material).

The variant "clip" (the default) replays the capture: the head's (or the camera's) motion and the eyes' gaze as time
samples, the light at rest, the clip on a card of purpose guide. The variant "still" leaves the head alone at head
space's origin, for use in another scene. There, and at the default time of "clip", the eyes look straight ahead.

Where the clip's gaze is not known the eyes are part of geo/head. Without hair of its own that one then moves by itself,
below a scope. Else geo does, an Xform, and carries head, eyes and hair. Where there are facial actions it is geo that
moves in any case. Hair is the same mesh in all variants; no action moves it.

References: USD Working Group, Guidelines for structuring USD assets; UsdGeomMesh, UsdGeomCamera,
UsdLuxDomeLight, UsdGeomModelAPI.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt

from shared.errors import LimnError
from shared.geometry.blend_shapes import BlendShape
from shared.geometry.eyeballs import Eyeball
from shared.geometry.mesh import Mesh, shading_normals
from shared.geometry.parts import EYES, HAIR, HEAD, RigidPart, hair_part, head_parts, quad_part
from shared.geometry.quads import QuadMesh
from shared.geometry.reduction import ReducedMesh
from shared.imaging.displacement import DisplacedBase
from shared.io.usd_actions import bind_actions, define_skeleton, set_weights
from shared.io.usd_capture import (
    BallLamp,
    Plate,
    UsdCapture,
    animate,
    define_camera,
    define_dome_light,
    define_lamp,
    define_plate,
    eye_turns,
    turn,
    world_from_head_rigid,
)
from shared.io.usd_detail import BASE, DETAIL_SET, FULL, define_details, each_detail
from shared.io.usd_material import (
    EYE,
    EYE_MAPS,
    HAIR_INPUTS,
    LOOK_SET,
    MATT,
    MEASURED,
    SHADER_INPUTS,
    SKIN_LOOK,
    TextureFile,
    define_displacement,
    define_material,
    define_scattering,
)
from shared.io.usd_variants import define_variants, in_variant

METERS_PER_UNIT = 0.001
VARIANT_SET, VARIANT_CLIP, VARIANT_STILL = "capture", "clip", "still"
INTERFACE, PAYLOAD, GEOMETRY, MATERIALS = "head.usda", "head_payload.usda", "head_geo.usdc", "head_mtl.usda"


@dataclass(frozen=True, eq=False)
class BaseHead:
    """The head as quads, and the file of their displacement."""

    displaced: DisplacedBase
    heights: TextureFile


@dataclass(frozen=True)
class HeadAsset:
    """Everything that goes into head.usda. Paths are relative to the layer.

    maps: {name of usd_material.SHADER_INPUTS, with hair of HAIR_INPUTS, too: texture}; envmap: the dome light's
    texture; lamp: what stands near of the light and is not in that texture, or None; plate: the clip's frames, or None;
    eyes: the right and the left eyeball of the mesh, to be meshes of their own, or none; actions: blend shapes of the
    mesh, which move no eyeball; details: {level: the mesh with fewer faces}; base: the mesh as displaced quads, or
    None; hair: what stands off the head, a mesh with UVs of its own, or None; levels: of detail to be written, the
    first one chosen: FULL, names of details, BASE; metadata: nested dictionaries of strings, numbers and lists for the
    root prim's customData["limn"].
    """

    name: str
    mesh: Mesh
    maps: Mapping[str, TextureFile]
    envmap: TextureFile
    capture: UsdCapture
    plate: Plate | None = None
    lamp: BallLamp | None = None
    eyes: Sequence[Eyeball] = ()
    actions: Sequence[BlendShape] = ()
    details: Mapping[str, ReducedMesh] = field(default_factory=dict)
    base: BaseHead | None = None
    hair: Mesh | None = None
    levels: Sequence[str] = (FULL,)
    version: str = "1"
    metadata: Mapping[str, object] = field(default_factory=dict)

    @property
    def geo_moves(self) -> bool:
        """Is it geo that carries the motion, and not geo/head alone?"""
        return bool(self.eyes or self.actions) or self.hair is not None

    def parts(self, level: str) -> tuple[RigidPart, ...]:
        """Head and eyes at FULL or one of the details: with the full mesh's normals at all of them, since few faces
        have worse ones, and the normal map bends those."""
        if level == FULL:
            return head_parts(self.mesh, self.eyes)
        few = self.details[level]
        return head_parts(few.mesh, [few.eyeball(eye) for eye in self.eyes], shading_normals(self.mesh))


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


def write_head_usda(folder: Path | str, asset: HeadAsset) -> None:
    """Writes the four layers into folder; the same asset gives the same bytes. LimnError when USD cannot write one."""
    folder, root = Path(folder), Sdf.Path.absoluteRootPath.AppendChild(prim_name(asset.name))
    layers = {GEOMETRY: _layer(_define_geometry, root, asset), MATERIALS: _layer(_define_materials, root, asset)}
    # While the interface is authored the heavy layers lie below it, so that types resolve; then they become a payload.
    layers[INTERFACE] = _layer(_define_interface, root, asset, [layers[MATERIALS], layers[GEOMETRY]])
    layers[PAYLOAD] = _layer(lambda *_: None, root, asset)
    layers[PAYLOAD].subLayerPaths = [f"./{MATERIALS}", f"./{GEOMETRY}"]
    prim = layers[INTERFACE].GetPrimAtPath(root)
    prim.specifier, prim.typeName = Sdf.SpecifierDef, "Xform"
    prim.payloadList.Prepend(Sdf.Payload(f"./{PAYLOAD}"))
    prim.assetInfo["identifier"] = Sdf.AssetPath(f"./{INTERFACE}")
    prim.assetInfo["payloadAssetDependencies"] = Sdf.AssetPathArray([Sdf.AssetPath(f"./{PAYLOAD}")])
    base = Sdf.CreatePrimInLayer(layers[INTERFACE], f"/__class__/{root.name}")
    for spec in (base, base.nameParent):
        spec.specifier = Sdf.SpecifierClass
    prim.inheritPathList.Prepend(base.path)
    for name, layer in layers.items():
        if not layer.Export(str(folder / name)):
            raise LimnError(f"{folder / name}: USD could not write the layer")


def _layer(define: Callable, root: Sdf.Path, asset: HeadAsset, below: Sequence[Sdf.Layer] = ()) -> Sdf.Layer:
    """What define writes about the asset over the layers below, as a layer of its own."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.subLayerPaths = [other.identifier for other in below]
    stage = Usd.Stage.Open(layer)
    _layer_metadata(stage)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, root).GetPrim())
    define(stage, root, asset)
    del stage
    layer.subLayerPaths.clear()
    return layer


def write_single_layer(path: Path | str, asset: HeadAsset) -> None:
    """The same prims in one layer without composition arcs but for the variants, as packages want it."""
    def define(*arguments) -> None:
        for part in (_define_geometry, _define_materials, _define_interface):
            part(*arguments)

    root = Sdf.Path.absoluteRootPath.AppendChild(prim_name(asset.name))
    layer = _layer(define, root, asset)
    layer.GetPrimAtPath(root).assetInfo["identifier"] = Sdf.AssetPath(f"./{Path(path).name}")
    if not layer.Export(str(path)):
        raise LimnError(f"{path}: USD could not write the layer")


def _layer_metadata(stage: Usd.Stage) -> None:
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, METERS_PER_UNIT)


def _define_geometry(stage: Usd.Stage, root: Sdf.Path, asset: HeadAsset) -> None:
    geo = root.AppendChild("geo")
    kind = UsdSkel.Root if asset.actions else UsdGeom.Xform if asset.geo_moves else UsdGeom.Scope
    kind.Define(stage, geo)
    skeleton = define_skeleton(stage, geo, asset.actions) if asset.actions else None
    UsdGeom.Mesh.Define(stage, geo.AppendChild(HEAD))
    for name, eye in zip(EYES if asset.eyes else (), asset.eyes, strict=True):
        prim = UsdGeom.Mesh.Define(stage, geo.AppendChild(name))
        prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*map(float, eye.centre)))
        # The variants give its value: one that stood here would be stronger than theirs in a single layer.
        prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    if asset.hair is not None:
        hair = hair_part(asset.hair)
        define_mesh(stage, str(geo.AppendChild(HAIR)), hair.mesh, hair.normals).CreateDoubleSidedAttr(True)
    for level in each_detail(stage.GetPrimAtPath(root), asset.levels):
        for part in asset.parts(FULL if level == BASE else level):
            path = geo.AppendChild(part.name)
            if level == BASE and part.name == HEAD:
                _define_base(stage, path, asset, skeleton)
                continue
            prim = define_mesh(stage, str(path), part.mesh, part.normals)
            if part.name == HEAD and skeleton:
                bind_actions(prim, skeleton, [shape.of_part(part.vertices) for shape in asset.actions])


def _define_base(stage: Usd.Stage, path: Sdf.Path, asset: HeadAsset, skeleton: Sdf.Path | None) -> None:
    """The head as quads with its actions; eyeballs that turn are not among them: nothing displaces those."""
    displaced = asset.base.displaced
    apart = np.concatenate([np.zeros(0, int), *(eye.faces for eye in asset.eyes)])
    head, used = quad_part(displaced.cage, displaced.quads_beside(apart))
    prim = define_cage(stage, str(path), head)
    if skeleton:
        bind_actions(prim, skeleton, [displaced.fit.shape(shape).of_part(used) for shape in asset.actions])


def _define_materials(stage: Usd.Stage, root: Sdf.Path, asset: HeadAsset) -> None:
    """The materials and their bindings: a layer that can be muted or replaced without the geometry."""
    UsdGeom.Scope.Define(stage, root.AppendChild("mtl"))
    skin = {name: asset.maps[name] for name in SHADER_INPUTS if name in asset.maps}
    material = define_material(stage, str(root.AppendPath("mtl/skin")), skin)
    _bind(stage, root, HEAD, material)
    if BASE in asset.levels:
        with in_variant(stage.GetPrimAtPath(root), DETAIL_SET, BASE, asset.levels[0]):
            define_displacement(stage, material, asset.base.heights)
    with in_variant(stage.GetPrimAtPath(root), LOOK_SET, SKIN_LOOK, MEASURED):
        define_scattering(stage, material)
    if asset.eyes:
        shared = {name: asset.maps[name] for name in EYE_MAPS if name in asset.maps}
        eye = define_material(stage, str(root.AppendPath("mtl/eye")), shared, EYE)
        for name in EYES:
            _bind(stage, root, name, eye)
    if asset.hair is not None:
        own = {name: asset.maps[name] for name in HAIR_INPUTS}
        _bind(stage, root, HAIR, define_material(stage, str(root.AppendPath("mtl/hair")), own, MATT))


def _bind(stage: Usd.Stage, root: Sdf.Path, name: str, material: UsdShade.Material) -> None:
    mesh = stage.OverridePrim(root.AppendPath(f"geo/{name}"))
    UsdShade.MaterialBindingAPI.Apply(mesh).Bind(material)


def _define_interface(stage: Usd.Stage, root: Sdf.Path, asset: HeadAsset) -> None:
    """What a scene sees of the asset before it loads the payload."""
    frames = asset.capture.frame_index
    stage.SetStartTimeCode(float(frames.min()))
    stage.SetEndTimeCode(float(frames.max()))
    stage.SetTimeCodesPerSecond(asset.capture.fps)
    stage.SetFramesPerSecond(asset.capture.fps)
    stage.GetRootLayer().documentation = (
        "A head recovered from a clip by Limn. Lengths in millimetres; time codes are frames of the clip. "
        "Variant set 'capture': 'clip' replays the clip with its camera and light, 'still' is the head alone. "
        "Variant set 'detail': 'full', or about as many triangles as the name says, or 'base', quads under subdivision "
        "whose displacement makes the full head of them. "
        "Variant set 'look': 'measured', or 'skin', into which light goes."
    )
    prim = stage.GetPrimAtPath(root)
    define_details(prim, asset.levels)
    define_variants(prim, LOOK_SET, (MEASURED, SKIN_LOOK), MEASURED)
    model = Usd.ModelAPI(prim)
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(root.name)
    model.SetAssetVersion(asset.version)
    prim.SetDisplayName(asset.name)
    prim.SetCustomDataByKey("limn", {"subject": asset.name, **asset.metadata})
    _define_variants(stage, prim, asset)


def _define_variants(stage: Usd.Stage, root: Usd.Prim, asset: HeadAsset) -> None:
    define_variants(root, VARIANT_SET, (VARIANT_CLIP, VARIANT_STILL), VARIANT_CLIP)
    meshes = [asset.mesh] if asset.hair is None else [asset.mesh, asset.hair]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    UsdGeom.ModelAPI.Apply(root)
    with in_variant(root, VARIANT_SET, VARIANT_STILL, VARIANT_CLIP):
        _set_extents(root, vertices[None])
        _define_gaze(root, asset, moves=False)
        _define_weights(root, asset, moves=False)
    with in_variant(root, VARIANT_SET, VARIANT_CLIP, VARIANT_CLIP):
        moved = world_from_head_rigid(asset.capture)
        box = np.array(np.meshgrid(*np.stack([vertices.min(0), vertices.max(0)]).T)).reshape(3, -1).T
        _set_extents(root, np.einsum("fij,nj->fni", moved[:, :3, :3], box) + moved[:, None, :3, 3])
        _define_gaze(root, asset, moves=True)
        _define_weights(root, asset, moves=True)
        _define_capture(stage, root, asset)


def _define_gaze(root: Usd.Prim, asset: HeadAsset, moves: bool) -> None:
    """The eyes straight ahead; moves: with the clip's gaze as time samples."""
    for k, name in enumerate(EYES if asset.eyes else ()):
        orient = UsdGeom.Mesh(root.GetPrimAtPath(f"geo/{name}")).GetOrientOp().GetAttr()
        orient.Set(Gf.Quatd(1.0))
        if moves:
            frames, rotations = eye_turns(asset.capture, k)
            turn(orient, rotations, frames)


def _define_weights(root: Usd.Prim, asset: HeadAsset, moves: bool) -> None:
    """The actions at rest; moves: with the clip's blinks as time samples."""
    if asset.actions:
        set_weights(root.GetPrimAtPath("geo"), asset.actions, asset.capture if moves else None)


def _set_extents(root: Usd.Prim, points: np.ndarray) -> None:
    """extentsHint around points [..., 3]: what is drawn for the asset while its payload is not loaded."""
    corners = points.reshape(-1, 3)
    bounds = np.stack([corners.min(0), corners.max(0)]).astype(np.float32)
    UsdGeom.ModelAPI(root).SetExtentsHint(Vt.Vec3fArray.FromNumpy(bounds))


def _define_capture(stage: Usd.Stage, root: Usd.Prim, asset: HeadAsset) -> None:
    scope, capture = root.GetPath().AppendChild("capture"), asset.capture
    UsdGeom.Scope.Define(stage, scope)
    camera = define_camera(stage, str(scope.AppendChild("camera")), capture)
    camera.GetPrim().SetCustomDataByKey("limn", _camera_metadata(capture))
    define_dome_light(stage, str(scope.AppendChild("light")), asset.envmap, capture)
    if asset.lamp is not None:
        define_lamp(stage, str(scope.AppendChild("lamp")), asset.lamp, capture)
    if asset.plate is not None:
        define_plate(stage, str(scope.AppendChild("plate")), capture, asset.plate)
    if capture.moves == "head":
        moved = "geo" if asset.geo_moves else "geo/head"
        head = UsdGeom.Xformable(stage.GetPrimAtPath(root.GetPath().AppendPath(moved)))
        animate(head, world_from_head_rigid(capture), capture.frame_index)


def _camera_metadata(capture: UsdCapture) -> dict:
    k = capture.intrinsics
    return {
        "resolution": Gf.Vec2i(int(capture.width), int(capture.height)),
        "focal_length_px": Gf.Vec2d(float(k[0, 0]), float(k[1, 1])),
        "principal_point_px": Gf.Vec2d(float(k[0, 2]), float(k[1, 2])),
    }


def define_mesh(stage: Usd.Stage, path: str, mesh: Mesh, normals: np.ndarray) -> UsdGeom.Mesh:
    """A polygon mesh (subdivisionScheme none) with indexed faceVarying UVs, normals [V, 3] per vertex, which blend
    shapes can turn, and its extent."""
    prim = _define_polygons(stage, path, mesh.vertices, mesh.faces, mesh.uvs, mesh.face_uvs)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, np.float32)))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return prim


def define_cage(stage: Usd.Stage, path: str, cage: QuadMesh) -> UsdGeom.Mesh:
    """The control mesh of a Catmull-Clark surface by the rules of geometry.quads, with faceVarying UVs; normals follow
    from the surface."""
    prim = _define_polygons(stage, path, cage.vertices, cage.quads, cage.uvs, cage.quad_uvs)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.catmullClark)
    prim.CreateInterpolateBoundaryAttr(UsdGeom.Tokens.edgeOnly)
    prim.CreateFaceVaryingLinearInterpolationAttr(UsdGeom.Tokens.all)
    return prim


def _define_polygons(
    stage: Usd.Stage, path: str, vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray, face_uvs: np.ndarray
) -> UsdGeom.Mesh:
    """Points [V, 3], faces [F, K] and indexed faceVarying UVs [T, 2] by face_uvs [F, K], and the extent."""
    prim = UsdGeom.Mesh.Define(stage, path)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertices, np.float32))
    prim.CreatePointsAttr(points)
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.ravel(), np.int32)))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), faces.shape[1], np.int32)))
    prim.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    prim.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    types, varying = Sdf.ValueTypeNames, UsdGeom.Tokens.faceVarying
    coordinates = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("st", types.TexCoord2fArray, varying)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uvs, np.float32)))
    coordinates.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(face_uvs.ravel(), np.int32)))
    return prim
