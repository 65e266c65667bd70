"""The lens at the border: focal length as an operator knows it -> intrinsics in pixels of the source frame."""

from __future__ import annotations

import numpy as np

from shared.capture.framing import GUESSED_FOCAL, pinhole
from shared.io.source import VideoInfo

FULL_FRAME_WIDTH_MM = 36.0


def source_intrinsics(
    info: VideoInfo,
    focal_length_px: float | None = None,
    focal_length_mm: float | None = None,
    sensor_width_mm: float | None = None,
) -> tuple[np.ndarray, bool, str]:
    """Intrinsics [3, 3] of the full frame as shown, whether the focal length is known, and a warning where it is not.

    The sensor's width lies along the stored picture's width, which a rotation flag turns upright. Unknown lenses are
    taken from the file's 35 mm equivalent, or guessed as 1.3 times the long side.
    """
    stored_width = info.height if info.rotation % 180 else info.width
    if focal_length_px is not None:
        return pinhole(focal_length_px, info.width, info.height), True, ""
    if focal_length_mm is not None and sensor_width_mm is not None:
        return pinhole(focal_length_mm / sensor_width_mm * stored_width, info.width, info.height), True, ""
    longest = max(info.width, info.height)
    if info.focal_length_35mm is not None:
        focal_px = info.focal_length_35mm / FULL_FRAME_WIDTH_MM * longest
        origin = f"the file's {info.focal_length_35mm:g} mm (35 mm equivalent)"
    else:
        focal_px, origin = GUESSED_FOCAL * longest, f"a guess of {GUESSED_FOCAL} times the picture's long side"
    note = f"the focal length is not given: {origin} makes {focal_px:.0f} px; put `camera` into subject.yaml"
    return pinhole(focal_px, info.width, info.height), False, note
