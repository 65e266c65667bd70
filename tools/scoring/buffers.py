"""What a camera sees of a textured mesh, at chosen pixels: coverage, shading normals and texture values.

Values are averaged over the rays of a pixel that hit the mesh (a regular grid of sub x sub), as a box filter would.
"""

from __future__ import annotations

import numpy as np

from shared.geometry.mesh import Mesh, interpolate, normalised, vertex_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import camera_centres
from shared.imaging.texture import sample_bilinear


class BufferRenderer:
    """Ray-traces one mesh with any number of UV textures (name -> [H,W] or [H,W,3])."""

    def __init__(self, mesh: Mesh, textures: dict[str, np.ndarray]):
        self._mesh = mesh
        self._textures = textures
        self._normals = vertex_normals(mesh.vertices, mesh.faces)
        self._scene = RayScene(mesh.vertices, mesh.faces)

    def view(
        self, camera_from_head: np.ndarray, intrinsics: np.ndarray, pixels: np.ndarray, sub: int = 2
    ) -> dict[str, np.ndarray]:
        """pixels [N,2] (column, row) -> coverage [N] in [0,1], normal [N,3] (head space, unit) and each texture.

        camera_from_head [4,4], intrinsics [3,3]. Pixels that no ray of which hits hold zeros.
        """
        total = self._empty(len(pixels))
        for offset in np.ndindex(sub, sub):
            index, values = self._trace(camera_from_head, intrinsics, pixels + (np.array(offset) + 0.5) / sub)
            total["coverage"][index] += 1.0
            for name, value in values.items():
                total[name][index] += value
        count = np.maximum(total["coverage"], 1.0)
        for name in self._textures:
            total[name] /= count.reshape((-1,) + (1,) * (total[name].ndim - 1))
        total["normal"] = normalised(total["normal"])
        total["coverage"] /= sub * sub
        return total

    def _empty(self, count: int) -> dict[str, np.ndarray]:
        shapes = {name: texture.shape[2:] for name, texture in self._textures.items()}
        return {name: np.zeros((count, *shape)) for name, shape in {"coverage": (), "normal": (3,), **shapes}.items()}

    def _trace(
        self, camera_from_head: np.ndarray, intrinsics: np.ndarray, points_px: np.ndarray
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """One ray per image point [N,2]: indices of the hits [M] and the surface's values there."""
        centre, focal = intrinsics[:2, 2], intrinsics[[0, 1], [0, 1]]
        directions = np.concatenate([(points_px - centre) / focal, np.ones((len(points_px), 1))], 1)
        origins = np.broadcast_to(camera_centres(camera_from_head), directions.shape)
        face, bary, _ = self._scene.intersect(origins, directions @ camera_from_head[:3, :3])
        index = np.nonzero(face >= 0)[0]
        face, bary = face[index], bary[index].astype(np.float64)
        uv = interpolate(self._mesh.uvs, self._mesh.face_uvs, face, bary)
        values = {name: sample_bilinear(texture, uv) for name, texture in self._textures.items()}
        values["normal"] = normalised(interpolate(self._normals, self._mesh.faces, face, bary))
        return index, values
