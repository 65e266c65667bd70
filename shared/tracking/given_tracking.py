"""Landmarks and poses of another tracker, as files: read and checked.

landmarks.npz: landmarks_px [n, 468, 2] in pixels of the source frame (centres at + 0.5, in the order of MediaPipe's
face mesh), frame_index [n] (frames of the clip, from 0).
poses.npz: camera_from_head [n, 4, 4] (OpenCV camera, any unit of length), frame_index [n].
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shared.capture.landmarks import LANDMARK_COUNT
from shared.errors import InputError
from shared.io.arrays import load_arrays

LARGEST_SKEW = 1e-3
LEAST_FRAMES = 3
LARGEST_BYTES = 1 << 28
FARTHEST_PX, FARTHEST, NARROWEST_PX = 1e5, 1e7, 8.0


def read_given_landmarks(path: Path, frame_index: np.ndarray, crop: tuple[float, float, float]):
    """-> landmarks [F, 468, 2] px of the crop (x0, y0, scale), 0 where the file has none, and which it has [F] bool."""
    arrays = _read(path, "landmarks_px", (LANDMARK_COUNT, 2))
    place, row = _match(path, arrays["frame_index"], frame_index)
    if np.abs(arrays["landmarks_px"]).max() > FARTHEST_PX:
        raise InputError("landmarks far outside any picture", where=str(path), expected="px of the source frame")
    if np.median(np.ptp(arrays["landmarks_px"][..., 0], axis=1)) < NARROWEST_PX:
        raise InputError("the landmarks span no face", where=str(path), expected="px of the source frame, no shares")
    points = np.zeros((len(frame_index), LANDMARK_COUNT, 2))
    points[place] = (arrays["landmarks_px"][row] - crop[:2]) * crop[2]
    return points, _marked(place, len(frame_index))


def read_given_poses(path: Path, frame_index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> poses [F, 4, 4], identity where the file has none, and which it has [F] bool."""
    arrays = _read(path, "camera_from_head", (4, 4))
    poses = arrays["camera_from_head"]
    rotations = poses[:, :3, :3]
    sane = np.abs(rotations).max() < 2 and np.abs(poses[:, 3] - [0, 0, 0, 1]).max() == 0
    if not sane or _skew(rotations) > LARGEST_SKEW or np.linalg.det(rotations).min() < 0:
        raise InputError("the poses are not rigid", where=str(path), expected="rotations with last row 0 0 0 1")
    if poses[:, 2, 3].min() <= 0:
        raise InputError("the head is behind the camera", where=str(path), expected="OpenCV axes, z forward")
    if np.abs(poses[:, :3, 3]).max() > FARTHEST or poses[:, 2, 3].min() < 1 / FARTHEST:
        raise InputError("the head is nowhere near the camera", where=str(path), expected=f"1e-7 .. {FARTHEST:g} units")
    place, row = _match(path, arrays["frame_index"], frame_index)
    found = np.repeat(np.eye(4)[None], len(frame_index), axis=0)
    found[place] = poses[row]
    return found, _marked(place, len(frame_index))


def _read(path: Path, name: str, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    arrays = load_arrays(path, LARGEST_BYTES)
    for key in (name, "frame_index"):
        if key not in arrays:
            raise InputError(f"no {key} in the file", where=str(path), got=", ".join(sorted(arrays)))
    values, frames = np.asarray(arrays[name]), np.asarray(arrays["frame_index"])
    if values.shape != (frames.size, *shape) or frames.ndim != 1:
        expected = f"[n, {', '.join(map(str, shape))}] and frame_index [n]"
        raise InputError(f"{name} has another shape", where=str(path), got=list(values.shape), expected=expected)
    if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise InputError(f"{name} is not finite everywhere", where=str(path), hint="leave frames out that have none")
    if frames.dtype.kind not in "iu":
        raise InputError("frame_index holds no whole numbers", where=str(path), got=str(frames.dtype))
    if len(frames) < LEAST_FRAMES:
        raise InputError("too few of the clip's frames in it", where=str(path), got=len(frames), expected="3 or more")
    return {name: values.astype(np.float64), "frame_index": frames.astype(np.int64)}


def _skew(rotations: np.ndarray) -> float:
    """How far the matrices [n, 3, 3] are from orthonormal."""
    return float(np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max())


def _match(path: Path, given: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places in `wanted` and rows of `given` of the frames that both have."""
    if len(np.unique(given)) != len(given):
        raise InputError("a frame is named twice in frame_index", where=str(path))
    row_of = {int(frame): row for row, frame in enumerate(given)}
    place = np.array([i for i, frame in enumerate(wanted) if int(frame) in row_of], int)
    if len(place) < LEAST_FRAMES:
        raise InputError("too few of the clip's frames in it", where=str(path), got=len(place), expected="3 or more")
    return place, np.array([row_of[int(wanted[i])] for i in place])


def _marked(place: np.ndarray, count: int) -> np.ndarray:
    marked = np.zeros(count, bool)
    marked[place] = True
    return marked
