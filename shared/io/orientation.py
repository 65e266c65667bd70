"""How stored pictures are turned and mirrored before they are shown: display matrices of videos, orientation of photos.

References: ISO/IEC 14496-12, 6.2.2 (matrices); Exif 2.32, tag 274 (orientation).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import av
import numpy as np
from av.sidedata.sidedata import Type

from shared.errors import InputError

LARGEST_TILT_DEG = 2.0
_BY_EXIF = {1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (1, True), 6: (3, False), 7: (3, True),
            8: (1, False)}


@dataclass(frozen=True)
class Orientation:
    """First mirrored, left to right, then turned by so many quarters counter-clockwise."""

    quarter_turns: int = 0
    mirrored: bool = False

    @classmethod
    def from_exif(cls, value: int) -> Orientation:
        """Of a photo; as stored where the value is none of Exif's."""
        return cls(*_BY_EXIF.get(value, (0, False)))

    @classmethod
    def from_matrix(cls, matrix: Sequence[int], where: str) -> Orientation:
        """Of a video's display matrix a, b, u, c, d, v, x, y, w: x' = a x + c y, y' = b x + d y, y down.

        InputError where it does more than to turn by quarters and to mirror.
        """
        a, b, c, d = (float(matrix[i]) for i in (0, 1, 3, 4))
        mirrored = a * d - b * c < 0
        across = (-a, -b) if mirrored else (a, b)  # where the picture's right side goes, once it is mirrored
        lengths = math.hypot(a, b), math.hypot(c, d)
        if min(lengths) == 0 or abs(a * c + b * d) > 0.01 * lengths[0] * lengths[1]:
            raise InputError("the video's display matrix is none that a camera writes", where=where,
                             got=f"{[int(value) for value in matrix]}", hint=_HINT_MATRIX)
        if abs(lengths[0] / lengths[1] - 1) > 0.01:
            raise InputError("the video's display matrix stretches it: its pixels are not square", where=where,
                             got=f"{lengths[0] / lengths[1]:.3g}:1", hint=_HINT_MATRIX)
        turned = math.degrees(math.atan2(-across[1], across[0]))
        quarters = round(turned / 90)
        if abs(turned - 90 * quarters) > LARGEST_TILT_DEG:
            raise InputError("the video's display matrix turns it by no quarter turn", where=where,
                             got=f"{turned:.0f} degrees", expected="0, 90, 180 or 270", hint=_HINT_MATRIX)
        return cls(quarters % 4, mirrored)

    @classmethod
    def of_video(cls, picture: av.VideoFrame, where: str) -> Orientation:
        """As players show the video: by its display matrix."""
        try:
            matrix = next((bytes(data) for data in picture.side_data if data.type == Type.DISPLAYMATRIX), None)
        except ValueError:  # side data of a kind that PyAV has no name for hides the rest; the angle is left
            return cls(round(picture.rotation / 90) % 4)
        return cls() if matrix is None else cls.from_matrix(struct.unpack("=9i", matrix), where)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) as shown of one as stored, or the other way round."""
        return (height, width) if self.quarter_turns % 2 else (width, height)

    def apply(self, codes: np.ndarray) -> np.ndarray:
        """[H, W, 3] as stored -> as shown."""
        return np.ascontiguousarray(np.rot90(codes[:, ::-1] if self.mirrored else codes, self.quarter_turns))


_HINT_MATRIX = "write it the right way round: ffmpeg -i IN -c:v libx264 -crf 12 OUT.mp4, or take the tag off"
