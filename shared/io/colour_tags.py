"""Colours of a video as its tags state them, to code values of Rec.709 primaries in the subject's transfer function.

The transfer function of SDR is the subject's to state: cameras tag BT.709 whatever they do. Primaries, PQ and HLG are
followed, since no camera writes them by mistake and the difference is large.

Reference: ITU-T H.273 (numbers of primaries and transfer characteristics).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import av
import numpy as np

from shared.errors import InputError
from shared.imaging.color import decode_hlg, decode_pq, decode_transfer, encode_transfer, rec709_from_primaries

UNSPECIFIED, LINEAR = 2, 8
_D65, _C = (0.3127, 0.3290), (0.310, 0.316)
_BT2020 = 9
PRIMARIES = {
    4: ("NTSC 1953", (0.67, 0.33, 0.21, 0.71, 0.14, 0.08, *_C)),
    5: ("BT.601 (625 lines)", (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *_D65)),
    6: ("BT.601 (525 lines)", (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65)),
    7: ("SMPTE 240M", (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65)),
    8: ("film", (0.681, 0.319, 0.243, 0.692, 0.145, 0.049, *_C)),
    9: ("BT.2020", (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65)),
    11: ("DCI-P3", (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351)),
    12: ("Display P3", (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65)),
    22: ("EBU 3213", (0.630, 0.340, 0.295, 0.605, 0.155, 0.077, *_D65)),
}
"""By number: name, and x and y of red, green, blue and white. Rec.709's own (1) and what is reserved are left out."""
HDR = {16: "pq", 18: "hlg"}
_NO_LIGHT = {9: "logarithmic", 10: "logarithmic", 17: "SMPTE ST 428"}
_XYZ = 10
_HINT = "convert it to Rec.709 first, or to linear EXR with transfer: linear"
_GRID, _ROWS = 65535, 256


@dataclass(frozen=True)
class Conversion:
    """primaries: number, UNSPECIFIED or 1 for Rec.709's; hdr: "pq", "hlg" or ""; transfer: of the result, and of the
    source where hdr is "".
    """

    primaries: int
    hdr: str
    transfer: str

    def apply(self, codes: np.ndarray) -> np.ndarray:
        """RGB codes [H, W, 3] of the source -> of Rec.709 in `transfer`; uint16 where the source is deep or HDR."""
        kind = np.uint16 if self.hdr else codes.dtype
        light, encode = _light(codes.dtype.type, self.hdr, self.transfer), _codes(kind, self.transfer)
        matrix = _matrix(self.primaries)
        out = np.empty(codes.shape, kind)
        for y in range(0, len(codes), _ROWS):
            linear = light[codes[y:y + _ROWS]] @ matrix.T
            out[y:y + _ROWS] = encode[np.rint(_GRID * np.sqrt(linear.clip(0, 1))).astype(np.uint16)]
        return out

    def warnings(self) -> list[str]:
        """What is done, in words."""
        hdr = [f"the colours are HDR ({self.hdr}): they are converted to linear light"] * bool(self.hdr)
        name = PRIMARIES[self.primaries][0] if self.primaries in PRIMARIES else ""
        return hdr + [f"the colours are {name}: they are converted to Rec.709"] * bool(name)


def conversion_of(picture: av.VideoFrame, transfer: str, where: str, profile: int = 1) -> Conversion | None:
    """None where the codes are what the subject says. InputError for tags that say: no light of a camera.

    profile: primaries of an ICC profile, which count where the picture's own tags are silent.
    """
    primaries, curve = int(picture.color_primaries), int(picture.color_trc)
    if curve in _NO_LIGHT or primaries == _XYZ:
        raise InputError("the pictures' colours are tagged as what is not converted", where=where,
                         got=_NO_LIGHT.get(curve, "CIE XYZ"), hint=_HINT)
    hdr = HDR.get(curve, "")
    primaries = profile if profile != 1 and primaries == UNSPECIFIED else primaries
    if hdr and primaries == UNSPECIFIED:
        primaries = _BT2020  # as players do: no other primaries are in use with these curves
    if not hdr and primaries not in PRIMARIES:
        return None
    return Conversion(primaries, hdr, transfer)


@cache
def _matrix(primaries: int) -> np.ndarray:
    """[3, 3] float32 to Rec.709."""
    chromaticities = PRIMARIES[primaries][1] if primaries in PRIMARIES else None
    return (np.eye(3) if chromaticities is None else rec709_from_primaries(chromaticities)).astype(np.float32)


@cache
def _light(kind: type, hdr: str, transfer: str) -> np.ndarray:
    """[codes] float32: linear light of each code."""
    values = np.arange(np.iinfo(kind).max + 1) / np.iinfo(kind).max
    linear = {"pq": decode_pq, "hlg": decode_hlg}[hdr](values) if hdr else decode_transfer(values, transfer)
    return linear.astype(np.float32)


@cache
def _codes(kind: type, transfer: str) -> np.ndarray:
    """[65536] codes over the square root of linear light, which keeps the shadows' steps fine."""
    most = np.iinfo(kind).max
    return np.rint(most * encode_transfer((np.arange(_GRID + 1) / _GRID) ** 2, transfer)).astype(kind)
