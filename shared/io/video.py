"""Video files frame by frame through FFmpeg (PyAV): size, times, rotation and colour as the container states them.

PyAV instead of cv2.VideoCapture because the latter converts with a bias (see pixel_format.py), cuts 10-bit video to 8,
and hides colour tags, decoding errors and exact times.

Untrusted input: files are opened by the `file` protocol and a fixed list of containers only (no playlists, no network),
and size and length are bounded before anything is decoded.
"""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Collection, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import VideoReformatter

from shared.errors import InputError
from shared.io.colour_tags import conversion_of
from shared.io.image_sequence import ImageSequenceReader, is_sequence
from shared.io.orientation import Orientation
from shared.io.pixel_format import UNSPECIFIED_MATRIX, has_alpha
from shared.io.source import DEFAULT_FPS, MAX_PIXELS, DecodedFrame, SourceFrame, VideoInfo, check_length, check_size

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,gif,mpegts,mpeg,ogg,flv,asf,mxf,apng"
# Containers may count a few frames that never show (edit lists, a cut-off group of pictures at the end).
COMPLETE_SHARE = 0.95
MAX_THREADS = 4
MAX_STALL_CPU_S, MAX_READ_CPU_S = 60.0, 7200.0
"""Processor seconds for one frame and for reading the clip once. Not wall seconds: a busy machine is no fault."""
_TRANSFER_TAGS = {1: "bt709", 4: "gamma22", 6: "bt601", 8: "linear", 13: "srgb", 14: "bt2020", 15: "bt2020",
                  16: "pq", 18: "hlg"}
_HINT_DAMAGED = "copy the file again from the camera, or re-encode it: ffmpeg -i IN -c:v libx264 -crf 12 OUT.mp4"
_PLAIN_NUMBER = re.compile(r"[0-9]{1,4}(\.[0-9]{1,9})?")
_FOCAL_KEYS = ("com.apple.quicktime.camera.focal_length.35mm_equivalent",)


def probe(path: Path | str) -> VideoInfo:
    """Facts about a video file or an image sequence; InputError where no frame of it can be read."""
    return open_video(path).info


def open_video(path: Path | str, transfer: str = "srgb") -> VideoReader | ImageSequenceReader:
    """Reader for a video file, or for an image sequence where the name has a counter (`frames/%05d.png`).

    transfer: the function that codes of Rec.709 primaries stand for, to which tagged colours are converted.
    """
    return ImageSequenceReader(path, transfer) if is_sequence(path) else VideoReader(path, transfer)


class VideoReader:
    """Streams one video file: memory does not grow with its length. Iterating gives (frame_index, RGB codes)."""

    def __init__(self, path: Path | str, transfer: str = "srgb") -> None:
        """Reads the header and decodes the first frame. InputError for whatever cannot be read."""
        self.path = Path(path)
        _check_file(self.path)
        with _opened(self.path) as container:
            stream = _video_stream(container, self.path)
            check_size(stream.codec_context.width, stream.codec_context.height, str(self.path))
            first = next(_pictures(container, stream), None)
            if first is None:
                raise InputError("no frame of the video can be decoded", where=str(self.path), hint=_HINT_DAMAGED)
            self._orientation = Orientation.of_video(first, str(self.path))
            self._conversion = conversion_of(first, transfer, str(self.path))
            self._stored_size = first.width, first.height
            self._duration_s = _stated_duration(container)
            self.info = self._info(container, stream, first)
        check_length(self.info.frame_count, str(self.path))

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        return ((frame.index, frame.codes()) for frame in self.frames())

    def frames(self, indices: Collection[int] | None = None, step: int = 1) -> Iterator[SourceFrame]:
        """Frames in the order they are shown, every step-th of them or only those of `indices`.

        A frame is valid until the next one is asked for. Without `indices` the whole clip is decoded, which ends with
        InputError where far fewer frames do than the file states.
        """
        wanted = None if indices is None else frozenset(indices)
        last = max(wanted, default=-1) if wanted is not None else None
        count, time_s, reformatter = 0, -math.inf, VideoReformatter()
        with _opened(self.path) as container:
            stream = _video_stream(container, self.path)
            start = None
            for picture in _pictures(container, stream):
                if last is not None and count > last:
                    return
                start = picture.pts if start is None else start
                time_s = self._time(picture, start, time_s)
                if count % step == 0 if wanted is None else count in wanted:
                    yield DecodedFrame(count, time_s, self._fault(picture), picture, reformatter, self._orientation,
                                       self._conversion)
                count += 1
                check_length(count, str(self.path))
        if wanted is None:
            self._check_complete(count, time_s)

    def _time(self, picture: av.VideoFrame, start: int | None, previous_s: float) -> float:
        """Seconds since the first frame; where the file gives no later time than the last, one frame later."""
        if picture.pts is not None and start is not None and picture.time_base is not None:
            time_s = float((picture.pts - start) * picture.time_base)
            if time_s > previous_s:
                return round(time_s, 6)
        return 0.0 if previous_s == -math.inf else round(previous_s + 1 / self.info.fps, 6)

    def _fault(self, picture: av.VideoFrame) -> str:
        if (picture.width, picture.height) != self._stored_size:
            return "its size differs from the first frame's"
        return "damaged in the file" if picture.is_corrupt else ""

    def _check_complete(self, count: int, last_s: float) -> None:
        """InputError where frames are missing that the header counts, or seconds that it states."""
        short = last_s + 2 / self.info.fps < COMPLETE_SHARE * self._duration_s
        if count < COMPLETE_SHARE * self.info.frame_count or short:
            stated = f"{self._duration_s:.1f} s" if short else f"{self.info.frame_count} frames"
            raise InputError(
                "the video is cut off or damaged", where=str(self.path), got=f"{count} frames, {max(last_s, 0):.1f} s",
                expected=f"{stated} as its header states", hint=_HINT_DAMAGED,
            )

    def _info(self, container: av.container.InputContainer, stream: av.VideoStream, first: av.VideoFrame) -> VideoInfo:
        width, height = self._orientation.size(first.width, first.height)
        return VideoInfo(
            width=width,
            height=height,
            fps=_frame_rate(stream),
            frame_count=_frame_count(stream, self.path),
            codec=stream.codec_context.name,
            rotation=self._orientation.quarter_turns * 90,
            mirrored=self._orientation.mirrored,
            bits=max(component.bits for component in first.format.components),
            transfer_tag=_TRANSFER_TAGS.get(int(stream.codec_context.color_trc or 2), ""),
            focal_length_35mm=_focal_length(container, stream),
            warnings=(*_warnings(container, stream, first, self.path),
                      *(self._conversion.warnings() if self._conversion else ())),
        )


def _check_file(path: Path) -> None:
    if path.is_dir():
        raise InputError("a folder is not a video", where=str(path), hint="for image files give frames/%05d.png")
    if not path.is_file():
        raise InputError("the video is missing", where=str(path), hint="correct `video` in subject.yaml")
    if path.stat().st_size == 0:
        raise InputError("the video is empty", where=str(path), got="0 bytes", hint="copy the file again")
    if not os.access(path, os.R_OK):
        raise InputError("the video cannot be opened", where=str(path), got="permission denied")


def _opened(path: Path) -> av.container.InputContainer:
    """The container, as a context manager."""
    try:
        return av.open(f"file:{path}", options={"protocol_whitelist": "file", "format_whitelist": CONTAINERS})
    except (av.error.FFmpegError, OSError) as error:
        raise InputError(
            "not a video that can be read (wrong kind of file, or cut off)", where=str(path),
            got=error.strerror or error, expected="mp4, mov, mkv, webm, avi or gif", hint=_HINT_DAMAGED,
        ) from error


def _video_stream(container: av.container.InputContainer, path: Path) -> av.VideoStream:
    """The largest stream of moving pictures (cover art does not count), the first of equals; for safe decoding."""
    streams = _moving_pictures(container)
    if streams:
        stream = max(streams, key=lambda s: s.codec_context.width * s.codec_context.height)
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = min(MAX_THREADS, os.cpu_count() or 1)
        stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
        return stream
    kinds = ", ".join(stream.type for stream in container.streams) or "nothing"
    raise InputError("no video stream in the file", where=str(path), got=kinds, hint="point `video` at the clip itself")


def _moving_pictures(container: av.container.InputContainer) -> list[av.VideoStream]:
    return [stream for stream in container.streams.video
            if not stream.disposition & av.stream.Disposition.attached_pic and stream.codec_context is not None]


def _pictures(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[av.VideoFrame]:
    """Decoded pictures; packets that cannot be decoded are passed over, a broken file ends the stream.

    InputError where a picture, or all of them, take more processor time than any real clip needs.
    """
    packets, spent, since_picture = container.demux(stream), 0.0, 0.0
    while True:
        start = time.process_time()
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            return
        if packet is None:
            return
        try:
            pictures = packet.decode()
        except (av.error.FFmpegError, MemoryError):
            pictures = []
        seconds = time.process_time() - start
        spent, since_picture = spent + seconds, 0.0 if pictures else since_picture + seconds
        if max(seconds, since_picture) > MAX_STALL_CPU_S or spent > MAX_READ_CPU_S:
            raise InputError("decoding takes too long", where=container.name.removeprefix("file:"),
                             got=f"{spent:.0f} processor seconds", hint="cut out the head turn, or scale the clip down")
        yield from pictures


def _frame_rate(stream: av.VideoStream) -> float:
    rate = stream.average_rate or stream.guessed_rate
    return float(rate) if rate and 0.1 <= rate <= 1000 else DEFAULT_FPS


def _frame_count(stream: av.VideoStream, path: Path) -> int:
    """The header's count, or the packets counted."""
    if stream.frames:
        return stream.frames
    with _opened(path) as again:
        packets = 0
        for packet in again.demux(_video_stream(again, path)):
            packets += packet.size > 0
            check_length(packets, str(path))
    return packets


def _stated_duration(container: av.container.InputContainer) -> float:
    """Seconds that the header states for the pictures alone; 0 where it does not (or sound may be longer)."""
    if container.format.name.startswith("matroska") and not container.streams.audio and container.duration:
        return float(Fraction(container.duration, av.time_base))
    return 0.0


def _focal_length(container: av.container.InputContainer, stream: av.VideoStream) -> float | None:
    """35 mm equivalent focal length that phones write into the file, in mm."""
    for key in _FOCAL_KEYS:
        text = container.metadata.get(key) or stream.metadata.get(key) or ""
        if _PLAIN_NUMBER.fullmatch(text) and 5 <= float(text) <= 500:
            return float(text)
    return None


def _warnings(container: av.container.InputContainer, stream: av.VideoStream, first: av.VideoFrame,
              path: Path) -> Iterator[str]:
    ratio = stream.sample_aspect_ratio
    if ratio and ratio not in (0, 1):
        raise InputError("the video's pixels are not square", where=str(path), got=f"{ratio}", expected="1:1",
                         hint="ffmpeg -i IN -vf scale=iw*sar:ih,setsar=1 -c:v libx264 -crf 12 OUT.mp4")
    if (count := len(_moving_pictures(container))) > 1:
        yield f"the file holds {count} videos: the largest, {first.width} x {first.height} px, is taken"
    if first.interlaced_frame:
        yield "the video is interlaced: film progressive, or de-interlace it first"
    if has_alpha(first) and stream.codec_context.name != "gif":
        yield "the video's alpha channel is ignored"
    if first.colorspace == UNSPECIFIED_MATRIX and not first.format.is_rgb and len(first.format.components) >= 3:
        yield "the video does not say its colour matrix: BT.709 assumed from 1280 x 577 px on, BT.601 below"
