"""What a video and an image sequence have in common: facts about the source, and frames that convert when asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import av
import cv2
import numpy as np

from shared.errors import InputError
from shared.io.colour_tags import Conversion
from shared.io.orientation import Orientation
from shared.io.pixel_format import rgb_codes

if TYPE_CHECKING:
    from av.video.reformatter import VideoReformatter

MIN_SIDE_PX = 16
MAX_PIXELS = 7680 * 4352
MAX_FRAMES = 20_000
DEFAULT_FPS = 25.0
HINT_CODEC = "re-encode it: ffmpeg -i IN -pix_fmt yuv420p -c:v libx264 -crf 12 OUT.mp4"


@dataclass(frozen=True)
class VideoInfo:
    """Facts that hold for every frame of a source.

    width, height: px as shown, after `rotation` (degrees counter-clockwise that the pictures are turned by; `mirrored`
    ones are mirrored left to right before).
    frame_count: what the file states or its packets say. bits: per component. transfer_tag: the transfer function
    that the file names ("" for none, which is not the one that the subject states). focal_length_35mm: mm for a
    36 mm wide sensor, where the camera wrote it into the file. warnings: one sentence each.
    """

    width: int
    height: int
    fps: float
    frame_count: int
    codec: str
    rotation: int = 0
    mirrored: bool = False
    bits: int = 8
    transfer_tag: str = ""
    focal_length_35mm: float | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class SourceFrame:
    """One frame, not yet converted. index counts from 0; time_s from the first frame; fault: "" or what is wrong."""

    index: int
    time_s: float
    fault: str = ""

    def codes(self, size: tuple[int, int] | None = None) -> np.ndarray:
        """RGB code values [H, W, 3], uint8 or uint16, the right way up; size: (width, height) to scale to."""
        raise NotImplementedError


@dataclass(frozen=True)
class DecodedFrame(SourceFrame):
    """A picture that FFmpeg decoded, as stored; orientation: how it is shown; conversion: of its colours."""

    picture: av.VideoFrame | None = None
    reformatter: VideoReformatter | None = None
    orientation: Orientation = Orientation()
    conversion: Conversion | None = None

    def codes(self, size: tuple[int, int] | None = None) -> np.ndarray:
        """See SourceFrame."""
        stored_size = self.orientation.size(*size) if size else None
        try:
            codes = rgb_codes(self.reformatter, self.picture, stored_size)
        except (av.error.FFmpegError, ValueError) as error:
            raise InputError("pixels in a format that cannot be converted", where=f"frame {self.index}",
                             got=self.picture.format.name, hint=HINT_CODEC) from error
        return self.orientation.apply(codes if self.conversion is None else self.conversion.apply(codes))


@dataclass(frozen=True)
class ArrayFrame(SourceFrame):
    """A frame that is already an array of code values."""

    array: np.ndarray | None = None

    def codes(self, size: tuple[int, int] | None = None) -> np.ndarray:
        """See SourceFrame."""
        return self.array if size is None else cv2.resize(self.array, size, interpolation=cv2.INTER_AREA)


def check_size(width: int, height: int, where: str, smallest: int = MIN_SIDE_PX, largest: int = 0) -> None:
    """InputError for pictures too small to show anything or too large to decode safely.

    smallest: px each way. largest: pixels, MAX_PIXELS where 0.
    """
    largest = largest or MAX_PIXELS
    if min(width, height) < 1:
        raise InputError("the picture's size cannot be read", where=where, hint="copy the file again")
    if min(width, height) < smallest:
        raise InputError(
            "the picture is too small", where=where, got=f"{width} x {height} px",
            expected=f"{smallest} px or more each way", hint="use the original file",
        )
    if width * height > largest:
        raise InputError(
            "the picture is too large", where=where, got=f"{width} x {height} px",
            expected=f"{largest // 1_000_000} million pixels or fewer" + " (8K video)" * (largest == MAX_PIXELS),
            hint="scale the clip down" if largest == MAX_PIXELS else "scale it down",
        )


def check_length(frame_count: int, where: str) -> None:
    """InputError for more frames than a head turn can need."""
    if frame_count > MAX_FRAMES:
        raise InputError(
            "the clip is too long", where=where, got=f"{frame_count} frames or more",
            expected=f"{MAX_FRAMES} frames or fewer", hint="cut out the head turn (5 to 60 seconds)",
        )
