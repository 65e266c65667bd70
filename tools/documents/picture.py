"""The README's picture: a frame, its re-render, their difference, and the albedo map, side by side.

    python -m tools.documents.picture SUBJECT [OUT.jpg]     from a finished run in the subject's folder
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from shared.imaging.color import encode_srgb
from shared.io.arrays import read_json
from shared.io.frames import FrameSet
from shared.io.images import read_exr

HEIGHT = 420
ERROR_RANGE = 0.05
BACKGROUND = 0.35
"""How much of the frame shows behind the re-rendered head."""


def compose(subject: Path) -> np.ndarray:
    """[HEIGHT, W, 3] uint8 RGB from a subject's work/ and export/ folders."""
    frames = FrameSet.open(subject / "work" / "sample_frames")
    rendered = read_json(subject / "work" / "inverse_render" / "solve.json")["render_frames"]
    frame_index = rendered[len(rendered) // 3]
    frame = encode_srgb(frames.read_linear(frames.position(frame_index)))
    render = read_exr(subject / "work" / "inverse_render" / "renders" / f"{frame_index:06d}.exr")
    head = (render.max(-1) > 0)[..., None]
    render = encode_srgb(render)
    shown = np.where(head, render, BACKGROUND * frame)
    error = np.where(head, 0.5 + 0.5 * (render - frame) / ERROR_RANGE, 0.5)
    albedo = encode_srgb(read_exr(subject / "export" / "maps" / "diffuse_albedo.exr"))
    panels = [_to_height(panel) for panel in (frame, shown, error, albedo)]
    return (np.concatenate(panels, axis=1) * 255.0 + 0.5).astype(np.uint8)


def _to_height(image: np.ndarray) -> np.ndarray:
    width = round(HEIGHT * image.shape[1] / image.shape[0])
    return np.clip(cv2.resize(image.astype(np.float32), (width, HEIGHT), interpolation=cv2.INTER_AREA), 0.0, 1.0)


def main() -> int:
    """Writes the picture; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", type=Path)
    parser.add_argument("out", type=Path, nargs="?", default=Path("docs/picture.jpg"))
    arguments = parser.parse_args()
    picture = compose(arguments.subject)
    cv2.imwrite(str(arguments.out), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
