"""Eyes close up: held-out frames of a clip, and below each what one run after another re-renders of it.

    python -m tools.documents.eyes OUT.jpg RUN [RUN ...]     RUN: a finished run's folder, which holds work/
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from shared.geometry.eyeballs import eyeballs_of
from shared.geometry.surface import Surface
from shared.io.arrays import load_arrays, read_json
from shared.io.meshes import load_mesh
from shared.report.eye_pictures import close_up, close_up_frames, eye_rectangle
from tools.bench.rerender import SolvedClip

GAP_PX = 6


def compose(runs: Sequence[Path]) -> np.ndarray:
    """[H, W, 3] uint8 RGB: a column of each of up to three frames, the clip's own picture on top."""
    solved = runs[0] / "work" / "inverse_render"
    poses, record = load_arrays(solved / "poses.npz"), read_json(runs[0] / "work" / "track_landmarks" / "tracking.json")
    surface = Surface(load_mesh(solved / "mesh.npz"), load_arrays(solved / "mesh.npz")["face_segment"],
                      tuple(record["segments"]))
    clips = [{frame.frame: frame for frame in SolvedClip(run).compared()} for run in runs]
    place = {int(frame): f for f, frame in enumerate(poses["frame_index"])}
    chosen = close_up_frames(sorted(clips[0]), poses["frame_index"], poses["camera_from_head"], poses["gaze"])
    columns = []
    for frame in chosen:
        picture = clips[0][frame].picture
        pose, size = poses["camera_from_head"][place[frame]], picture.shape[1::-1]
        rectangle = eye_rectangle(eyeballs_of(surface), pose, poses["intrinsics_crop"], size)
        rows = [close_up(shown, rectangle) for shown in (picture, *(clip[frame].render for clip in clips))]
        columns.append(np.concatenate([np.pad(row, ((0, GAP_PX), (0, GAP_PX), (0, 0)), constant_values=255) for row in
                                       rows]))  # fmt: skip
    height = max(len(column) for column in columns)
    return np.concatenate([np.pad(column, ((0, height - len(column)), (0, 0), (0, 0)), constant_values=255) for column
                           in columns], axis=1)  # fmt: skip


def main() -> int:
    """Writes the picture; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    arguments = parser.parse_args()
    cv2.imwrite(str(arguments.out), compose(arguments.runs)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
