"""What the headers of an EXR state, read before any library decodes a pixel of it.

A few kilobytes of EXR can stand for gigabytes of pixels: many channels, many parts, large windows, large tiles. So the
headers are read here, bounded in length, and what decoding would take is counted.

Reference: "OpenEXR File Layout" (openexr.com), version 2.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path

from shared.errors import InputError
from shared.io.source import MAX_PIXELS, check_size

MOST_HEADER_BYTES = 4_000_000
MOST_PARTS, MOST_CHANNELS = 32, 128
PIXEL_BYTES = 16
"""Of all parts together once they are decoded, for each pixel of the largest picture: four channels of 32 bits."""
_MAGIC = b"\x76\x2f\x31\x01"
_DEEP, _MULTIPART = 0x800, 0x1000
_SAMPLE_BYTES = {0: 4, 1: 2, 2: 4}
_NUMBERS = {"float": "<f", "chromaticities": "<8f", "box2i": "<4i", "int": "<i"}
_TYPES = {"dataWindow": "box2i", "displayWindow": "box2i", "pixelAspectRatio": "float", "tiles": "tiledesc",
          "chromaticities": "chromaticities", "envmap": "envmap", "type": "string", "colorInteropID": "string",
          "channels": "chlist"}
_KEEP_CHANNELS = "oiiotool IN.exr --ch R,G,B -o OUT.exr"


@dataclass(frozen=True)
class Channel:
    """kind: 0 integers, 1 half floats, 2 floats. step: of its samples in x and y, px."""

    name: str
    kind: int
    step: tuple[int, int]


@dataclass(frozen=True)
class ExrPart:
    """One part. data, display: windows as (x0, y0, x1, y1), x1 and y1 outside; values: its other attributes of a plain
    type by name; deep: whether a pixel holds several samples.
    """

    channels: tuple[Channel, ...]
    data: tuple[int, int, int, int]
    display: tuple[int, int, int, int]
    values: dict[str, object]
    deep: bool

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the stored pixels."""
        return self.data[2] - self.data[0], self.data[3] - self.data[1]

    def bytes(self) -> int:
        """What its channels take in memory."""
        width, height = self.size
        return sum(_SAMPLE_BYTES.get(c.kind, 4) * math.ceil(width / c.step[0]) * math.ceil(height / c.step[1])
                   for c in self.channels)


def read_parts(path: Path | str) -> list[ExrPart]:
    """The parts of an EXR file, none of its pixels read. InputError where the headers are damaged or cut off."""
    try:
        with open(path, "rb") as file:
            data = file.read(MOST_HEADER_BYTES)
    except OSError as error:
        raise InputError("not a readable EXR", where=str(path), got=error.strerror) from error
    if data[:4] != _MAGIC:
        raise InputError("not a readable EXR", where=str(path), got="other first bytes")
    try:
        return _parts(data, str(path))
    except (struct.error, ValueError, KeyError, IndexError) as error:
        raise InputError("truncated EXR, or damaged in its header", where=str(path)) from error


def check_decodable(path: Path | str, most_pixels: int = MAX_PIXELS) -> ExrPart:
    """The first part, after all parts are found small enough to be decoded. InputError otherwise."""
    parts, where = read_parts(path), str(path)
    for part in parts:
        if part.deep:
            raise InputError("a deep EXR", where=where, expected="one sample a pixel",
                             hint="flatten it: oiiotool IN.exr --flatten -o OUT.exr")
        check_size(*part.size, where, smallest=1, largest=most_pixels)
        if any(edge > 4096 for edge in part.values.get("tiles", (1, 1))):
            raise InputError("the tiles of the EXR are too large", where=where, got=part.values["tiles"],
                             expected="4096 px or less each way", hint="oiiotool IN.exr --scanline -o OUT.exr")
    needed, most = sum(part.bytes() for part in parts), PIXEL_BYTES * most_pixels
    if needed > most:
        raise InputError("the EXR is too large once decoded", where=where, expected=f"{most >> 20} MB or less",
                         got=f"{sum(len(part.channels) for part in parts)} channels in {len(parts)} parts, "
                             f"{needed >> 20} MB", hint=f"keep the colour only: {_KEEP_CHANNELS}")
    return parts[0]


def _parts(data: bytes, where: str) -> list[ExrPart]:
    version, parts, at = struct.unpack_from("<I", data, 4)[0], [], 8
    while True:
        attributes, at = _attributes(data, at)
        if not attributes and parts:  # an empty header ends those of several parts
            return parts
        parts.append(_part(attributes, bool(version & _DEEP), where))
        if not version & _MULTIPART:
            return parts
        if len(parts) > MOST_PARTS:
            raise InputError("too many parts in the EXR", where=where, expected=f"{MOST_PARTS} or fewer",
                             hint=f"keep the colour only: {_KEEP_CHANNELS}")


def _attributes(data: bytes, at: int) -> tuple[dict[str, tuple[str, bytes]], int]:
    """{name: (type, value)} of one header that begins at `at`, and where it ends."""
    found: dict[str, tuple[str, bytes]] = {}
    while data[at] != 0:
        name, at = _word(data, at)
        kind, at = _word(data, at)
        length = struct.unpack_from("<i", data, at)[0]
        if length < 0 or at + 4 + length > len(data) or name in found:
            raise ValueError(f"{name} is cut off, or there twice")
        found[name] = kind, data[at + 4:at + 4 + length]
        at += 4 + length
    return found, at + 1


def _word(data: bytes, at: int) -> tuple[str, int]:
    """A text that ends with a zero byte, and what follows it."""
    end = data.index(0, at, at + 256)
    return data[at:end].decode("utf-8", errors="replace"), end + 1


def _part(attributes: dict[str, tuple[str, bytes]], deep: bool, where: str) -> ExrPart:
    values: dict[str, object] = {}
    for name, (kind, raw) in attributes.items():
        if _TYPES.get(name, kind) != kind:
            raise ValueError(f"{name} is of another type")
        if kind in _NUMBERS:
            numbers = struct.unpack(_NUMBERS[kind], raw)
            values[name] = numbers if len(numbers) > 1 else numbers[0]
        elif kind == "string":
            values[name] = raw.decode("utf-8", errors="replace")
        elif kind == "tiledesc":
            values[name] = struct.unpack_from("<2I", raw)
        elif kind == "envmap":
            values[name] = raw[0]
    data, display = (_window(values[name]) for name in ("dataWindow", "displayWindow"))
    deep = deep or str(values.get("type", "")).startswith("deep")
    return ExrPart(_channels(attributes["channels"][1], where), data, display, values, deep)


def _window(corners: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    return corners[0], corners[1], corners[2] + 1, corners[3] + 1


def _channels(raw: bytes, where: str) -> tuple[Channel, ...]:
    found, at = [], 0
    while raw[at] != 0:
        name, at = _word(raw, at)
        kind, _, step_x, step_y = struct.unpack_from("<iIii", raw, at)
        if step_x < 1 or step_y < 1:
            raise ValueError(f"{name}: no sampling")
        found.append(Channel(name, kind, (step_x, step_y)))
        at += 16
        if len(found) > MOST_CHANNELS:
            raise InputError("too many channels in the EXR", where=where, expected=f"{MOST_CHANNELS} or fewer",
                             hint=f"keep the colour only: {_KEEP_CHANNELS}")
    return tuple(found)
