"""Meshes in USD: the head, and the card behind it that shows the clip."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from shared.geometry.mesh import Mesh, vertex_normals


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
    normals.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(shading_normals(mesh), np.float32)))
    normals.SetIndices(faces)
    return prim


def shading_normals(mesh: Mesh) -> np.ndarray:
    """[V, 3] unit normals; where there are only faces without area around a vertex, any unit vector."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 0.0, 1.0)
    return normals


def define_card(stage: Usd.Stage, path: str, corners: np.ndarray) -> UsdGeom.Mesh:
    """A textured quadrilateral of purpose guide: tools show it on request, renders and bounds leave it out.

    corners [4, 3]: bottom left, bottom right, top right, top left of the picture.
    """
    prim = UsdGeom.Mesh.Define(stage, path)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(corners, np.float32))
    prim.CreatePointsAttr(points)
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray([0, 1, 2, 3]))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray([4]))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    prim.CreatePurposeAttr(UsdGeom.Tokens.guide)
    coordinates = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    coordinates.Set(Vt.Vec2fArray([Gf.Vec2f(0, 0), Gf.Vec2f(1, 0), Gf.Vec2f(1, 1), Gf.Vec2f(0, 1)]))
    return prim
