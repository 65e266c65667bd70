"""Kind and shape of an output file, read from its header alone."""

from __future__ import annotations

import ast
import struct
import zipfile
from pathlib import Path

_KINDS = {".exr": "image", ".png": "image", ".npz": "arrays", ".json": "json", ".html": "page", ".obj": "mesh",
          ".usda": "usd", ".usdz": "usd", ".txt": "text", ".npy": "array", ".csv": "table"}
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}


def describe(path: Path) -> dict[str, object]:
    """{"kind"} of a file, and "shape": [H, W, C] of PNG and EXR, {array: shape} of NPZ."""
    kind = _KINDS.get(path.suffix.lower(), path.suffix.lstrip(".") or "file")
    reader = {".png": _png_shape, ".exr": _exr_shape, ".npz": _npz_shapes}.get(path.suffix.lower())
    try:
        return {"kind": kind, "shape": reader(path)} if reader else {"kind": kind}
    except (ValueError, KeyError, IndexError, SyntaxError, struct.error, zipfile.BadZipFile):
        return {"kind": kind}


def _png_shape(path: Path) -> list[int]:
    with open(path, "rb") as file:
        header = file.read(26)
    if header[:8] != b"\x89PNG\r\n\x1a\n":
        raise ValueError("not a PNG file")
    width, height = struct.unpack(">II", header[16:24])
    return [height, width, _PNG_CHANNELS[header[25]]]


def _exr_shape(path: Path) -> list[int]:
    with open(path, "rb") as file:
        data = file.read(1 << 16)
    if struct.unpack_from("<I", data)[0] != 20000630:
        raise ValueError("not an EXR file")
    position, window, channels = 8, None, 0
    while data[position]:
        name, position = _text(data, position)
        _, position = _text(data, position)
        size = struct.unpack_from("<i", data, position)[0]
        position += 4
        if name == b"dataWindow":
            window = struct.unpack_from("<4i", data, position)
        elif name == b"channels":
            channels = _channel_count(data[position:position + size])
        position += size
    x0, y0, x1, y1 = window if window else (0, 0, -1, -1)
    return [y1 - y0 + 1, x1 - x0 + 1, channels]


def _channel_count(data: bytes) -> int:
    position = count = 0
    while data[position]:
        _, position = _text(data, position)
        position += 16
        count += 1
    return count


def _text(data: bytes, start: int) -> tuple[bytes, int]:
    end = data.index(b"\0", start)
    return data[start:end], end + 1


def _npz_shapes(path: Path) -> dict[str, list[int]]:
    shapes = {}
    with zipfile.ZipFile(path) as archive:
        for name in sorted(archive.namelist()):
            with archive.open(name) as file:
                prefix = file.read(12)
                if prefix[:6] != b"\x93NUMPY":
                    raise ValueError("not an array")
                long = prefix[6] > 1
                size = struct.unpack("<I", prefix[8:12])[0] if long else struct.unpack("<H", prefix[8:10])[0]
                text = (b"" if long else prefix[10:]) + file.read(size if long else size - 2)
            shapes[name.removesuffix(".npy")] = list(ast.literal_eval(text.decode("latin-1"))["shape"])
    return shapes
