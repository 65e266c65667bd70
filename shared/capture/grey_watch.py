"""Measures a place that a person named as grey in some frames of a clip, as they pass by in full size.

Its colour is the tint of the light on it. How bright it is says nothing: neither how light a grey it is nor how it is
turned to the light is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shared.capture.chart_finder import clipping_limit
from shared.capture.crop_pixels import decode_table
from shared.compute.robust import ROBUST_SCALE
from shared.imaging.frame_index import spread_frames

LOOKS, FEWEST_FRAMES = 12, 3
"""Frames to look at, evenly spread, and how many of them have to agree."""
RADIUS_PX = 4.0
"""Of the patch: enough pixels to average noise, few enough for a strip of wall."""
DARKEST = 0.01
"""Linear value of a channel below which a code or two of a black level that is off pass for a tint."""
OUTLYING, ALIKE = 3.0, 0.05
"""Standard deviations from the median beyond which something else stands before the place in a frame; logarithms by
which frames may differ in any case: noise and compression."""
LARGEST_SIGMA = 0.15
"""Standard deviation over the frames from which on the place says no more than that light is usually white."""
LARGEST_TINT = 1.5
"""Logarithm of a ratio of channels that no light of a room or of a day gives grey: tungsten light by a camera set to
daylight has 0.8 in red and -1.3 in blue."""


class GreyLook(NamedTuple):
    """One frame: the median linear colour [3] of the patch, and "overexposed" or "too dark" where it says nothing."""

    frame_index: int
    colour: np.ndarray
    fault: str


class GreyWatch:
    """Tell it with `expect` how many frames there will be, show them with `look`, then ask for `record` and `warnings`.
    """

    def __init__(self, place: tuple[float, float] | None, transfer: str) -> None:
        """place: (x, y) px of the source frame, None where none is named; transfer: of its codes."""
        self._place, self._transfer = place, transfer
        self._wanted: set[int] = set()
        self._looks: list[GreyLook] = []

    def expect(self, count: int) -> None:
        """Chooses the positions to look at among `count` frames; none where no place is named."""
        if self._place is not None:
            self._wanted = set(spread_frames(count, LOOKS).tolist())

    def look(self, position: int, frame_index: int, codes: np.ndarray) -> None:
        """A frame in full, code values [H, W, 3]; passed over unless its position is wanted."""
        if position in self._wanted:
            table = decode_table(codes.dtype, self._transfer)
            colour = np.median(table[patch_around(codes, self._place)], axis=0)
            over, under = colour.max() >= clipping_limit(table), colour.min() < DARKEST
            self._looks.append(GreyLook(frame_index, colour, "overexposed" if over else "too dark" if under else ""))

    def record(self) -> dict | None:
        """What the place says, None where none is named or it is not used: place (x, y) source px; colour [3] linear,
        by the frames' median green and median ratios to it; log_sigma [2]: robust standard deviation over the frames of
        log R/G and log B/G; frames: those that count."""
        if self._place is None or self._fault():
            return None
        counted = agreeing(self._usable)
        (red, blue), sigma = middle_of(counted)
        colour = np.median([look.colour[1] for look in counted]) * np.exp([red, 0.0, blue])
        return {
            "place": list(self._place),
            "colour": np.round(colour, 5).tolist(),
            "log_sigma": np.round(sigma, 4).tolist(),
            "frames": [int(look.frame_index) for look in counted],
        }

    def warnings(self) -> list[str]:
        """Why the place is not used; nothing where it is."""
        fault = self._fault()
        return [f"the grey place at ({self._place[0]:g}, {self._place[1]:g}) is not used: {fault}"] if fault else []

    @property
    def _usable(self) -> list[GreyLook]:
        return [look for look in self._looks if not look.fault]

    def _fault(self) -> str:
        if self._place is None:
            return ""
        usable = self._usable
        if len(usable) < FEWEST_FRAMES:
            worst = " and ".join(sorted({look.fault for look in self._looks if look.fault}))
            return f"{len(usable)} of {len(self._looks)} frames can be read there, the others are {worst}"
        counted = agreeing(usable)
        (red, blue), sigma = middle_of(counted)
        if len(counted) < FEWEST_FRAMES or sigma.max() > LARGEST_SIGMA:
            return f"its colour is not the same in {len(usable)} frames"
        if max(abs(red), abs(blue)) > LARGEST_TINT:
            return (f"its red is {np.exp(red):.2f} and its blue {np.exp(blue):.2f} times its green, "
                    "which no usual light makes of grey")
        return ""


def patch_around(picture: np.ndarray, place: tuple[float, float]) -> np.ndarray:
    """[n, C]: the pixels of a picture [H, W, C] whose centres lie within RADIUS_PX of a place (x, y) inside it."""
    first = np.maximum(np.floor(np.array(place) - RADIUS_PX), 0).astype(int)
    last = np.ceil(np.array(place) + RADIUS_PX).astype(int)
    part = picture[first[1]:last[1], first[0]:last[0]]
    y, x = np.indices(part.shape[:2]) + 0.5
    return part[np.hypot(x + first[0] - place[0], y + first[1] - place[1]) <= RADIUS_PX]


def log_ratios(looks: Sequence[GreyLook]) -> np.ndarray:
    """[N, 2]: log R/G and log B/G of each frame."""
    logs = np.log([look.colour for look in looks])
    return logs[:, [0, 2]] - logs[:, [1]]


def agreeing(looks: Sequence[GreyLook]) -> list[GreyLook]:
    """The frames of the colour that most of them show: those in which nothing else stands before the place."""
    ratios = log_ratios(looks)
    off = np.abs(ratios - np.median(ratios, axis=0))
    reach = np.maximum(OUTLYING * ROBUST_SCALE * np.median(off, axis=0), ALIKE)
    return [look for look, inside in zip(looks, (off <= reach).all(axis=1), strict=True) if inside]


def middle_of(looks: Sequence[GreyLook]) -> tuple[np.ndarray, np.ndarray]:
    """Medians [2] of the frames' log R/G and log B/G, and robust standard deviations [2]."""
    ratios = log_ratios(looks)
    middle = np.median(ratios, axis=0)
    return middle, ROBUST_SCALE * np.median(np.abs(ratios - middle), axis=0)
