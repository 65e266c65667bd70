"""What JPEG, PNG and TIFF files say of their pictures besides the pixels: orientation and ICC profile.

Read from the bytes, since the decoder hands neither mirrored orientations nor profiles on.

References: JPEG (ITU-T T.81, B.1) with Exif 2.32 and ICC.1:2022 annex B.4; PNG (W3C, third edition) 11.3; TIFF 6.0.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from shared.errors import InputError
from shared.imaging.color import decode_transfer, rec709_from_primaries
from shared.io.colour_tags import PRIMARIES

MOST_PROFILE_BYTES = 4_000_000
SAME_PRIMARIES, SAME_CURVE = 0.02, 0.03
_ORIENTATION, _PROFILE = 274, 34675
_TYPE_BYTES = {1: 1, 3: 2, 4: 4, 7: 1}
_SRGB_D50 = np.array([[0.4361, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]])
"""XYZ under D50 from linear sRGB, as its profiles hold it."""
_HINT = "convert the images to sRGB, e.g. magick IN -profile sRGB.icc OUT"


@dataclass(frozen=True)
class ImageTags:
    """orientation: Exif's number, 1 where nothing is said; profile: the ICC profile, b"" for none."""

    orientation: int = 1
    profile: bytes = b""

    def primaries(self, transfer: str, where: str) -> int:
        """Number of the profile's primaries (H.273), 1 where there is no profile of colours.

        InputError for primaries that have none, and for curves that are not those of `transfer`.
        """
        if not self.profile:
            return 1
        try:
            tags = _profile_tags(self.profile)
            if self.profile[16:20] == b"GRAY":
                return 1
            columns = np.stack([_xyz(tags[name]) for name in (b"rXYZ", b"gXYZ", b"bXYZ")], axis=1)
            middle = _curve_at_half(tags[b"gTRC"])
        except (KeyError, struct.error, ValueError, IndexError) as error:
            raise InputError("the ICC profile is none of three lights", where=where, hint=_HINT) from error
        stated = float(decode_transfer(np.array(0.5), transfer))
        if abs(middle - stated) > SAME_CURVE:
            raise InputError(f"the ICC profile's curve is not that of transfer: {transfer}", where=where,
                             got=f"half the code is {middle:.3f} of the light", expected=f"{stated:.3f}",
                             hint=f"correct colour.transfer, or {_HINT}")
        matrix = np.linalg.solve(_SRGB_D50, columns)
        known = {1: np.eye(3)} | {number: rec709_from_primaries(xy) for number, (_, xy) in PRIMARIES.items()}
        nearest = min(known, key=lambda number: np.abs(known[number] - matrix).max())
        if not np.abs(known[nearest] - matrix).max() < SAME_PRIMARIES:
            raise InputError("the ICC profile's primaries are not known", where=where, hint=_HINT)
        return nearest


def read_tags(data: bytes) -> ImageTags:
    """Of a whole file; what is damaged or cut off counts as not said."""
    readers = {b"\xff\xd8": _of_jpeg, b"\x89P": _of_png, b"II": _of_tiff, b"MM": _of_tiff}
    try:
        return readers.get(data[:2], lambda _: ImageTags())(data)
    except (struct.error, IndexError, zlib.error, ValueError):
        return ImageTags()


def _of_jpeg(data: bytes) -> ImageTags:
    at, orientation, profile = 2, 1, b""
    while data[at] == 0xFF and data[at + 1] != 0xDA:
        length = struct.unpack_from(">H", data, at + 2)[0]
        kind, body = data[at + 1], data[at + 4:at + 2 + length]
        if kind == 0xE1 and body.startswith(b"Exif\0\0"):
            orientation = _of_tiff(body[6:]).orientation
        elif kind == 0xE2 and body.startswith(b"ICC_PROFILE\0") and len(profile) < MOST_PROFILE_BYTES:
            profile += body[14:]
        at += 2 + length
    return ImageTags(orientation, profile)


def _of_png(data: bytes) -> ImageTags:
    at, orientation, profile = 8, 1, b""
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        body = data[at + 8:at + 8 + length]
        if kind == b"iCCP":
            profile = zlib.decompressobj().decompress(body[body.index(0) + 2:], MOST_PROFILE_BYTES)
        elif kind == b"eXIf":
            orientation = _of_tiff(body).orientation
        at += 12 + length
    return ImageTags(orientation, profile)


def _of_tiff(data: bytes) -> ImageTags:
    """The first directory of a TIFF file, or of a block of Exif."""
    order = "<" if data[:2] == b"II" else ">"
    start = struct.unpack_from(f"{order}I", data, 4)[0]
    found = {}
    for i in range(struct.unpack_from(f"{order}H", data, start)[0]):
        at = start + 2 + 12 * i
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, at)
        if tag in (_ORIENTATION, _PROFILE) and kind in _TYPE_BYTES:
            length = min(count * _TYPE_BYTES[kind], MOST_PROFILE_BYTES)
            place = at + 8 if length <= 4 else struct.unpack_from(f"{order}I", data, at + 8)[0]
            found[tag] = data[place:place + length]
    orientation = struct.unpack(f"{order}H", found[_ORIENTATION][:2])[0] if _ORIENTATION in found else 1
    return ImageTags(orientation, found.get(_PROFILE, b""))


def _profile_tags(profile: bytes) -> dict[bytes, bytes]:
    count = struct.unpack_from(">I", profile, 128)[0]
    if count > 200:
        raise ValueError("too many tags")
    entries = [struct.unpack_from(">4sII", profile, 132 + 12 * i) for i in range(count)]
    return {name: profile[start:start + length] for name, start, length in entries}


def _xyz(tag: bytes) -> np.ndarray:
    return np.array(struct.unpack_from(">3i", tag, 8)) / 65536


def _curve_at_half(tag: bytes) -> float:
    """Light of half the largest code."""
    if tag[:4] == b"curv":
        count = struct.unpack_from(">I", tag, 8)[0]
        if count == 0:
            return 0.5
        values = np.array(struct.unpack_from(f">{min(count, 65536)}H", tag, 12))
        if count == 1:
            return float(0.5 ** (values[0] / 256))
        return float(np.interp(0.5, np.linspace(0, 1, len(values)), values / 65535))
    if tag[:4] == b"para":
        kind = struct.unpack_from(">H", tag, 8)[0]
        given = np.array(struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", tag, 12)) / 65536
        gamma, a, b = (given[0], 1.0, 0.0) if kind == 0 else given[:3]
        with np.errstate(over="ignore"):
            return float(max(a * 0.5 + b, 0.0) ** gamma)  # half lies above the straight part of all in use
    raise ValueError("no curve")
