"""Looks for a colour chart in some frames of a clip, as they pass by in full size, and keeps what it says."""

from __future__ import annotations

import numpy as np

from shared.capture.chart import ChartFit, fit_chart
from shared.capture.chart_finder import (
    LEAST_LIKENESS,
    SMALLEST_PITCH_PX,
    ChartDetection,
    clipping_limit,
    find_chart,
    read_chart,
)
from shared.capture.chart_picture import draw_chart
from shared.capture.crop_pixels import decode_table, display_codes
from shared.contract.chart_place import ChartPlace

LOOKS = 12
"""Frames to look at, evenly spread."""


class ChartWatch:
    """Tell it with `expect` how many frames there will be, show them with `look`, then ask for `record` and `warnings`.

    picture: of the first chart found, of the first that can be used if any can (see chart_picture); None without one. A
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
            self._wanted = set(np.linspace(0, count - 1, min(LOOKS, count)).round().astype(int).tolist())

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
