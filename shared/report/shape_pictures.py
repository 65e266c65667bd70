"""The shape for people: the refined mesh shaded and as normals, the start, and how far the one lies from the other."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from shared.geometry.mesh import Mesh, interpolate, normalised, vertex_normals
from shared.geometry.raycast import RayScene, camera_hits
from shared.geometry.transforms import WORLD_FROM_CAMERA, rigid, rotation_from_vector

YAWS_DEG = (0.0, -40.0, -90.0)
"""Front, three-quarter and side."""
LAMP = normalised(np.array([-0.6, 0.5, 0.6]))
"""Where the light comes from, in the camera's space turned y up."""
LARGEST_DIFFERENCE_MM = 1.0
DISTANCE = 8.0
"""The camera's distance in heights of the face: next to no perspective."""
BACKDROP, INK = 34, (225, 225, 225)
SAMPLES = 2


@dataclass(frozen=True)
class _Shape:
    """A mesh with its vertex normals [V, 3], ready for rays."""

    mesh: Mesh
    normals: np.ndarray
    scene: RayScene

    @staticmethod
    def of(mesh: Mesh) -> _Shape:
        return _Shape(mesh, vertex_normals(mesh.vertices, mesh.faces), RayScene(mesh.vertices, mesh.faces))


def shape_sheet(start: Mesh, mesh: Mesh, face: np.ndarray | None, size: int = 400) -> np.ndarray:
    """uint8 [4 size, 3 size, 3]: rows start, mesh, its normals, difference; front, three-quarter and side.

    The meshes share their topology; face [faces] bool: what the pictures are centred on, None: all.
    """
    inside = mesh.vertices if face is None else mesh.vertices[np.unique(mesh.faces[face])]
    low, high = inside.min(0), inside.max(0)
    centre, extent = 0.5 * (low + high), 1.25 * float((high - low)[1])
    before = _Shape.of(start)
    after = before if np.array_equal(start.vertices, mesh.vertices) else _Shape.of(mesh)
    columns = [_views(before, after, np.radians(yaw), centre, extent, size) for yaw in YAWS_DEG]
    sheet = np.concatenate(columns, axis=1)
    names = ("start", "refined", "normals", f"refined - start: red {LARGEST_DIFFERENCE_MM:g} mm out, blue in")
    for row, name in enumerate(names):
        place = 8, row * size + 18
        for ink, width in ((3 * (BACKDROP,), 4), (INK, 1)):  # dark around it, since skin may lie behind
            cv2.putText(sheet, name, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, ink, width, cv2.LINE_AA)
    return sheet


def shaded_picture(mesh: Mesh, yaw: float, centre: np.ndarray, extent: float, size: int) -> np.ndarray:
    """uint8 [size, size, 3]: the mesh in grey under the pictures' lamp; camera as turned_camera has it. centre [3]
    mm. yaw: as there; extent: of the picture, mm."""
    return _shaded(_Shape.of(mesh), *turned_camera(yaw, centre, extent, size), size)


def turned_camera(yaw: float, centre: np.ndarray, extent: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """camera_from_head [4, 4] and intrinsics [3, 3] of a picture of size^2 pixels, extent mm wide at the centre [3],
    from far away; yaw in radians, 0: from the front."""
    turn = WORLD_FROM_CAMERA @ rotation_from_vector(np.array([0.0, yaw, 0.0]))
    lens = np.array([[DISTANCE * size, 0.0, size / 2], [0.0, DISTANCE * size, size / 2], [0.0, 0.0, 1.0]])
    return rigid(turn, -turn @ centre + [0.0, 0.0, DISTANCE * extent]), lens


def _views(before: _Shape, after: _Shape, yaw, centre, extent, size) -> np.ndarray:
    """The four pictures of one direction, [4 size, size, 3]."""
    pose, lens = turned_camera(yaw, centre, extent, size)
    to_picture = pose[:3, :3].T @ WORLD_FROM_CAMERA
    raised = ((after.mesh.vertices - before.mesh.vertices) * before.normals).sum(1)
    share = np.clip(raised / LARGEST_DIFFERENCE_MM, -1.0, 1.0)[:, None]
    difference = 1.0 - np.maximum(share, 0.0) * [0.0, 1.0, 1.0] + np.minimum(share, 0.0) * [1.0, 1.0, 0.0]
    normals = after.normals @ to_picture
    values = np.concatenate([_shade(normals), 0.5 * normals + 0.5, difference], axis=1)
    refined = np.split(_drawn(after, values, pose, lens, size), 3, axis=2)
    first = refined[0] if after is before else _shaded(before, pose, lens, size)
    return np.concatenate([first, *refined])


def _shaded(shape: _Shape, pose: np.ndarray, lens: np.ndarray, size: int) -> np.ndarray:
    return _drawn(shape, _shade(shape.normals @ pose[:3, :3].T @ WORLD_FROM_CAMERA), pose, lens, size)


def _shade(normals: np.ndarray) -> np.ndarray:
    return np.repeat(0.1 + 0.85 * np.maximum(normals @ LAMP, 0.0)[:, None], 3, axis=1)


def _drawn(shape: _Shape, values: np.ndarray, pose: np.ndarray, lens: np.ndarray, size: int) -> np.ndarray:
    """Vertex values [V, C] in 0 .. 1 as the camera sees them, uint8 [size, size, C]."""
    total = 0.0
    for offset in np.ndindex(SAMPLES, SAMPLES):
        offsets = tuple((np.array(offset) + 0.5) / SAMPLES)
        face, bary, _ = camera_hits(shape.scene, pose, lens, size, size, offsets)
        picture = np.full((size, size, values.shape[1]), BACKDROP / 255.0)
        hit = face >= 0
        picture[hit] = interpolate(values, shape.mesh.faces, face[hit], bary[hit])
        total = total + picture / SAMPLES**2
    return np.clip(np.round(total * 255.0), 0, 255).astype(np.uint8)
