"""The tracking stage's pictures: mesh and landmarks over frames, curves of the motion, the residual map."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from shared.geometry.eyeballs import SIDES
from shared.geometry.mesh import Mesh, mesh_edges, rasterize_uv, vertex_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import WORLD_FROM_CAMERA, project, vector_from_rotation
from shared.tracking.gaze import Gaze
from shared.tracking.tracks import visible_vertices

MESH_COLOUR, LANDMARK_COLOUR = (70, 220, 255), (255, 150, 40)
CURVE_COLOURS = ((70, 200, 255), (255, 150, 40), (120, 220, 120))
PLOT_WIDTH, PLOT_HEIGHT, MARGIN = 900, 220, 56
BRIGHTEST_PX = 0.5
INK, PAPER, GRID = (225, 225, 225), (24, 24, 28), (60, 60, 66)


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


def pose_curves(
    camera_from_head: np.ndarray, covariance: np.ndarray, time_s: np.ndarray, gaze: Gaze | None = None
) -> np.ndarray:
    """Rotation and position over time with bands of two standard deviations, and the gaze of both eyes where given ->
    uint8 [h, w, 3].

    camera_from_head [F, 4, 4]; covariance [F, 6, 6] of rotation vector and translation; time_s [F].
    """
    turns = WORLD_FROM_CAMERA @ camera_from_head[:, :3, :3]
    middle = turns[len(turns) // 2]
    angles = np.degrees(vector_from_rotation(turns @ middle.T))
    shift = camera_from_head[:, :3, 3] - np.median(camera_from_head[:, :3, 3], axis=0)
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    rotation = _plot(time_s, angles, np.degrees(deviation[:, :3]), ("pitch", "yaw", "roll"), "degrees")
    doubt = _plot(time_s, np.degrees(deviation[:, :3]), None, ("pitch", "yaw", "roll"), "deviation, degrees")
    position = _plot(time_s, shift, deviation[:, 3:], ("across", "down", "depth"), "mm")
    panels = [rotation, doubt, position]
    if gaze is not None:
        for axis, name in enumerate(("yaw", "pitch")):
            values, own = (np.degrees(kind[:, :, axis]) for kind in (gaze.gaze, gaze.own_sigma))
            panels.append(_plot(time_s, values, own, tuple(f"{side} {name}" for side in SIDES), "gaze, degrees"))
    return np.concatenate(panels)


def _plot(time_s, values, deviation, names, unit) -> np.ndarray:
    """Two or three curves [F, K] on one panel, with gaps where they are NaN; deviation [F, K] or None."""
    canvas = np.full((PLOT_HEIGHT, PLOT_WIDTH, 3), PAPER, np.uint8)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    low, high = (low - 0.05 * (high - low), high + 0.05 * (high - low)) if high > low else (low - 1.0, high + 1.0)
    span_s = max(float(np.ptp(time_s)), 1e-6)

    def at(t, value):
        x = MARGIN + (t - time_s[0]) / span_s * (PLOT_WIDTH - MARGIN - 12)
        y = PLOT_HEIGHT - 24 - (value - low) / (high - low) * (PLOT_HEIGHT - 44)
        return np.stack([x, y], axis=-1)

    def sixteenths(places):  # a point that lies between two pixels would fall to either one by the processor
        return np.rint(16.0 * places).astype(np.int32)

    for value in np.linspace(low, high, 5):
        y = round(float(at(time_s[0], value)[1]))  # it is a whole number or nearly so
        cv2.line(canvas, (MARGIN, y), (PLOT_WIDTH - 12, y), GRID, 1)
        cv2.putText(canvas, f"{value:.3g}", (4, y + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, INK, 1, cv2.LINE_AA)
    for k, (name, colour) in enumerate(zip(names, CURVE_COLOURS[: len(names)], strict=True)):
        for part in np.ma.clump_unmasked(np.ma.masked_invalid(values[:, k])):
            if deviation is not None:
                reach = 2 * deviation[part, k]
                upper, lower = (at(time_s[part], values[part, k] + side * reach) for side in (1, -1))
                band = canvas.copy()
                cv2.fillPoly(band, [sixteenths(np.concatenate([upper, lower[::-1]]))], colour, cv2.LINE_AA, 4)
                canvas = cv2.addWeighted(band, 0.35, canvas, 0.65, 0.0)
            line = sixteenths(at(time_s[part], values[part, k]))
            cv2.polylines(canvas, [line], False, colour, 1, cv2.LINE_AA, 4)
        cv2.putText(canvas, name, (MARGIN + 90 * k, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    label = f"{unit} over {span_s:.1f} s"
    cv2.putText(canvas, label, (PLOT_WIDTH - 260, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return canvas


def residual_map(mesh: Mesh, points: np.ndarray, residual_px: np.ndarray, size: int = 512) -> np.ndarray:
    """Each track point's error in the mesh's UV layout -> uint8 [size, size, 3], dark: none, bright: 0.5 px or more.

    points [N, 3] in the mesh's space, residual_px [N].
    """
    face, bary = rasterize_uv(mesh, size)
    canvas = np.full((size, size, 3), PAPER, np.uint8)
    canvas[face >= 0] = GRID
    rows, columns = np.nonzero(face >= 0)
    places = np.einsum("nki,nk->ni", mesh.vertices[mesh.faces[face[rows, columns]]], bary[rows, columns])
    brightness = np.clip(np.nan_to_num(residual_px) / BRIGHTEST_PX * 255, 0, 255).astype(np.uint8)
    shade = cv2.applyColorMap(brightness[:, None], cv2.COLORMAP_INFERNO)[:, 0]
    nearest = _nearest(places, points)
    for index in np.nonzero(np.isfinite(residual_px))[0]:
        centre = int(columns[nearest[index]]), int(rows[nearest[index]])
        cv2.circle(canvas, centre, max(2, size // 170), shade[index][::-1].tolist(), -1, cv2.LINE_AA)
    return canvas


def _nearest(places: np.ndarray, points: np.ndarray) -> np.ndarray:
    return cKDTree(places).query(points)[1]
