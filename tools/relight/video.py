"""Pictures as a video that plays everywhere: H.264 in MP4, BT.709, written whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace


def write_video(path: Path, pictures: Iterable[np.ndarray], fps: int) -> None:
    """sRGB-coded uint8 pictures [h, w, 3] of one even size -> path (.mp4)."""
    unfinished = path.with_name(f".{path.name}.partial")
    try:
        # The index in front, so that a browser plays it while it loads.
        with av.open(str(unfinished), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            stream = None
            for picture in pictures:
                if stream is None:
                    stream = container.add_stream("libx264", rate=fps, options={"crf": "16", "preset": "medium"})
                    stream.height, stream.width = picture.shape[:2]
                    stream.pix_fmt = "yuv420p"
                    # 1 is BT.709 in the tables of H.273.
                    context = stream.codec_context
                    context.color_primaries, context.color_trc, context.colorspace = 1, 1, 1
                    context.color_range = ColorRange.MPEG
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                coded = frame.reformat(
                    format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
                )
                container.mux(stream.encode(coded))
            container.mux(stream.encode())
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
