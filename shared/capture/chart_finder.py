"""Finds a 24-patch colour chart in pictures and reads its patches.

OpenCV's detector finds the chart and which way it lies, its corners to some pixels. They are then drawn onto the
picture: a template of the grid, painted with the colours just read and dark gaps between the patches, is registered by
maximising the correlation over homographies.

References: Evangelidis and Psarakis, Parametric image alignment using enhanced correlation coefficient maximization,
PAMI 2008; the detector is cv2.mcc.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from shared.capture.chart import COLUMNS, CORNERS, PATCHES, ROWS, reflectances
from shared.imaging.color import CLIPPED_CODE

DETECTION_PX = 1600
"""Long side of the picture that the detector sees; it needs patches of some 14 px."""
LARGEST_COST = 0.2
LEAST_LIKENESS = 0.85
"""Correlation of log values with log reflectances that makes it a chart at all; true ones reach 0.95 and more."""
SMALLEST_PITCH_PX = 9.0
GAPS = (0.05, 0.08, 0.11, 0.14, 0.17)
"""Widths to try of the dark gap between patches, as a share of their pitch; the middle one to begin with."""
CORE = 0.27
"""A patch is read within this distance of its centre, in pitches."""
TEMPLATE_CELL_PX = (12, 32)
LEAST_REGISTRATION = 0.6


@dataclass(frozen=True)
class ChartDetection:
    """A chart in one picture. corners [4, 2] px (see chart.CORNERS; first pixel's centre at 0.5); patches [24, 3] mean
    linear values; clipped [24, 3] bool; pitch_px: shortest edge of a grid cell."""

    corners: np.ndarray
    patches: np.ndarray
    clipped: np.ndarray
    pitch_px: float

    @property
    def likeness(self) -> float:
        """Correlation of log values with log reflectances over patches and channels, each channel about its mean."""
        reference, values = (np.log(np.maximum(x, 0.02)) for x in (reflectances(), self.patches / self.patches.max()))
        reference, values = reference - reference.mean(0), values - values.mean(0)
        return float((reference * values).sum() / max(np.sqrt((reference**2).sum() * (values**2).sum()), 1e-9))


def find_chart(rgb: np.ndarray) -> np.ndarray | None:
    """Rough corners [4, 2] px of the grid in a picture, uint8 sRGB [H, W, 3]; None where the detector finds none."""
    scale = min(1.0, DETECTION_PX / max(rgb.shape[:2]))
    small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else rgb
    detector = cv2.mcc.CCheckerDetector_create()
    detector.setColorChartType(cv2.mcc.MCC24)
    if not detector.process(np.ascontiguousarray(small[..., ::-1]), 1):
        return None
    found = detector.getBestColorChecker()
    if found.getCost() > LARGEST_COST:
        return None
    return (np.asarray(found.getBox(), float) + 0.5) / scale


def read_chart(linear: np.ndarray, limit: float, corners: np.ndarray) -> ChartDetection | None:
    """The chart near rough corners [4, 2] px, drawn onto the picture and read; None where none can be registered there.

    linear [H, W, 3] float32; limit: linear value from which a channel counts as clipped.
    """
    for gaps in (GAPS[2:3], GAPS):
        view = _measure(linear, limit, corners)
        if view is None:
            return None
        corners = max((_register(linear, view, gap) for gap in gaps), key=lambda found: found[0])[1]
        if corners is None:
            return None
    return _measure(linear, limit, corners)


def clipping_limit(table: np.ndarray) -> float:
    """Linear value above which a channel counts as clipped; table [K]: linear value of each of the K codes."""
    return float(table[int(np.ceil(CLIPPED_CODE * (len(table) - 1)))])


def homography(corners: np.ndarray) -> np.ndarray:
    """[4, 2] px -> [3, 3] image_from_grid."""
    return cv2.getPerspectiveTransform(CORNERS.astype(np.float32), np.asarray(corners, np.float32))


def _measure(linear: np.ndarray, limit: float, corners: np.ndarray) -> ChartDetection | None:
    """Reads the patches; None where the grid leaves the picture, or is too small or too oblique to hold pixels."""
    height, width = linear.shape[:2]
    if not _convex(corners) or (corners < 0).any() or (corners > (width, height)).any():
        return None
    low = np.floor(corners.min(0)).astype(int)
    high = np.minimum(np.ceil(corners.max(0)).astype(int), (width, height))
    pixels = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), -1) + 0.5
    grid = cv2.perspectiveTransform(pixels.reshape(-1, 1, 2), np.linalg.inv(homography(corners))).reshape(-1, 2)
    cell = np.floor(grid).astype(int)
    core = (np.abs(grid - cell - 0.5) < CORE).all(1) & (cell >= 0).all(1) & (cell < (COLUMNS, ROWS)).all(1)
    patch = (cell[:, 1] * COLUMNS + cell[:, 0])[core]
    values = linear[low[1]:high[1], low[0]:high[0]].reshape(-1, 3)[core]
    count = np.bincount(patch, minlength=PATCHES)
    if count.min() < 4:
        return None
    mean, over = (np.stack([np.bincount(patch, part[:, c], PATCHES) for c in range(3)], 1) / count[:, None]
                  for part in (values, (values >= limit).astype(float)))
    edges = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1) / (COLUMNS, ROWS, COLUMNS, ROWS)
    return ChartDetection(corners, mean, over > 0.02, float(edges.min()))


def _convex(corners: np.ndarray) -> bool:
    """Whether the corners run clockwise in the picture without a dent: a chart seen from its front."""
    edge = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edge, -1, axis=0)
    return bool((edge[:, 0] * following[:, 1] - edge[:, 1] * following[:, 0] > 0).all())


def _register(linear: np.ndarray, view: ChartDetection, gap: float) -> tuple[float, np.ndarray | None]:
    """The painted template's best place: correlation there and corners [4, 2] px; (0, None) where it finds no hold."""
    cell = int(np.clip(round(view.pitch_px), *TEMPLATE_CELL_PX))
    low = np.maximum(np.floor(view.corners.min(0) - view.pitch_px), 0).astype(int)
    high = np.ceil(view.corners.max(0) + view.pitch_px).astype(int)
    part = _tone(linear[low[1]:high[1], low[0]:high[0]])
    # From template pixels to the part's pixels; cv2 counts their centres from 0.0 on both sides.
    to_centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    grid_from_template = np.diag([1 / cell, 1 / cell, 1.0]) @ to_centre
    part_from_image = np.linalg.inv(to_centre) @ np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1.0]])
    warp = part_from_image @ homography(view.corners) @ grid_from_template
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-6)
    try:
        likeness, warp = cv2.findTransformECC(_template(view, cell, gap), part, (warp / warp[2, 2]).astype(np.float32),
                                              cv2.MOTION_HOMOGRAPHY, stop, None, 3)
    except cv2.error:  # it does not converge
        return 0.0, None
    if not likeness > LEAST_REGISTRATION:
        return 0.0, None
    image_from_grid = np.linalg.inv(part_from_image) @ warp.astype(float) @ np.linalg.inv(grid_from_template)
    return likeness, cv2.perspectiveTransform(CORNERS.reshape(-1, 1, 2), image_from_grid).reshape(-1, 2)


def _tone(linear: np.ndarray) -> np.ndarray:
    """[..., 3] -> [...] float32 grey near perception, so that dark patches and gaps count."""
    return np.sqrt(np.clip(linear, 0.0, None)).mean(-1).astype(np.float32)


def _template(view: ChartDetection, cell: int, gap: float) -> np.ndarray:
    """float32 [4 cell, 6 cell]: the grid as the patches read say, with gaps as dark as the darkest, antialiased."""
    fine = 8
    colours = _tone(view.patches).reshape(ROWS, COLUMNS)
    picture = np.repeat(np.repeat(colours, cell * fine, 0), cell * fine, 1)
    place = (np.arange(cell * fine) + 0.5) / (cell * fine)
    dark = (place < gap / 2) | (place > 1 - gap / 2)
    picture[np.tile(dark, ROWS)] = colours.min()
    picture[:, np.tile(dark, COLUMNS)] = colours.min()
    return cv2.resize(picture, (COLUMNS * cell, ROWS * cell), interpolation=cv2.INTER_AREA)
