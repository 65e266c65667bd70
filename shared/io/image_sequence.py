"""Numbered image files as a video: PNG, TIFF and JPEG through FFmpeg (8 and 16 bit), linear EXR through OpenEXR."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import VideoReformatter

from shared.errors import InputError
from shared.io.colour_tags import LINEAR, conversion_of
from shared.io.exr_picture import ExrPicture
from shared.io.image_tags import read_tags
from shared.io.orientation import Orientation
from shared.io.pixel_format import has_alpha
from shared.io.source import (
    DEFAULT_FPS,
    MAX_PIXELS,
    ArrayFrame,
    DecodedFrame,
    SourceFrame,
    VideoInfo,
    check_length,
    check_size,
)

KINDS = ".png .tif .tiff .jpg .jpeg .exr"
_DECODERS = {b"\x89PNG\r\n": "png", b"II*\0": "tiff", b"MM\0*": "tiff", b"\xff\xd8\xff": "mjpeg"}
"""First bytes -> FFmpeg's name."""
LARGEST_FILE = 16 * MAX_PIXELS
"""Bytes: twice the largest picture, 16 bits and four channels, as it is in memory."""
_COUNTER = re.compile(r"%(?:0?\d+)?d")


def is_sequence(path: Path | str) -> bool:
    """Whether the file name holds a printf counter such as %05d."""
    return _COUNTER.search(Path(path).name) is not None


class ImageSequenceReader:
    """Image files counted by a pattern; the lowest number is frame 0, a gap in the numbers a gap in time.

    An EXR counts as linear: its values from 0 to 1, times a gain that the first one sets, become the 16-bit code range;
    what is brighter is clipped.
    """

    def __init__(self, pattern: Path | str, transfer: str = "srgb") -> None:
        """Lists the files and reads the first. InputError where there is none or it cannot be read."""
        self.pattern = Path(pattern)
        self._files = _numbered_files(self.pattern)
        self._first_number = min(self._files)
        span = max(self._files) - self._first_number + 1
        check_length(span, str(self.pattern))
        first = self._files[self._first_number]
        self._reformatter, self._transfer, self._gain = VideoReformatter(), transfer, 1.0
        warnings = (f"{span - len(self._files)} numbers are missing in the sequence",) * (span != len(self._files))
        try:
            if _is_exr(first):
                warnings += self._look_at_exr(first)
            frame = self._opened(0, first)
        except InputError as error:
            raise InputError(f"the first image is unusable: {error.what}", where=str(first), got=error.got,
                             expected=error.expected, hint=error.hint) from error
        if frame.fault:
            raise InputError(f"the first image is unusable: {frame.fault}", where=str(first))
        codes = frame.codes()
        if isinstance(frame, DecodedFrame):
            warnings += ("the images' alpha channel is ignored",) * has_alpha(frame.picture)
            warnings += tuple(frame.conversion.warnings()) if frame.conversion else ()
        self.info = VideoInfo(
            width=codes.shape[1],
            height=codes.shape[0],
            fps=DEFAULT_FPS,
            frame_count=span,
            codec=first.suffix[1:].lower(),
            bits=codes.dtype.itemsize * 8,
            transfer_tag="linear" if _is_exr(first) or _is_linear(frame) else "",
            warnings=warnings,
        )

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        return ((frame.index, frame.codes()) for frame in self.frames())

    def frames(self, indices: Collection[int] | None = None, step: int = 1) -> Iterator[SourceFrame]:
        """Frames by rising index, every step-th of them or only those of `indices`; numbers without a file are left
        out."""
        wanted = None if indices is None else frozenset(indices)
        for number in sorted(self._files):
            index = number - self._first_number
            if index % step == 0 if wanted is None else index in wanted:
                yield self._checked(self._read(index, self._files[number]))

    def _look_at_exr(self, first: Path) -> tuple[str, ...]:
        """Sets the gain of all images; what there is to say about them."""
        _check_length_of(first)
        picture = ExrPicture.read(first)
        warnings = tuple(picture.warnings())
        self._gain = picture.gain()
        return warnings

    def _checked(self, frame: SourceFrame) -> SourceFrame:
        """The frame, with a fault where its size or its depth is not the first frame's."""
        if frame.fault:
            return frame
        codes = frame.codes()
        fault = ""
        if codes.shape[:2] != (self.info.height, self.info.width):
            fault = "its size differs from the first frame's"
        elif codes.dtype.itemsize * 8 != self.info.bits:
            fault = "its bit depth differs from the first frame's"
        return ArrayFrame(frame.index, frame.time_s, fault, codes)

    def _read(self, index: int, file: Path) -> SourceFrame:
        """The frame, with a fault where it cannot be used."""
        try:
            return self._opened(index, file)
        except InputError as error:
            return SourceFrame(index, _time(index), error.what)

    def _opened(self, index: int, file: Path) -> SourceFrame:
        """InputError where the file cannot be used."""
        _check_length_of(file)
        if _is_exr(file):
            return ArrayFrame(index, _time(index), "", ExrPicture.read(file).codes(self._gain))
        try:
            data = file.read_bytes()
            picture = _decoded(data, str(file))
        except (av.error.FFmpegError, OSError, StopIteration, IndexError) as error:
            raise InputError("not an image that can be read", where=str(file)) from error
        check_size(picture.width, picture.height, str(file))
        tags = read_tags(data)
        conversion = conversion_of(picture, self._transfer, str(file), tags.primaries(self._transfer, str(file)))
        fault = "damaged in the file" if picture.is_corrupt else ""
        orientation = Orientation.from_exif(tags.orientation)
        return DecodedFrame(index, _time(index), fault, picture, self._reformatter, orientation, conversion)


def _time(index: int) -> float:
    return round(index / DEFAULT_FPS, 6)


def _is_linear(frame: SourceFrame) -> bool:
    """Whether a PNG's gamma says so."""
    return isinstance(frame, DecodedFrame) and int(frame.picture.color_trc) == LINEAR


def _is_exr(file: Path) -> bool:
    return file.suffix.lower() == ".exr"


def _check_length_of(file: Path) -> None:
    if file.stat().st_size > LARGEST_FILE:
        raise InputError("the file is too large", where=str(file), got=f"{file.stat().st_size >> 20} MB",
                         expected=f"{LARGEST_FILE >> 20} MB or less")


def _decoded(data: bytes, where: str) -> av.VideoFrame:
    """The picture of a file, by its first bytes; StopIteration where they are none of _DECODERS.

    Without a container: that would decode the picture once more, to find out about its format.
    """
    context = av.CodecContext.create(next(name for start, name in _DECODERS.items() if data.startswith(start)), "r")
    context.options, context.thread_count = {"max_pixels": str(MAX_PIXELS)}, 1
    picture = (context.decode(av.Packet(data)) or context.decode(None))[0]
    if context.sample_aspect_ratio not in (None, 0, 1):
        raise InputError("the image's pixels are not square", where=where, got=f"{context.sample_aspect_ratio}",
                         expected="1:1", hint="scale the images to square pixels, or correct their density")
    return picture


def _numbered_files(pattern: Path) -> dict[int, Path]:
    """Number -> file for the one counter in the pattern's name."""
    if len(_COUNTER.findall(pattern.name)) != 1 or pattern.suffix.lower() not in KINDS.split():
        raise InputError("not a pattern for an image sequence", where=str(pattern), expected="frames/%05d.png",
                         hint=f"one counter in the file name, and one of {KINDS}")
    if not pattern.parent.is_dir():
        raise InputError("the folder of the image sequence is missing", where=str(pattern.parent))
    before, after = _COUNTER.split(pattern.name)
    name = re.compile(re.escape(before) + r"(\d{1,9})" + re.escape(after))
    matches = ((name.fullmatch(file.name), file) for file in sorted(pattern.parent.iterdir()))
    files = {int(match[1]): file for match, file in matches if match and file.is_file()}
    if not files:
        raise InputError("no image matches the pattern", where=str(pattern), hint="correct `video` in subject.yaml")
    return files
