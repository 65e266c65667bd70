"""The clip's frames as pictures for the eye: what a scene shows behind the head to check camera and motion by."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np

from shared.errors import LimnError
from shared.imaging.color import decode_transfer, encode_srgb
from shared.io.frames import FrameSet

LONGEST_SIDE, QUALITY = 1024, 80


def srgb_codes(frames: FrameSet) -> np.ndarray:
    """Table from the clip's code values to 8-bit sRGB codes."""
    depth = 2**16 if frames.read_codes(0).dtype == np.uint16 else 2**8
    linear = decode_transfer(np.arange(depth) / (depth - 1), frames.transfer)
    return (encode_srgb(linear) * 255.0 + 0.5).astype(np.uint8)


def write_plates(
    folder: Path, frames: FrameSet, frame_index: np.ndarray, progress: Callable[[Iterable, str], Iterable]
) -> dict[int, str]:
    """Writes the crops of frame_index [F] as folder/%04d.jpg, no side beyond LONGEST_SIDE. -> {frame: file name}.

    progress(items, label) wraps the loop.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table, written = srgb_codes(frames), {}
    scale = min(1.0, LONGEST_SIDE / max(frames.size))
    size = tuple(max(1, round(side * scale)) for side in frames.size)
    for frame in progress(frame_index, "plates"):
        codes = frames.read_codes(frames.position(int(frame)))
        picture = cv2.LUT(codes, table) if codes.dtype == np.uint8 else table[codes]
        if scale < 1.0:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        written[int(frame)] = f"{int(frame):04d}.jpg"
        path = folder / written[int(frame)]
        bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        if not cv2.imwrite(str(path), bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1]):
            raise LimnError(f"{path}: could not be written")
    return written


def crop_rectangle(frames: FrameSet) -> tuple[float, float, float, float]:
    """(left, top, right, bottom) of the crop in px of the source frame."""
    x0, y0, scale = frames.crop
    width, height = frames.size
    return x0, y0, x0 + width / scale, y0 + height / scale
