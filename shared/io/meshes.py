"""Meshes on disk: .npz between the stages (exact), Wavefront .obj for people and other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shared.errors import InputError
from shared.io.arrays import load_arrays, save_arrays
from shared.mesh import Mesh


def save_mesh(path: Path | str, mesh: Mesh, **extra: np.ndarray) -> None:
    """vertices float64, the rest as int32 and float64; extra arrays (such as face_segment [F]) beside them."""
    save_arrays(
        path,
        vertices=np.asarray(mesh.vertices, np.float64),
        faces=np.asarray(mesh.faces, np.int32),
        uvs=np.asarray(mesh.uvs, np.float64),
        face_uvs=np.asarray(mesh.face_uvs, np.int32),
        **extra,
    )


def load_mesh(path: Path | str) -> Mesh:
    """InputError when the file is missing or its indices point outside its arrays."""
    arrays = load_arrays(path)
    missing = [name for name in ("vertices", "faces", "uvs", "face_uvs") if name not in arrays]
    if missing:
        raise InputError("mesh arrays are missing", where=str(path), got=", ".join(sorted(arrays)), expected=missing)
    return _checked(Mesh(*(arrays[name] for name in ("vertices", "faces", "uvs", "face_uvs"))), path)


def write_obj(path: Path | str, mesh: Mesh) -> None:
    """Vertices in millimetres of head space with four decimals, UVs with six, one-based indices."""
    corners = np.stack([mesh.faces, mesh.face_uvs], axis=-1).reshape(len(mesh.faces), -1) + 1
    with open(path, "w", encoding="ascii") as file:
        file.write("# head space, millimetres; x right seen from the front, y up, z out of the face\n")
        np.savetxt(file, mesh.vertices, fmt="v %.4f %.4f %.4f")
        np.savetxt(file, mesh.uvs, fmt="vt %.6f %.6f")
        np.savetxt(file, corners, fmt="f %d/%d %d/%d %d/%d")


def read_obj(path: Path | str) -> Mesh:
    """Reads v, vt and f; polygons are split into fans. A mesh without UVs gets one at the origin."""
    vertices, uvs, faces, face_uvs = [], [], [], []
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError as error:
        raise InputError("file is missing", where=str(path)) from error
    for line in lines:
        kind, *fields = line.split() or [""]
        if kind == "v":
            vertices.append([float(field) for field in fields[:3]])
        elif kind == "vt":
            uvs.append([float(field) for field in fields[:2]])
        elif kind == "f":
            corners = [[int(index) if index else 1 for index in (field.split("/") + ["1"])[:2]] for field in fields]
            for k in range(1, len(corners) - 1):
                fan = (corners[0], corners[k], corners[k + 1])
                faces.append([corner[0] for corner in fan])
                face_uvs.append([corner[1] for corner in fan])
    if not vertices or not faces:
        raise InputError("no vertices or no faces in the mesh", where=str(path))
    uvs = np.array(uvs or [[0.0, 0.0]])
    return _checked(
        Mesh(np.array(vertices), _zero_based(faces, len(vertices)), uvs, _zero_based(face_uvs, len(uvs))), path
    )


def _zero_based(indices: list[list[int]], count: int) -> np.ndarray:
    indices = np.array(indices, np.int32)
    return np.where(indices < 0, indices + count, indices - 1).astype(np.int32)


def _checked(mesh: Mesh, path: Path | str) -> Mesh:
    for name, indices, count in (
        ("faces", mesh.faces, len(mesh.vertices)),
        ("face_uvs", mesh.face_uvs, len(mesh.uvs)),
    ):
        if indices.min() < 0 or indices.max() >= count:
            raise InputError(f"{name} point outside the array", where=str(path), got=indices.max(), expected=count - 1)
    if not np.isfinite(mesh.vertices).all():
        raise InputError("vertices are not finite", where=str(path))
    return mesh
