"""Meshes on disk: .npz between the stages (exact), Wavefront .obj for people and other programs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TextIO

import numpy as np

from shared.errors import InputError
from shared.geometry.eyeballs import Eyeball
from shared.geometry.mesh import Mesh
from shared.geometry.parts import part_runs
from shared.io.arrays import load_arrays, save_arrays


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


def write_obj(path: Path | str, mesh: Mesh, eyes: Sequence[Eyeball] = ()) -> None:
    """Vertices in millimetres of head space with four decimals, UVs with six, one-based indices; with the right and the
    left eyeball, groups for the head and each of them. Faces stay in the mesh's order."""
    corners = np.stack([mesh.faces, mesh.face_uvs], axis=-1).reshape(len(mesh.faces), -1) + 1
    with open(path, "w", encoding="ascii") as file:
        file.write("# head space, millimetres; x right seen from the front, y up, z out of the face\n")
        _write_rows(file, "v %.4f %.4f %.4f\n", mesh.vertices)
        _write_rows(file, "vt %.6f %.6f\n", mesh.uvs)
        for name, first, after in part_runs(len(corners), eyes):
            if eyes:
                file.write(f"g {name}\n")
            _write_rows(file, "f %d/%d %d/%d %d/%d\n", corners[first:after])


def _write_rows(file: TextIO, line: str, rows: np.ndarray) -> None:
    file.write(line * len(rows) % tuple(rows.ravel().tolist()))


def read_obj(path: Path | str) -> Mesh:
    """Reads v, vt and f; polygons are split into fans. A mesh without UVs gets one at the origin. InputError for lines
    that are no numbers, and as load_mesh."""
    rows: dict[str, list[list[str]]] = {"v": [], "vt": [], "f": []}
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError as error:
        raise InputError("file is missing", where=str(path)) from error
    for line in lines:
        kind, *fields = line.split() or [""]
        if kind in rows:
            rows[kind].append(fields)
    try:
        vertices, uvs = _numbers(rows["v"], 3), _numbers(rows["vt"] or [["0", "0"]], 2)
        corners = _fans(rows["f"])
    except (ValueError, OverflowError) as error:
        raise InputError("not a mesh that can be read", where=str(path), got=error) from error
    if not len(vertices) or not len(corners):
        raise InputError("no vertices or no faces in the mesh", where=str(path))
    faces, face_uvs = (_zero_based(corners[..., k], count) for k, count in enumerate((len(vertices), len(uvs))))
    return _checked(Mesh(vertices, faces, uvs, face_uvs), path)


def read_obj_groups(path: Path | str) -> dict[str, np.ndarray]:
    """{name: faces [n] int, in the file's order} of the groups that write_obj wrote."""
    groups, own, count = {}, [], 0
    with open(path, encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("g "):
                own = groups.setdefault(line[2:].strip(), [])
            elif line.startswith("f "):
                own.append(count)
                count += 1
    return {name: np.array(faces, int) for name, faces in groups.items()}


def _numbers(rows: list[list[str]], count: int) -> np.ndarray:
    """The first count fields of each row [N, count]; ValueError where there are fewer, or others than numbers."""
    fields = chain.from_iterable(row[:count] for row in rows)
    return np.fromiter(map(float, fields), float).reshape(len(rows), count)


def _fans(polygons: list[list[str]]) -> np.ndarray:
    """Corners like 7, 7/3, 7/3/9 or 7//9 of polygons -> one-based vertex and UV of triangles, [F, 3, 2]."""
    flat = list(chain.from_iterable(polygons))
    known = {field: [int(index) if index else 1 for index in (field.split("/") + ["1"])[:2]] for field in set(flat)}
    corners = np.array([known[field] for field in flat], np.int64).reshape(-1, 2)
    sizes = np.array([len(polygon) for polygon in polygons], np.int64)
    triangles = np.maximum(sizes - 2, 0)
    first = np.repeat(np.cumsum(sizes) - sizes, triangles)
    number = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return corners[np.stack([first, first + number + 1, first + number + 2], axis=1)]


def _zero_based(indices: np.ndarray, count: int) -> np.ndarray:
    return np.where(indices < 0, indices + count, indices - 1)


def _checked(mesh: Mesh, path: Path | str) -> Mesh:
    for name, array, width, kinds in (("vertices", mesh.vertices, 3, "fiu"), ("uvs", mesh.uvs, 2, "fiu"),
                                      ("faces", mesh.faces, 3, "iu"), ("face_uvs", mesh.face_uvs, 3, "iu")):
        if array.dtype.kind not in kinds or array.ndim != 2 or array.shape[1] != width or not len(array):
            raise InputError(f"{name} are no part of a mesh", where=str(path), got=f"{array.dtype} {array.shape}",
                             expected=f"{'whole numbers' if kinds == 'iu' else 'numbers'} [n, {width}]")
    if len(mesh.faces) != len(mesh.face_uvs):
        raise InputError("not as many triangles of the texture as of the mesh", where=str(path), got=len(mesh.face_uvs),
                         expected=len(mesh.faces))
    for name, indices, count in (
        ("faces", mesh.faces, len(mesh.vertices)),
        ("face_uvs", mesh.face_uvs, len(mesh.uvs)),
    ):
        if indices.min() < 0 or indices.max() >= count:
            raise InputError(f"{name} point outside the array", where=str(path), got=indices.max(), expected=count - 1)
    for name, array in (("vertices", mesh.vertices), ("uvs", mesh.uvs)):
        if not np.isfinite(array).all():
            raise InputError(f"{name} are not finite", where=str(path))
    return mesh.replace(faces=mesh.faces.astype(np.int32), face_uvs=mesh.face_uvs.astype(np.int32))
