"""PNG and EXR at the border: one function to write each, so that layout and colour space are always stated.

The OpenEXR binding ignores strides: a flipped or sliced view would be written as wrong pixels without an error. Hence
write_exr alone talks to it, with contiguous arrays only, and reads the file back.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from shared.errors import InputError, LimnError
from shared.io.exr_header import check_decodable, read_parts

_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_ACESCG = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
CHROMATICITIES = {"lin_rec709_scene": _REC709, "lin_ap1_scene": _ACESCG}
"""Colour space -> the primaries and the white (x, y each) that are written with it."""
COLOUR_SPACES = (*CHROMATICITIES, "data")
HALF_MAXIMUM = 65504.0
LAYOUTS = ("scanline", "tiled", "mipmap")
TILE = 64
LARGEST_MAP = 16384 * 8192
"""Pixels of a map or a lat-long light."""
_NO_DATE = "1980:01:01 00:00:00"


def write_exr(
    path: Path | str,
    array: np.ndarray,
    *,
    colour_space: str,
    half: bool = False,
    attributes: dict[str, str | int | float] | None = None,
    latlong: bool = False,
    layout: str = "scanline",
    channels: Sequence[str] = (),
) -> None:
    """Writes array [H, W] (channel Y), [H, W, 3] (RGB), [H, W, 4] (RGB, premultiplied, and A) or [H, W, C] with C named
    channels as a ZIP-compressed EXR.

    colour_space: one of COLOUR_SPACES ("data": no colour). half: 16-bit floats, clamped to +-65504. attributes are
    stored as "limn:<name>". latlong marks an environment map. layout: one of LAYOUTS; mipmap halves the picture down to
    one pixel by box filter, in tiles. channels: [C] names; such a picture has no mipmaps. Errors: LimnError for a wrong
    shape, for values that are not finite, or when the file does not read back as written.
    """
    array = np.asarray(array)
    depths = (len(channels),) if channels else (3, 4)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in depths) or array.size == 0:
        raise LimnError(f"{path}: an EXR is [H, W] or [H, W, {depths[0]}], got {array.shape}")
    if not np.isfinite(array).all():
        raise LimnError(f"{path}: {np.count_nonzero(~np.isfinite(array))} values are not finite")
    if half:
        array = np.clip(array, -HALF_MAXIMUM, HALF_MAXIMUM)
    pixels = np.ascontiguousarray(array, np.float16 if half else np.float32)
    header = _header(colour_space, attributes or {}, latlong)
    if layout not in LAYOUTS or (layout == "mipmap" and (latlong or channels)):
        raise LimnError(f"{path}: no layout {layout!r} for this picture; known: {', '.join(LAYOUTS)}")
    if layout == "mipmap":
        _write_mipmaps(path, pixels, header)
    else:
        if layout == "tiled":
            header |= {"type": OpenEXR.tiledimage, "tiles": _one_level()}
        with OpenEXR.File(header, _planes(pixels, channels)) as file:
            file.write(str(path))
    with OpenEXR.File(str(path)) as file:
        stored = file.channels()
        for name, plane in _planes(pixels, channels).items():
            if not np.array_equal(stored[name].pixels, plane):
                raise LimnError(f"{path}: the file does not read back as written")


def _planes(pixels: np.ndarray, channels: Sequence[str]) -> dict[str, np.ndarray]:
    if not channels:
        return {_channel(pixels): pixels}
    return {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate(channels)}


def _one_level() -> OpenEXR.TileDescription:
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = TILE
    tiles.mode = OpenEXR.ONE_LEVEL
    return tiles


def _write_mipmaps(path: Path | str, pixels: np.ndarray, header: dict) -> None:
    """Through OpenImageIO: the OpenEXR binding writes mip levels that nothing can read."""
    import OpenImageIO  # only this needs it

    planes = pixels if pixels.ndim == 3 else pixels[..., None]
    height, width, channels = planes.shape
    kind = "half" if pixels.dtype == np.float16 else "float"
    spec = OpenImageIO.ImageSpec(width, height, channels, kind)
    spec.channelnames = tuple(_channel(pixels))
    for name, value in header.items():
        if name == "chromaticities":
            spec.attribute(name, OpenImageIO.TypeDesc("float[8]"), value)
        elif isinstance(value, (str, int, float)):
            spec.attribute(name, value)
    spec.attribute("DateTime", _NO_DATE)  # else the time of writing, and no two files alike
    source, target = OpenImageIO.ImageBuf(spec), OpenImageIO.ImageSpec()
    source.set_pixels(OpenImageIO.ROI.All, np.ascontiguousarray(planes))
    target.set_format(kind)
    target.tile_width = target.tile_height = TILE
    options = {"compression": "zip", "wrapmodes": "clamp,clamp", "maketx:filtername": "box", "maketx:hash": 0}
    for name, value in options.items():
        target.attribute(name, value)
    if not OpenImageIO.ImageBufAlgo.make_texture(OpenImageIO.MakeTxTexture, source, str(path), target):
        raise LimnError(f"{path}: {OpenImageIO.geterror()}")


def _channel(pixels: np.ndarray) -> str:
    return {3: "RGB", 4: "RGBA"}[pixels.shape[2]] if pixels.ndim == 3 else "Y"


def _header(colour_space: str, attributes: dict, latlong: bool) -> dict:
    if colour_space not in COLOUR_SPACES:
        raise LimnError(f"unknown colour space {colour_space!r}; known: {', '.join(COLOUR_SPACES)}")
    header: dict = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    header["colorInteropID"] = colour_space
    if colour_space in CHROMATICITIES:
        header["chromaticities"] = CHROMATICITIES[colour_space]
    if latlong:
        header["envmap"] = OpenEXR.ENVMAP_LATLONG
    header.update({f"limn:{name}": value for name, value in attributes.items()})
    return header


def read_exr(path: Path | str) -> np.ndarray:
    """-> float32 [H, W] or [H, W, 3], values as stored. InputError when the file is missing, truncated, larger than any
    picture once decoded, or not an EXR of that kind.
    """
    channels = _stored(path)
    colour = next((channels[name] for name in ("RGB", "RGBA") if name in channels), None)
    if colour is None and all(name in channels for name in "RGB") and len({channels[c].shape for c in "RGB"}) == 1:
        colour = np.stack([channels[name] for name in "RGB"], axis=-1)
    if colour is None and len(channels) == 1:
        colour = next(iter(channels.values()))
    if colour is None or colour.ndim not in (2, 3) or (colour.ndim == 3 and colour.shape[2] < 3):
        raise InputError("an EXR of other channels", where=str(path), got=", ".join(sorted(channels)) or "none",
                         expected="R, G, B or one channel")
    return (colour if colour.ndim == 2 else colour[..., :3]).astype(np.float32)


def read_channels(path: Path | str) -> dict[str, np.ndarray]:
    """{name: float32 [H, W]} of an EXR with channels of other names than R, G, B. Errors: as of read_exr."""
    return {name: plane.astype(np.float32) for name, plane in _stored(path).items()}


def _stored(path: Path | str) -> dict[str, np.ndarray]:
    check_decodable(path, LARGEST_MAP)
    try:
        with OpenEXR.File(str(path)) as file:
            if not file.parts:
                raise InputError("truncated or empty EXR", where=str(path))
            return {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, MemoryError) as error:
        raise InputError("not a readable EXR", where=str(path), got=error) from error


def exr_size(path: Path | str) -> tuple[int, int]:
    """(width, height) as the header states it, without reading a pixel. InputError when it is not an EXR."""
    return read_parts(path)[0].size


def write_png(path: Path | str, array: np.ndarray) -> None:
    """Writes array [H, W] or [H, W, 3] RGB, uint8 or uint16, losslessly.

    Pixels of a photograph are predicted from the mean of their neighbours, and only runs are looked for, not repeats:
    its noise repeats nothing. Measured on frames of a face: 0.6 of the time and 0.9 of the bytes of the usual settings.
    """
    ordered = cv2.cvtColor(array, cv2.COLOR_RGB2BGR) if array.ndim == 3 else array
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    if array.ndim == 3:
        settings += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG]
    done, data = cv2.imencode(".png", ordered, settings)
    if not done:
        raise LimnError(f"{path}: could not be encoded")
    Path(path).write_bytes(data)  # imwrite would not say that the disk is full


def texture_png(codes: np.ndarray) -> bytes:
    """A texture map uint8 or uint16 [H, W], [H, W, 3] RGB or [H, W, 4] RGBA as a PNG file.

    Atlases are flat in parts and smooth in others: Paeth's predictor makes a sixth less of them than that of write_png.
    """
    order = [2, 1, 0, 3][: codes.shape[2]] if codes.ndim == 3 else slice(None)
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
                cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_PAETH]
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(codes[..., order]), settings)
    if not done:
        raise LimnError("a texture could not be encoded")
    return encoded.tobytes()


def read_png(path: Path | str) -> np.ndarray:
    """-> [H, W] or [H, W, 3] RGB, uint8 or uint16 as stored. InputError when missing or damaged."""
    array = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if array is None:
        raise InputError("missing or not a readable PNG", where=str(path))
    if array.ndim == 2:
        return array
    return cv2.cvtColor(array, cv2.COLOR_BGR2RGB if array.shape[2] == 3 else cv2.COLOR_BGRA2RGB)
