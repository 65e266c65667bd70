"""Close-ups of the eyes for the report: which frames show them, and which part of a picture they fill."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from shared.geometry.eyeballs import Eyeball
from shared.geometry.transforms import camera_centres, project
from shared.report.pictures import shrunk, srgb_bytes

CLOSE_UP_PIXELS = 560
_WIDTH, _HEIGHT = 1.9, 0.75
"""Of a close-up, in distances between the eyeballs' centres: from temple to temple, from brow to cheekbone."""


def close_up_frames(
    frames: Sequence[int], frame_index: np.ndarray, camera_from_head: np.ndarray, gaze: np.ndarray
) -> list[int]:
    """Up to three of the frames: those that see the head furthest from one side, most from the front, and furthest from
    the other; with open eyes where there are any such.

    camera_from_head [F, 4, 4] and gaze [F, 2, 2], NaN while an eye is shut, at frame_index [F].
    """
    place = {int(frame): f for f, frame in enumerate(frame_index)}
    known = [frame for frame in frames if frame in place]
    opened = [frame for frame in known if np.isfinite(gaze[place[frame]]).all()] or known
    if not opened:
        return []
    x, _, z = camera_centres(camera_from_head[[place[frame] for frame in opened]]).T
    side = np.arctan2(x, z)
    return sorted({opened[k] for k in (np.argmin(side), np.argmin(np.abs(side)), np.argmax(side))})


def eye_rectangle(
    eyes: Sequence[Eyeball], camera_from_head: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> tuple[int, int, int, int] | None:
    """Left, top, right and bottom px of what shows both eyes in a picture of size (width, height), of the same scale on
    the face however the head is turned; cut at the picture's edge, None beyond it. camera_from_head [4, 4]."""
    centres = np.stack([eye.centre for eye in eyes])
    pixels, depth = project(centres, camera_from_head, intrinsics)
    if (depth <= 0.0).any():
        return None
    apart = float(np.linalg.norm(centres[1] - centres[0]) * intrinsics[0, 0] / depth.mean())
    half = 0.5 * apart * np.array([_WIDTH, _HEIGHT])
    middle = pixels.mean(0)
    left, top = np.clip(np.floor(middle - half), 0, size).astype(int).tolist()
    right, bottom = np.clip(np.ceil(middle + half), 0, size).astype(int).tolist()
    return (left, top, right, bottom) if left < right and top < bottom else None


def close_up(linear: np.ndarray, rectangle: tuple[int, int, int, int]) -> np.ndarray:
    """That part of a linear picture [H, W, 3] as uint8 sRGB, CLOSE_UP_PIXELS wide."""
    left, top, right, bottom = rectangle
    part = srgb_bytes(linear[top:bottom, left:right])
    if right - left >= CLOSE_UP_PIXELS:
        return shrunk(part, max(CLOSE_UP_PIXELS, round(CLOSE_UP_PIXELS * (bottom - top) / (right - left))))
    height = max(1, round(CLOSE_UP_PIXELS * (bottom - top) / (right - left)))
    return cv2.resize(part, (CLOSE_UP_PIXELS, height), interpolation=cv2.INTER_CUBIC)
