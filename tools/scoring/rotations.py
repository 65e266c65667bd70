"""How far a run's rotations are from the truth, and whether their covariance says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shared.io.arrays import load_arrays
from shared.tracking.pose_uncertainty import rotations_apart
from tools.scoring.measures import rotation_acceleration_deg, rotation_coverage


def final_poses(tracked: Path, solved: Path) -> dict[str, np.ndarray]:
    """What the poses.npz of inverse_render holds, solved, with the covariance of track_landmarks, tracked, where it has
    none of its own: where the poses were not tracked again. tracked, solved: the stages' folders."""
    before, after = (load_arrays(folder / "poses.npz") for folder in (tracked, solved))
    if "covariance" in after:
        return after
    place = {frame: k for k, frame in enumerate(before["frame_index"].tolist())}
    return after | {"covariance": before["covariance"][[place[frame] for frame in after["frame_index"].tolist()]]}


def rotation_errors(found: dict[str, np.ndarray], true: np.ndarray) -> dict[str, float]:
    """found: what a poses.npz holds, covariance and all; true [N, 4, 4]: the pose of every frame of the clip. Compared
    after one common turn of the head; measures.py says what `covered` and `acceleration_deg` are."""
    index = found["frame_index"]
    apart = rotations_apart(found["camera_from_head"][:, :3, :3], true[index, :3, :3])
    angle = np.degrees(np.linalg.norm(apart, axis=1))
    return {
        "rotation_mean_deg": float(angle.mean()),
        "rotation_max_deg": float(angle.max()),
        "covered": rotation_coverage(apart, found["covariance"][:, :3, :3]),
        "acceleration_deg": rotation_acceleration_deg(apart, index),
    }
