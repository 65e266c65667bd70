"""Reads what the stages left behind for the report and for run.json: settings, costs, warnings, left-out frames."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from shared.geometry.transforms import WORLD_FROM_CAMERA, invert_rigid
from shared.io.arrays import read_json
from shared.io.frames import FrameSet
from shared.io.images import read_exr
from shared.report.content import Frame

SELECTION_SECONDS = "model_selection_seconds.json"
RESULT_FILES = {"sample_frames": "frames.json", "track_landmarks": "tracking.json", "inverse_render": "solve.json"}


def stage_record(manifest: Mapping, provenance: Mapping) -> dict:
    """{"version", "parameters", "wall_s", "cpu_s", "peak_memory_mb", "warnings"} of one finished stage."""
    costs = {name: provenance.get(name) for name in ("wall_s", "cpu_s", "peak_memory_mb")}
    warnings = list(provenance.get("warnings", []))
    return {"version": manifest["version"], "parameters": manifest["parameters"], "warnings": warnings, **costs}


def selection_record(folder: Path, solve: Mapping) -> list[dict]:
    """The candidates of inverse_render's model selection with the seconds that each took; empty where there was
    none."""
    candidates, seconds = solve.get("model_selection", ()), folder / SELECTION_SECONDS
    took = read_json(seconds) if seconds.is_file() else [None] * len(candidates)
    return [{**candidate, "seconds": value} for candidate, value in zip(candidates, took, strict=True)]


def own_record(version: int, parameters: Mapping, wall_s: float) -> dict:
    """The same for the stage that is running: its costs so far."""
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    costs = {"wall_s": round(wall_s, 3), "cpu_s": round(time.process_time(), 3), "peak_memory_mb": round(peak_mb, 1)}
    return {"version": version, "parameters": dict(parameters), "warnings": [], **costs}


def warnings_of(stage: str, folder: Path, record: Mapping) -> list[tuple[str, str]]:
    """(stage, text) of the stage's provenance and of its own result file, each text once."""
    texts = list(record["warnings"])
    if stage in RESULT_FILES:
        texts += read_json(folder / RESULT_FILES[stage]).get("warnings", [])
    return [(stage, text) for text in dict.fromkeys(texts)]


def excluded_frames(sample_folder: Path, track_folder: Path) -> list[tuple[int, str, str]]:
    """(frame, stage, reason) for every frame that was dropped or excluded, in the clip's order."""
    dropped = read_json(sample_folder / "frames.json").get("dropped", [])
    excluded = read_json(track_folder / "tracking.json").get("excluded", [])
    rows = [(int(row["frame_index"]), "sample_frames", str(row["reason"])) for row in dropped]
    rows += [(int(row["frame_index"]), "track_landmarks", str(row["reason"])) for row in excluded]
    return sorted(rows)


def motion(camera_from_head: np.ndarray, moves: str) -> tuple[np.ndarray, np.ndarray]:
    """[F, 4, 4] -> yaw, pitch, roll in degrees [F, 3] and position in mm [F, 3] of what moved.

    moves "head": the head as the camera sees it, y up. "camera": the camera around the head, its axes y up.
    Intrinsic rotations about y, x, z.
    """
    turn = np.diag([*np.diag(WORLD_FROM_CAMERA), 1.0])
    poses = turn @ camera_from_head
    if moves == "camera":
        poses = invert_rigid(camera_from_head) @ turn
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("YXZ", degrees=True)
    return np.degrees(np.unwrap(np.radians(angles), axis=0)), poses[:, :3, 3]


def chosen_frames(available: Sequence[int], held_out: Sequence[int], count: int) -> list[int]:
    """At most count of the available frames, evenly spread, with at least one held-out frame where there is one."""
    available = sorted(available)
    if len(available) <= count:
        return available
    picked = [available[round(i)] for i in np.linspace(0, len(available) - 1, count)]
    rest = [frame for frame in available if frame in set(held_out)]
    if rest and not set(picked) & set(rest):
        middle = rest[len(rest) // 2]
        picked[min(range(count), key=lambda i: abs(picked[i] - middle))] = middle
    return sorted(picked)


def compared_frames(
    frames: FrameSet,
    renders: Path,
    chosen: Sequence[int],
    held_out: Sequence[int],
    again: Mapping[int, np.ndarray] | None = None,
) -> Iterator[Frame]:
    """The chosen frames of the clip with their re-renders, one at a time: those in again {frame: [H, W, 3]}, else from
    the folder renders."""
    known = again or {}
    for frame_index in chosen:
        position = frames.position(frame_index)
        codes = frames.read_codes(position)
        found = known[frame_index] if frame_index in known else read_exr(renders / f"{frame_index:06d}.exr")
        yield Frame(
            frame_index=frame_index,
            time_s=float(frames.time_s[position]),
            clip=frames.read_linear(position),
            render=found,
            clipped=(codes >= np.iinfo(codes.dtype).max - (1 if codes.dtype == np.uint8 else 256)).any(-1),
            held_out=frame_index in set(held_out),
        )
