"""PNG and EXR at the border: one function to write each, so that layout and colour space are always stated.

The OpenEXR binding ignores strides: a flipped or sliced view would be written as wrong pixels without an error. Hence
write_exr alone talks to it, with contiguous arrays only, and reads the file back.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from shared.errors import InputError, LimnError

_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_ACESCG = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
_CHROMATICITIES = {"lin_rec709_scene": _REC709, "lin_ap1_scene": _ACESCG}
COLOUR_SPACES = (*_CHROMATICITIES, "data")
HALF_MAXIMUM = 65504.0


def write_exr(
    path: Path | str,
    array: np.ndarray,
    *,
    colour_space: str,
    half: bool = False,
    attributes: dict[str, str | int | float] | None = None,
    latlong: bool = False,
) -> None:
    """Writes [H, W] (channel Y) or [H, W, 3] (RGB) as a ZIP-compressed scan-line EXR.

    colour_space: one of COLOUR_SPACES ("data": no colour). half: 16-bit floats, clamped to +-65504. attributes are
    stored as "limn:<name>". latlong marks an environment map. Errors: LimnError for a wrong shape, for values that
    are not finite, or when the file does not read back as written.
    """
    array = np.asarray(array)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3) or array.size == 0:
        raise LimnError(f"{path}: an EXR is [H, W] or [H, W, 3], got {array.shape}")
    if not np.isfinite(array).all():
        raise LimnError(f"{path}: {np.count_nonzero(~np.isfinite(array))} values are not finite")
    if half:
        array = np.clip(array, -HALF_MAXIMUM, HALF_MAXIMUM)
    pixels = np.ascontiguousarray(array, np.float16 if half else np.float32)
    with OpenEXR.File(_header(colour_space, attributes or {}, latlong), {_channel(pixels): pixels}) as file:
        file.write(str(path))
    with OpenEXR.File(str(path)) as file:
        if not np.array_equal(file.channels()[_channel(pixels)].pixels, pixels):
            raise LimnError(f"{path}: the file does not read back as written")


def _channel(pixels: np.ndarray) -> str:
    return "RGB" if pixels.ndim == 3 else "Y"


def _header(colour_space: str, attributes: dict, latlong: bool) -> dict:
    if colour_space not in COLOUR_SPACES:
        raise LimnError(f"unknown colour space {colour_space!r}; known: {', '.join(COLOUR_SPACES)}")
    header: dict = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    header["colorInteropID"] = colour_space
    if colour_space in _CHROMATICITIES:
        header["chromaticities"] = _CHROMATICITIES[colour_space]
    if latlong:
        header["envmap"] = OpenEXR.ENVMAP_LATLONG
    header.update({f"limn:{name}": value for name, value in attributes.items()})
    return header


def read_exr(path: Path | str) -> np.ndarray:
    """-> float32 [H, W] or [H, W, 3]. InputError when the file is missing, truncated or not an EXR."""
    try:
        with OpenEXR.File(str(path)) as file:
            if not file.parts:
                raise InputError("truncated or empty EXR", where=str(path))
            channels = file.channels()
            for name in ("RGB", "RGBA"):
                if name in channels:
                    return channels[name].pixels[..., :3].astype(np.float32)
            if all(name in channels for name in "RGB"):
                return np.stack([channels[name].pixels for name in "RGB"], axis=-1).astype(np.float32)
            return next(iter(channels.values())).pixels.astype(np.float32)
    except RuntimeError as error:
        raise InputError("not a readable EXR", where=str(path), got=error) from error


def write_png(path: Path | str, array: np.ndarray) -> None:
    """Writes [H, W] or [H, W, 3] RGB, uint8 or uint16, losslessly."""
    ordered = array[..., ::-1] if array.ndim == 3 else array
    if not cv2.imwrite(str(path), np.ascontiguousarray(ordered), [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise LimnError(f"{path}: could not be written")


def read_png(path: Path | str) -> np.ndarray:
    """-> [H, W] or [H, W, 3] RGB, uint8 or uint16 as stored. InputError when missing or damaged."""
    array = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if array is None:
        raise InputError("missing or not a readable PNG", where=str(path))
    if array.ndim == 2:
        return array
    return np.ascontiguousarray(array[..., 2::-1])
