"""Where shut lids meet: the dark line of lashes and shadow between them, near where the iris network has a lower lid.

The network was made for eyes that are open: it has the line of shut ones some millimetres too high, and too short. In
the frames' local contrast, averaged over frames on the head, the line is the darkest valley along the contour; it is
found by dynamic programming, as smooth as a lid is and no farther from the contour than the network errs.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from shared.geometry.transforms import project

UP_MM, DOWN_MM, STEP_MM = 2.0, 5.5, 0.15
"""How far from the contour the line is looked for, and in what steps."""
EXPECTED_MM, SIGMA_MM = 1.2, 1.2
"""Where it lies below the contour."""
VALLEY_MM = 0.75
"""From the line to the skin that it is darker than."""
PLACES, LONGER = 33, 0.25
"""Places along the contour, and the share of it by which the line may be longer at either end."""
BEND_MM = 0.3
"""How far the line usually climbs against the contour from one place to the next."""
SEEN = 20.0
"""Codes of contrast by which a valley counts as one of the other deviations, and by which the line goes on beyond the
contour's end; the skin's own texture has some ten."""
DEGREE = 2
"""Degree of the contour's curve: the network's points are uneven at its ends."""


def closing_line(
    contrast: Sequence[np.ndarray],
    contour: np.ndarray,
    down: np.ndarray,
    camera_from_points: np.ndarray,
    intrinsics: np.ndarray,
) -> np.ndarray:
    """The line's points [n, 3], evenly spaced, from those of a contour [n, 3].

    contrast: of F frames, [H, W] uint8 (shared.tracking.tracked_clip); down [3]: a millimetre down the face in the
    space of the points; camera_from_points [F, 4, 4]; intrinsics [3, 3].
    """
    way = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(contour, axis=0), axis=1))]
    curve = np.polynomial.polynomial.polyfit(way / way[-1], contour, DEGREE)
    beyond = round(LONGER * PLACES)
    places = np.arange(-beyond, PLACES + beyond) / (PLACES - 1)
    along, offsets = np.polynomial.polynomial.polyval(places, curve).T, np.arange(-UP_MM, DOWN_MM, STEP_MM)
    grid = (along[:, None] + offsets[:, None] * down).reshape(-1, 3)
    pixels = project(grid, camera_from_points, intrinsics)[0].astype(np.float32) - 0.5
    seen = [cv2.remap(picture, *np.ascontiguousarray(xy.T).reshape(2, len(places), -1), cv2.INTER_LINEAR)
            for picture, xy in zip(contrast, pixels, strict=True)]
    valleys = _valleys(np.median(np.stack(seen).astype(np.float32), axis=0))
    path = _darkest_path(valleys, offsets)
    line = along + offsets[path][:, None] * down
    dark = valleys[np.arange(len(path)), path] > SEEN
    first = beyond - _run_length(dark[:beyond][::-1])
    last = beyond + PLACES - 1 + _run_length(dark[beyond + PLACES :])
    wanted = np.linspace(places[first], places[last], len(contour))
    return np.stack([np.interp(wanted, places, values) for values in line.T], axis=1)


def _run_length(values: np.ndarray) -> int:
    """How many of the first values [n] bool are true."""
    return len(values) if values.all() else int(values.argmin())


def _valleys(mean: np.ndarray) -> np.ndarray:
    """[places, offsets]: by how many codes a place is darker than the skin to both sides of it."""
    smooth = cv2.GaussianBlur(mean, (0, 0), 1.5, borderType=cv2.BORDER_REPLICATE)
    reach = round(VALLEY_MM / STEP_MM)
    padded = np.pad(smooth, ((0, 0), (reach, reach)), mode="edge")
    return np.maximum(np.minimum(padded[:, : -2 * reach], padded[:, 2 * reach :]) - smooth, 0.0)


def _darkest_path(valleys: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """[places] indices of offsets: least cost of a path that runs through valleys [places, offsets], near the place
    that is expected, and hardly bends."""
    own = 0.5 * ((offsets - EXPECTED_MM) / SIGMA_MM) ** 2 / np.sqrt(len(valleys)) - valleys / SEEN
    climb = 0.5 * ((offsets[:, None] - offsets) / BEND_MM) ** 2
    best, came = own[0], []
    for cost in own[1:]:
        through = best + climb
        came.append(through.argmin(1))
        best = through.min(1) + cost
    path = [int(best.argmin())]
    for step in reversed(came):
        path.append(int(step[path[-1]]))
    return np.array(path[::-1])
