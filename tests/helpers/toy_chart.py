"""Pictures of a colour chart drawn for the tests: a plane in front of a wavy wall, in exact perspective."""

from __future__ import annotations

import cv2
import numpy as np

from shared.capture.chart import COLUMNS, CORNERS, ROWS, reflectances
from shared.geometry.transforms import rotation_from_vector
from shared.imaging.color import encode_srgb

CENTRED = np.array([-COLUMNS / 2, -ROWS / 2, 0.0])


def chart_pose(turn_deg: float = 0.0, tilt_deg: float = 0.0, nod_deg: float = 0.0) -> np.ndarray:
    """camera_from_grid rotation [3, 3]: turned in the picture's plane, then about the vertical and sideways axes."""
    angles = np.radians(np.diag([nod_deg, tilt_deg, turn_deg]))
    nod, tilt, turn = (rotation_from_vector(row) for row in angles)
    return nod @ tilt @ turn


def draw_chart(white=(0.9, 0.75, 0.5), pitch_px: float = 24.0, rotation: np.ndarray | None = None,
               size: tuple[int, int] = (360, 240), focal_px: float = 900.0, gap: float = 0.1, noise: float = 0.006,
               centre: tuple[float, float] | None = None, seed: int = 0,
               patches: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """uint8 sRGB [H, W, 3] and the grid's corners [4, 2] px. white [3]: irradiance over pi on the chart."""
    width, height = size
    rotation = np.eye(3) if rotation is None else rotation
    middle = np.array(centre if centre else (width / 2, height / 2))
    towards = np.append((middle - [width / 2, height / 2]) / focal_px, 1.0) * focal_px / pitch_px

    def project(grid: np.ndarray) -> np.ndarray:
        points = (np.c_[grid, np.zeros(len(grid))] + CENTRED) @ rotation.T + towards
        return points[:, :2] / points[:, 2:] * focal_px + [width / 2, height / 2]

    corners = project(CORNERS)
    fine = 3
    image_from_grid = cv2.getPerspectiveTransform(CORNERS.astype(np.float32), corners.astype(np.float32))
    pixels = (np.stack(np.meshgrid(np.arange(width * fine), np.arange(height * fine)), -1) + 0.5) / fine
    grid = cv2.perspectiveTransform(pixels.reshape(-1, 1, 2), np.linalg.inv(image_from_grid)).reshape(pixels.shape)
    inside = (grid > -0.3).all(-1) & (grid < (COLUMNS + 0.3, ROWS + 0.3)).all(-1)
    cell = np.floor(grid).astype(int)
    in_patch = (np.abs(grid - cell - 0.5) < 0.5 - gap / 2).all(-1) & (cell >= 0).all(-1)
    in_patch &= (cell < (COLUMNS, ROWS)).all(-1)
    wall = 0.25 + 0.1 * np.sin(pixels[..., 0] / 37.0 + pixels[..., 1] / 51.0)
    picture = np.repeat(wall[..., None], 3, -1)
    picture[inside] = 0.02
    colours = reflectances() if patches is None else patches
    picture[in_patch] = colours[(cell[..., 1] * COLUMNS + cell[..., 0])[in_patch]] * np.array(white)
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    rng = np.random.default_rng(seed)
    picture = picture + noise * np.sqrt(np.clip(picture, 0, 1)) * rng.normal(size=picture.shape)
    return np.uint8(np.round(255 * encode_srgb(np.clip(picture, 0, 1)))), corners
