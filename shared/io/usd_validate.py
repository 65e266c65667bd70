"""Checks a written USD asset: usd-core's validators, the MaterialX library, and what both are blind to.

usd-core ships without usdMtlx, so its shader registry knows no MaterialX node and reports each as unknown.
Those reports are filtered by name and the nodes are checked against the MaterialX package's own definitions
instead. The validators do not look at index ranges, texture coordinates, or the decoding of a floating-point
normal map.
"""

from __future__ import annotations

import zipfile
from functools import lru_cache
from pathlib import Path

import MaterialX as mx
import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdValidation

from shared.geometry.mesh import Mesh
from shared.geometry.mesh_checks import mesh_errors
from shared.geometry.quads import triangulated
from shared.io.usd_material import NORMAL_BIAS, NORMAL_SCALE

MATERIALX_PREFIX = "ND_"
_FALSE_ALARM = "MissingShaderIdInRegistry"
_LAYERS, _PICTURES = (".usd", ".usda", ".usdc"), (".png", ".jpg", ".jpeg", ".exr")
# MaterialX type -> how it is spelled in USD, after usdMtlx's own table.
_USD_TYPES = {
    "float": ("float",),
    "integer": ("int",),
    "color3": ("color3f",),
    "vector2": ("float2",),
    "vector3": ("float3", "vector3f", "normal3f"),
    "string": ("string",),
    "filename": ("asset",),
    "surfaceshader": ("token",),
    "displacementshader": ("token",),
}


def usd_errors(path: Path | str) -> list[str]:
    """Sentences about everything wrong with the asset at path (.usda or .usdz), as it opens and in each other variant;
    empty when it is sound."""
    stage = Usd.Stage.Open(str(path))
    if stage is None or not stage.GetDefaultPrim():
        return [f"{Path(path).name}: not a USD stage with a default prim"]
    errors = _stage_errors(stage)
    root = stage.GetDefaultPrim()
    for name in root.GetVariantSets().GetNames():
        variants = root.GetVariantSet(name)
        chosen = variants.GetVariantSelection()
        for other in variants.GetVariantNames():
            if other != chosen:
                _choose(stage, name, other)
                errors += [f"{name}={other}: {error}" for error in _stage_errors(stage) if error not in errors]
        _choose(stage, name, chosen)
    return [f"{Path(path).name}: {error}" for error in errors]


def _choose(stage: Usd.Stage, name: str, variant: str) -> None:
    """For this stage alone: nothing is written to its layers."""
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        stage.GetDefaultPrim().GetVariantSet(name).SetVariantSelection(variant)


def _stage_errors(stage: Usd.Stage) -> list[str]:
    errors = _validator_errors(stage)
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh) and UsdGeom.Imageable(prim).ComputePurpose() != UsdGeom.Tokens.guide:
            errors += _mesh_errors(UsdGeom.Mesh(prim))
        elif prim.IsA(UsdShade.Shader):
            errors += _shader_errors(UsdShade.Shader(prim))
        errors += _path_errors(prim)
    return errors


def package_errors(path: Path | str) -> list[str]:
    """What viewers for consumers ask of a .usdz beyond the validators: one binary layer, first, and plain pictures."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    errors = []
    layers = [name for name in names if Path(name).suffix in _LAYERS]
    if layers != names[:1] or not names[0].endswith(".usdc"):
        errors.append(f"expected one .usdc as the first member and no other layer, got {', '.join(layers) or 'none'}")
    strange = [name for name in names if Path(name).suffix not in (*_LAYERS, *_PICTURES)]
    if strange:
        errors.append(f"neither layers nor pictures: {', '.join(strange)}")
    stage = Usd.Stage.Open(str(path))
    if UsdGeom.GetStageUpAxis(stage) != UsdGeom.Tokens.y:
        errors.append("y is not up")
    for prim in stage.Traverse():
        if prim.IsA(UsdShade.Shader) and UsdShade.Shader(prim).GetShaderId() == "UsdPreviewSurface":
            errors += [f"{file} is no PNG or JPEG" for file in _shown_files(UsdShade.Shader(prim))
                       if Path(file).suffix not in (".png", ".jpg", ".jpeg")]
    return [f"{Path(path).name}: {error}" for error in errors]


def _shown_files(surface: UsdShade.Shader) -> list[str]:
    """The textures of what every viewer shows: colour, opacity, roughness and normal. (Many ignore the index of
    refraction.)"""
    inputs = [surface.GetInput(name) for name in ("diffuseColor", "opacity", "roughness", "normal")]
    sources = [port.GetConnectedSources()[0] for port in inputs if port and port.HasConnectedSource()]
    return [UsdShade.Shader(found[0].source.GetPrim()).GetInput("file").Get().path for found in sources]


def _validator_errors(stage: Usd.Stage) -> list[str]:
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    found = []
    for error in context.Validate(stage):
        identifier, message = str(error.GetIdentifier()), error.GetMessage()
        if identifier.endswith(_FALSE_ALARM) and f"'{MATERIALX_PREFIX}" in message:
            continue
        found.append(f"{identifier}: {message}")
    return sorted(found)


def _mesh_errors(prim: UsdGeom.Mesh) -> list[str]:
    path = prim.GetPath()
    counts = np.array(prim.GetFaceVertexCountsAttr().Get())
    indices = np.array(prim.GetFaceVertexIndicesAttr().Get())
    points = np.array(prim.GetPointsAttr().Get())
    primvars = UsdGeom.PrimvarsAPI(prim)
    coordinates, normals = primvars.GetPrimvar("st"), prim.GetNormalsAttr()
    smooth = prim.GetSubdivisionSchemeAttr().Get() == UsdGeom.Tokens.catmullClark
    sides = 4 if smooth else 3
    if set(counts) != {sides} or len(indices) != sides * len(counts):
        return [f"{path}: faces are not all {'quads' if smooth else 'triangles'}"]
    errors = []
    if smooth and normals.HasAuthoredValue():
        errors.append(f"{path}: normals of its own on a surface that subdivision makes")
    if primvars.GetPrimvar("normals"):
        errors.append(f"{path}: normals as a primvar, which no blend shape turns")
    if coordinates.GetInterpolation() != UsdGeom.Tokens.faceVarying or len(coordinates.GetIndices()) != len(indices):
        errors.append(f"{coordinates.GetAttr().GetPath()}: not one value per face corner")
    faces, face_uvs = (np.array(each).reshape(-1, sides) for each in (indices, coordinates.GetIndices()))
    if smooth:
        faces, face_uvs = triangulated(faces), triangulated(face_uvs)
    mesh = Mesh(points, faces, np.array(coordinates.Get()), face_uvs)
    errors += [f"{path}: {error}" for error in mesh_errors(mesh)]
    if not smooth:
        errors += _normal_errors(prim, len(points))
    extent = np.array(prim.GetExtentAttr().Get())
    if not np.allclose(extent, [points.min(0), points.max(0)], atol=1e-3):
        errors.append(f"{path}: extent does not enclose the points")
    return errors


def _normal_errors(prim: UsdGeom.Mesh, count: int) -> list[str]:
    normals = np.array(prim.GetNormalsAttr().Get() or ()).reshape(-1, 3)
    if prim.GetNormalsInterpolation() != UsdGeom.Tokens.vertex or len(normals) != count:
        return [f"{prim.GetPath()}: {len(normals)} normals of {count} points, expected one for each"]
    if np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() > 1e-3:
        return [f"{prim.GetPath()}: normals are not unit vectors"]
    return []


def _path_errors(prim: Usd.Prim) -> list[str]:
    """Asset paths have to be relative, or the folder cannot be moved."""
    errors = []
    for attribute in prim.GetAuthoredAttributes():
        if attribute.GetTypeName() != Sdf.ValueTypeNames.Asset:
            continue
        value = attribute.Get()
        if value and Path(value.path).is_absolute():
            errors.append(f"{attribute.GetPath()}: the path {value.path} is not relative")
    return errors


def _shader_errors(shader: UsdShade.Shader) -> list[str]:
    shader_id = shader.GetShaderId()
    if shader_id.startswith(MATERIALX_PREFIX):
        return _materialx_errors(shader, shader_id)
    normal = shader.GetInput("normal")
    if shader_id != "UsdPreviewSurface" or not normal or not normal.HasConnectedSource():
        return []
    texture = UsdShade.Shader(normal.GetConnectedSources()[0][0].source.GetPrim())
    scale, bias = texture.GetInput("scale").Get(), texture.GetInput("bias").Get()
    if scale != NORMAL_SCALE or bias != NORMAL_BIAS:
        return [f"{texture.GetPath()}: scale {scale} and bias {bias} do not decode a normal map"]
    return []


@lru_cache(maxsize=1)
def _materialx_library() -> mx.Document:
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    return library


def _materialx_errors(shader: UsdShade.Shader, shader_id: str) -> list[str]:
    definition = _materialx_library().getNodeDef(shader_id)
    if definition is None:
        return [f"{shader.GetPath()}: MaterialX {mx.getVersionString()} knows no node {shader_id}"]
    errors = []
    ports = [(port, definition.getActiveInput(port.GetBaseName())) for port in shader.GetInputs()]
    ports += [(port, definition.getActiveOutput(port.GetBaseName())) for port in shader.GetOutputs()]
    for port, defined in ports:
        where, usd_type = port.GetAttr().GetPath(), str(port.GetTypeName())
        if defined is None:
            errors.append(f"{where}: {shader_id} has no such port")
        elif usd_type not in _USD_TYPES.get(defined.getType(), ()):
            errors.append(f"{where}: type {usd_type}, MaterialX says {defined.getType()}")
    return errors
