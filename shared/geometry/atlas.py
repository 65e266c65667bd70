"""The head's texture atlas as the common layout of all frames: where each texel lies in each picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse as sparse

from shared.geometry.mesh import Mesh, face_normals, rasterize_uv
from shared.geometry.transforms import project

LARGEST_ATLAS = 2048
BORDER_TEXELS = 4


@dataclass(frozen=True)
class Atlas:
    """Texels [h, w] on a surface of V vertices; matrix [h w, V] interpolates, valid [h, w] bool.

    rows, columns [N]: the texels that are tracked; corners [N, 3] and bary [N, 3]: the same as points of the surface.
    """

    matrix: sparse.csr_matrix
    valid: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    corners: np.ndarray
    bary: np.ndarray

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Vertex values [V, C] -> texel values [h, w, C] float32, 0 outside."""
        return (self.matrix @ values.astype(np.float32)).reshape(*self.valid.shape, -1)

    def points(self, vertices: np.ndarray) -> np.ndarray:
        """The tracked texels as points [N, 3] of the surface with these vertices [V, 3]."""
        return np.einsum("nki,nk->ni", vertices[self.corners], self.bary)


def build_atlas(mesh: Mesh, usable_face: np.ndarray, texel_mm: float, count: int) -> Atlas:
    """Atlas of the usable faces [F] bool, texels of about texel_mm; about `count` are tracked, evenly spread.
    usable_face [F] bool."""
    used = np.nonzero(usable_face)[0]
    uv = mesh.uvs[mesh.face_uvs[used]]
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    uv_area = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum()
    area = 0.5 * np.linalg.norm(face_normals(mesh.vertices, mesh.faces[used]), axis=1).sum()
    size = int(np.clip(np.sqrt(area / uv_area) / texel_mm, 64, LARGEST_ATLAS))
    face, bary = rasterize_uv(mesh.replace(face_uvs=mesh.face_uvs[used]), size)
    covered_rows, covered_columns = np.nonzero((face >= 0).any(1))[0], np.nonzero((face >= 0).any(0))[0]
    box = slice(covered_rows[0], covered_rows[-1] + 1), slice(covered_columns[0], covered_columns[-1] + 1)
    face, bary = face[box], bary[box]
    valid = face >= 0
    texels = np.nonzero(valid.ravel())[0]
    corners = mesh.faces[used][face.ravel()[texels]]
    matrix = sparse.csr_matrix(
        (bary.reshape(-1, 3)[texels].ravel(), (np.repeat(texels, 3), corners.ravel())),
        shape=(valid.size, len(mesh.vertices)),
    )
    rows, columns = _tracked_texels(valid, count)
    at = mesh.faces[used][face[rows, columns]]
    return Atlas(matrix, valid, rows, columns, at, bary[rows, columns].astype(np.float64))


def _tracked_texels(valid: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    kernel = np.ones((2 * BORDER_TEXELS + 1,) * 2, np.uint8)
    inside = cv2.erode(np.pad(valid.astype(np.uint8), 1), kernel)[1:-1, 1:-1]
    step = max(2, int(np.sqrt(inside.sum() / max(count, 1))))
    rows, columns = np.mgrid[step // 2 : valid.shape[0] : step, step // 2 : valid.shape[1] : step]
    chosen = inside[rows, columns] > 0
    return rows[chosen], columns[chosen]


@dataclass(frozen=True)
class PlacedFrame:
    """One frame in the atlas: layout [h, w, 2] px where its texels lie, shown [h, w] float32, 1 where it shows them."""

    layout: np.ndarray
    shown: np.ndarray


def place_frame(
    atlas: Atlas,
    vertices: np.ndarray,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    visible: np.ndarray,
    unusable: np.ndarray,
) -> PlacedFrame:
    """Where a frame shows the atlas. visible [V] bool: vertices it sees; unusable [H, W] uint8: pixels it spoils."""
    pixels, _ = project(vertices, camera_from_head, intrinsics)
    values = atlas.spread(np.concatenate([pixels, visible[:, None]], axis=1))
    layout = np.ascontiguousarray(values[..., :2])
    shown = (values[..., 2] > 0.99) & atlas.valid
    shown &= sample(unusable, layout, cv2.INTER_NEAREST, outside=1) == 0
    return PlacedFrame(layout, shown.astype(np.float32))


def sample(image: np.ndarray, layout: np.ndarray, method: int = cv2.INTER_LINEAR, outside: float = 0) -> np.ndarray:
    """Values of an image [H, W, ...] at positions layout [h, w, 2] in pixels with centres at + 0.5. outside: the
    value beyond the image."""
    x, y = layout[..., 0].astype(np.float32) - 0.5, layout[..., 1].astype(np.float32) - 0.5
    return cv2.remap(image, x, y, method, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)
