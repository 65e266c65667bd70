"""A frame of a clip as EXR: scene-linear Rec.709 in the display window, whatever the file's primaries and windows.

What its header says about the picture is followed or refused, never passed over. One value is a choice: an EXR's scale
is free, 16-bit codes have a largest value, so a gain that the first frame of a clip sets belongs to all of them.

Reference: "Technical Introduction to OpenEXR" and "Standard Attributes" (openexr.com).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR

from shared.errors import InputError
from shared.imaging.color import rec709_from_primaries
from shared.io.exr_header import ExrPart, check_decodable, read_parts
from shared.io.images import read_exr
from shared.io.source import check_size

LARGEST_CODE = 65535
SAME_PRIMARIES = 2e-3
"""Matrices this near to one are one: primaries are often written with three digits."""
BRIGHT_SHARE, DARK_LEVEL = 0.25, 1 / 32
NEGATIVE_WARNING, NEGATIVE_LIMIT = 0.001, 0.05
_ROWS, _SAMPLES = 256, 250_000
_GREY = ("Y", "L")


@dataclass(frozen=True)
class ExrPicture:
    """planes: red, green and blue, or grey alone, each [H, W] of the data window; matrix: to Rec.709, or None."""

    planes: tuple[np.ndarray, ...]
    part: ExrPart
    matrix: np.ndarray | None

    @classmethod
    def read(cls, path: Path | str) -> ExrPicture:
        """InputError for what is damaged, too large, or no picture of a camera."""
        part, where = check_decodable(path), str(path)
        _check_attributes(part, where)
        matrix = _matrix(part, where)
        x0, y0, x1, y1 = part.display
        check_size(x1 - x0, y1 - y0, where)
        names = _names(part, where)
        try:
            with OpenEXR.File(where, separate_channels=True) as file:
                if not file.parts:
                    raise InputError("truncated EXR", where=where)
                stored = file.parts[0].channels
                planes = tuple(stored[name].pixels for name in names)
        except (RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
            raise InputError("not a readable EXR", where=where, got=error) from error
        if any(plane.shape != part.size[::-1] for plane in planes):
            raise InputError("not a readable EXR", where=where, got="pixels of another size than its header states")
        if not all(np.isfinite(plane).all() for plane in planes):
            raise InputError("NaN or infinite values", where=where)
        return cls(planes, part, matrix)

    def codes(self, gain: float = 1.0) -> np.ndarray:
        """uint16 [H, W, 3] of the display window: values times gain from 0 to 1; nothing is black, as is what the data
        window leaves out.
        """
        x0, y0, x1, y1 = self.part.display
        codes = np.zeros((y1 - y0, x1 - x0, 3), np.uint16)
        left, top, right, bottom = self._shared_window()
        for y in range(top, bottom, _ROWS):
            end = min(y + _ROWS, bottom)
            linear = self._rows(slice(y, end), slice(left, right)) * np.float32(gain)
            target = codes[y + self._offset[1]:end + self._offset[1], left + self._offset[0]:right + self._offset[0]]
            target[:] = np.rint(linear.clip(0, 1) * LARGEST_CODE).astype(np.uint16)
        return codes

    def gain(self) -> float:
        """A power of two that brings the picture into the range of the codes; 1 where it is there.

        It is not where a quarter of its values would be clipped, or where all but the brightest fiftieth of its pixels
        are darker than a 32nd of the range.
        """
        values = self._some()
        level = float(np.percentile(values.max(axis=-1), 98))
        if level <= 0 or (np.mean(values > 1) < BRIGHT_SHARE and level >= DARK_LEVEL):
            return 1.0
        return 2.0 ** -math.ceil(math.log2(level))

    def negative_share(self) -> float:
        """The negative values' sum over that of all, signs aside."""
        values = self._some()
        return float(-values[values < 0].sum(dtype=float) / max(np.abs(values).sum(dtype=float), 1e-30))

    def warnings(self) -> list[str]:
        """What the first picture of a clip lets say about all of it. InputError where too much is negative."""
        found, gain, negative = [], self.gain(), self.negative_share()
        if negative > NEGATIVE_LIMIT:
            raise InputError("the EXR holds negative light", got=f"{negative:.0%} of its values' sum",
                             expected="scene-linear values above 0",
                             hint="take black level and grading off, or map the gamut into Rec.709")
        if negative > NEGATIVE_WARNING:
            found.append(f"negative values count as zero: {negative:.1%} of the light in the first image")
        if self.matrix is not None:
            found.append("the images' primaries are not Rec.709's: their colours are converted")
        if gain != 1.0:
            factor = f"multiplied by {gain:g}" if gain > 1 else f"divided by {1 / gain:g}"
            found.append(f"the images' values do not lie between 0 and 1: all are {factor}")
        if self.part.data != self.part.display:
            found.append("the images' data window is not their display window: the latter is taken, black where empty")
        return found

    @property
    def _offset(self) -> tuple[int, int]:
        """Where the data window's first pixel stands in the display window."""
        return self.part.data[0] - self.part.display[0], self.part.data[1] - self.part.display[1]

    def _shared_window(self) -> tuple[int, int, int, int]:
        """What both windows show, in pixels of the data window: left, top, right, bottom; may be empty."""
        data, display = self.part.data, self.part.display
        low = [max(data[axis], display[axis]) - data[axis] for axis in (0, 1)]
        high = [min(data[axis + 2], display[axis + 2]) - data[axis] for axis in (0, 1)]
        return low[0], low[1], max(high[0], low[0]), max(high[1], low[1])

    def _rows(self, rows: slice, columns: slice) -> np.ndarray:
        """float32 [h, w, 3] linear Rec.709."""
        linear = np.stack([plane[rows, columns] for plane in self.planes], axis=-1).astype(np.float32)
        if len(self.planes) == 1:
            return np.repeat(linear, 3, axis=-1)
        return linear if self.matrix is None else linear @ self.matrix.T.astype(np.float32)

    def _some(self) -> np.ndarray:
        """Pixels [h, w, 3] spread over what both windows show; InputError where that is nothing."""
        left, top, right, bottom = self._shared_window()
        if left >= right or top >= bottom:
            raise InputError("the EXR's data window lies outside its display window")
        step = max(1, math.isqrt((right - left) * (bottom - top) // _SAMPLES))
        return self._rows(slice(top, bottom, step), slice(left, right, step))


def read_rec709(path: Path | str) -> np.ndarray:
    """-> float32 [H, W] or [H, W, 3] in linear Rec.709, as stored otherwise: for maps and lights of any scale.

    InputError where the file cannot be read or its primaries span nothing.
    """
    image, matrix = read_exr(path), _matrix(read_parts(path)[0], str(path))
    return image if matrix is None or image.ndim == 2 else image @ matrix.T.astype(np.float32)


def _check_attributes(part: ExrPart, where: str) -> None:
    ratio = part.values.get("pixelAspectRatio", 1.0)
    if not abs(ratio - 1) < 1e-3:
        (width, height), known = part.size, 0.1 < ratio < 10
        size = f" --resize {round(width * ratio)}x{height} --attrib PixelAspectRatio 1" if known else ""
        raise InputError("the EXR's pixels are not square", where=where, got=f"pixelAspectRatio {ratio:g}",
                         expected="1", hint=f"scale the images to square pixels: oiiotool IN.exr{size} -o OUT.exr")
    if "envmap" in part.values:
        raise InputError("the EXR is an environment map", where=where, expected="a picture of a camera")
    space = str(part.values.get("colorInteropID", ""))
    if space and not space.startswith("lin_") and space not in ("data", "unknown"):
        raise InputError("the EXR is not linear", where=where, got=space, expected="scene-linear values",
                         hint="oiiotool IN.exr --tocolorspace lin_rec709_scene -o OUT.exr")


def _matrix(part: ExrPart, where: str) -> np.ndarray | None:
    """[3, 3] to Rec.709; None where the primaries are Rec.709's, as they are where nothing is said."""
    given = part.values.get("chromaticities")
    if given is None:
        space = str(part.values.get("colorInteropID", ""))
        given = OpenEXR.colorInteropIDToChromaticities(space) if space.startswith("lin_") else None
    try:
        matrix = np.eye(3) if given is None else rec709_from_primaries(given)
    except ValueError as error:
        raise InputError("the EXR's chromaticities span no colours", where=where, got=error) from error
    return None if np.abs(matrix - np.eye(3)).max() < SAME_PRIMARIES else matrix


def _names(part: ExrPart, where: str) -> tuple[str, ...]:
    """The channels of the picture."""
    known = {channel.name: channel for channel in part.channels}
    names = ("R", "G", "B") if all(name in known for name in "RGB") else ()
    if not names and len(known) <= 2:
        names = tuple(name for name in _GREY if name in known)
    if not names:
        raise InputError("an EXR of other channels", where=where, got=", ".join(sorted(known)) or "none",
                         expected="R, G and B, or Y alone (not luminance and chroma)",
                         hint="name the picture's own channels: oiiotool IN.exr --ch R=...,G=...,B=... -o OUT.exr")
    if any(known[name].kind == 0 or known[name].step != (1, 1) for name in names):
        raise InputError("an EXR of other channels", where=where, got="integers, or channels of lower resolution",
                         expected="half or float, one value for each pixel")
    return names
