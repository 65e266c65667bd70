"""Looks for a colour chart in some frames of a clip, as they pass by in full size, and keeps what it says.

Also draws the picture of it for people: the chart as found, and within each patch the colour that it should have had.
"""

from __future__ import annotations

import cv2
import numpy as np

from shared.capture.chart import COLUMNS, CORNERS, ROWS, ChartFit, fit_chart, reflectances
from shared.capture.chart_finder import (
    LEAST_LIKENESS,
    SMALLEST_PITCH_PX,
    ChartDetection,
    clipping_limit,
    find_chart,
    homography,
    read_chart,
)
from shared.capture.crop_pixels import decode_table, display_codes
from shared.contract.chart_place import ChartPlace
from shared.imaging.color import encode_srgb
from shared.imaging.frame_index import spread_frames

LOOKS = 12
"""Frames to look at, evenly spread."""
PICTURE_PX = 640
GRID_COLOUR, FAULT_COLOUR = (0, 220, 90), (230, 40, 40)
MARGIN = 0.25
"""What is shown around the chart, as a share of its longer side."""


class ChartWatch:
    """Tell it with `expect` how many frames there will be, show them with `look`, then ask for `record` and `warnings`.

    picture: of the first chart found, of the first that can be used if any can (see draw_chart); None without one. A
    chart found once is looked for in the same place where the detector misses it later: most charts stand still.
    """

    def __init__(self, place: ChartPlace, transfer: str) -> None:
        """transfer: of the source's codes."""
        self._place, self._transfer = place, transfer
        self._wanted: set[int] = set()
        self._last: np.ndarray | None = None
        self._views: list[tuple[int, ChartDetection, ChartFit]] = []
        self.picture: np.ndarray | None = None

    def expect(self, count: int) -> None:
        """Chooses the positions to look at among `count` frames; none where a person says where the chart is."""
        if self._place.look and self._place.frame is None:
            self._wanted = set(spread_frames(count, LOOKS).tolist())

    def look(self, position: int, frame_index: int, codes: np.ndarray) -> None:
        """A frame in full, code values [H, W, 3]; passed over unless its position is wanted."""
        if position not in self._wanted:
            return
        rgb = display_codes(codes, self._transfer)
        found = find_chart(rgb)
        for corners in (found, self._last):
            view = None if corners is None else _read(codes, corners, self._transfer)
            if view is not None:
                self._last = view.corners
                self._keep(frame_index, view, rgb)
                return

    def look_at_given(self, codes: np.ndarray) -> None:
        """The frame in which a person gave the corners, in order around the grid from any of them on."""
        corners = np.array(self._place.corners)
        across, down = corners[1] - corners[0], corners[2] - corners[1]
        if across[0] * down[1] - across[1] * down[0] < 0:
            corners = corners[::-1]
        views = [_read(codes, np.roll(corners, -turn, axis=0), self._transfer) for turn in range(4)]
        views = [view for view in views if view is not None]
        if views:
            best = max(views, key=lambda view: view.likeness)
            self._keep(self._place.frame, best, display_codes(codes, self._transfer))

    def _keep(self, frame_index: int, view: ChartDetection, rgb: np.ndarray) -> None:
        fit = fit_chart(view.patches, view.clipped)
        fault = _fault(view, fit)
        if self.picture is None or not (fault or self._used):
            self.picture = draw_chart(rgb, view, fit, fault)
        self._views.append((frame_index, view, fit))

    @property
    def _used(self) -> list[tuple[int, ChartDetection, ChartFit]]:
        return [(index, view, fit) for index, view, fit in self._views if not _fault(view, fit)]

    def record(self) -> list[dict]:
        """The frames in which the chart can be used, as ChartObservation.from_record reads them: frame_index; corners
        [4, 2] source px; patches [24, 3] linear values, clipped [24, 3] (1 where one only says "at least"); white,
        log_sigma, glare [3], weight [24] and relative_error (neutral, coloured) of ChartFit; pitch_px."""
        return [{
            "frame_index": int(index),
            "corners": np.round(view.corners, 2).tolist(),
            "pitch_px": round(view.pitch_px, 1),
            "patches": np.round(view.patches, 5).tolist(),
            "clipped": view.clipped.astype(int).tolist(),
            "white": np.round(fit.white, 5).tolist(),
            "log_sigma": np.round(fit.sigma, 4).tolist(),
            "glare": np.round(fit.glare, 5).tolist(),
            "weight": np.round(fit.weight, 3).tolist(),
            "relative_error": [round(fit.neutral_error, 4), round(fit.coloured_error, 4)],
        } for index, view, fit in self._used]

    def warnings(self) -> list[str]:
        """Why a chart that is in view, or was pointed at, is not used; nothing where none is or some frames do."""
        if self._used:
            return []
        faults = [_fault(view, fit) for _, view, fit in self._views]
        if faults:
            worst = max(sorted(set(faults)), key=faults.count)
            return [f"the colour chart in frame {self._views[faults.index(worst)][0]} is not used: {worst}"]
        if self._place.frame is not None:
            return [f"no colour chart can be made out at the corners given in frame {self._place.frame}: not used"]
        return []


def _fault(view: ChartDetection, fit: ChartFit) -> str:
    if view.pitch_px < SMALLEST_PITCH_PX:
        return (f"its patches are only {view.pitch_px:.0f} px apart ({SMALLEST_PITCH_PX:.0f} or more are needed): "
                "bring it nearer or turn it to the camera")
    return fit.fault


def _read(codes: np.ndarray, corners: np.ndarray, transfer: str) -> ChartDetection | None:
    """The chart near rough corners [4, 2] px of a frame, decoded around it only; None where there is none."""
    reach = 0.5 * float(np.ptp(corners, axis=0).max()) + 8
    low = np.maximum(np.floor(corners.min(0) - reach), 0).astype(int)
    high = np.ceil(corners.max(0) + reach).astype(int)
    part = codes[low[1]:max(high[1], 0), low[0]:max(high[0], 0)]
    if part.size == 0:
        return None
    table = decode_table(codes.dtype, transfer)
    view = read_chart(table[part], clipping_limit(table), corners - low)
    if view is None or view.likeness < LEAST_LIKENESS:
        return None
    return ChartDetection(view.corners + low, view.patches, view.clipped, view.pitch_px)


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
