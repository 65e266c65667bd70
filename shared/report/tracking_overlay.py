"""The tracking stage's picture: the fitted mesh and the landmarks drawn over frames."""

from __future__ import annotations

import cv2
import numpy as np

from shared.geometry.mesh import Mesh, mesh_edges, vertex_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import project
from shared.tracking.tracks import visible_vertices

MESH_COLOUR, LANDMARK_COLOUR = (70, 220, 255), (255, 150, 40)


def overlay_strip(
    pictures: list[np.ndarray], mesh: Mesh, poses: list[np.ndarray], intrinsics: np.ndarray, landmarks_px: np.ndarray
) -> np.ndarray:
    """Frames [H, W, 3] uint8 side by side with the mesh's visible edges; landmarks_px [n, 468, 2] -> one picture."""
    scene = RayScene(mesh.vertices, mesh.faces)
    drawn = [
        draw_overlay(picture, mesh, scene, pose, intrinsics, points)
        for picture, pose, points in zip(pictures, poses, landmarks_px, strict=True)
    ]
    return np.concatenate(drawn, axis=1)


def draw_overlay(picture, mesh: Mesh, scene: RayScene, camera_from_head, intrinsics, landmarks_px) -> np.ndarray:
    """One frame with the mesh's edges where they face the camera, and the landmarks as dots."""
    zoom = max(1, round(720 / picture.shape[0]))
    canvas = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    visible = visible_vertices(scene, mesh.vertices, normals, camera_from_head, 0.05)
    pixels = project(mesh.vertices, camera_from_head, intrinsics)[0] * zoom
    lines = canvas.copy()
    edges = _coarse_edges(mesh.faces)
    cv2.polylines(lines, list(_fixed(pixels)[edges[visible[edges].all(1)]]), False, MESH_COLOUR, 1, cv2.LINE_AA, 4)
    canvas = cv2.addWeighted(lines, 0.45, canvas, 0.55, 0.0)
    for point in _fixed(landmarks_px * zoom).tolist():
        cv2.circle(canvas, point, 16, LANDMARK_COLOUR, -1, cv2.LINE_AA, 4)
    return canvas


def _coarse_edges(faces: np.ndarray) -> np.ndarray:
    """Edges [E, 2] of the mesh before its last subdivision, whose four children stand together, corners first."""
    coarse = faces.reshape(-1, 4, 3)
    corners = np.stack([coarse[:, 0, 0], coarse[:, 1, 1], coarse[:, 2, 2]], axis=1)
    return mesh_edges(corners)[0]


def _fixed(points: np.ndarray) -> np.ndarray:
    """Pixels [..., 2] with centres at + 0.5 as OpenCV's fixed point with four fractional bits, int32."""
    return np.rint(np.clip((points - 0.5) * 16.0, -1e6, 1e6)).astype(np.int32)
