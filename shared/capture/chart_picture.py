"""A small picture for people: the chart as found, and within each patch the colour that it should have had."""

from __future__ import annotations

import cv2
import numpy as np

from shared.capture.chart import COLUMNS, CORNERS, ROWS, ChartFit, reflectances
from shared.capture.chart_finder import ChartDetection, homography
from shared.imaging.color import encode_srgb

PICTURE_PX = 640
GRID_COLOUR, FAULT_COLOUR = (0, 220, 90), (230, 40, 40)
MARGIN = 0.25
"""What is shown around the chart, as a share of its longer side."""


def draw_chart(rgb: np.ndarray, view: ChartDetection, fit: ChartFit, fault: str) -> np.ndarray:
    """uint8 sRGB [H, W, 3] around the chart of a frame: grid green where it is used, red where it is not; a square in
    each patch shows its stated reflectance under the light that was read."""
    reach = MARGIN * float(np.ptp(view.corners, axis=0).max())
    low = np.maximum(np.floor(view.corners.min(0) - reach), 0).astype(int)
    high = np.minimum(np.ceil(view.corners.max(0) + reach), rgb.shape[1::-1]).astype(int)
    part = rgb[low[1]:high[1], low[0]:high[0]]
    scale = PICTURE_PX / max(part.shape[:2])
    size = max(1, round(part.shape[1] * scale)), max(1, round(part.shape[0] * scale))
    picture = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    from_grid = homography((view.corners - low) * scale)
    expected = np.rint(255 * encode_srgb(reflectances() * np.maximum(fit.white, 0.0))).astype(int)
    for patch, colour in enumerate(expected):
        centre = np.array([patch % COLUMNS, patch // COLUMNS]) + 0.5
        _polygon(picture, from_grid, centre + 0.18 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), colour, True)
    line = FAULT_COLOUR if fault else GRID_COLOUR
    for column in range(COLUMNS + 1):
        _polygon(picture, from_grid, np.array([[column, 0], [column, ROWS]]), line)
    for row in range(ROWS + 1):
        _polygon(picture, from_grid, np.array([[0, row], [COLUMNS, row]]), line)
    start = cv2.perspectiveTransform(CORNERS[:1].reshape(-1, 1, 2), from_grid).reshape(2)
    cv2.circle(picture, tuple(np.rint(start).astype(int).tolist()), 5, line, 2)
    return picture


def _polygon(picture: np.ndarray, from_grid: np.ndarray, points: np.ndarray, colour, filled: bool = False) -> None:
    pixels = cv2.perspectiveTransform(points.reshape(-1, 1, 2).astype(float), from_grid)
    corners = np.rint((pixels - 0.5) * 16).astype(np.int32)
    colour = tuple(int(value) for value in colour)
    if filled:
        cv2.fillPoly(picture, [corners], colour, cv2.LINE_AA, 4)
    else:
        cv2.polylines(picture, [corners], False, colour, 1, cv2.LINE_AA, 4)
