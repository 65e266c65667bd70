"""How far a result's gaze and irises are from the truth, which blinks it found, and how well it draws the eyes anew.

Gaze is that of shared.geometry.eyeballs: [F, 2, 2] radians, right eye then left, NaN while shut.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from shared.geometry.eyeballs import IRIS_MM, SIDES, gaze_direction, gaze_towards
from shared.geometry.raycast import pixel_directions
from shared.geometry.transforms import project
from shared.io.arrays import load_arrays
from tools.scoring.measures import summary

REGION = (1.1, 0.75)
"""Half width and half height of the region of an eye, lids and all, in radii of its eyeball."""
DEEP = 2.0
"""Before its centre, in radii: what is farther away is no surface, but a mean of the head's depth and nothing at its
outline."""


def found_gaze(export: Path) -> dict[int, np.ndarray]:
    """{frame: gaze [2, 2]} of a result: of export/poses.npz, or of track_landmarks where that folder lies beside the
    export and the export has none; empty where neither has."""
    for path in (export / "poses.npz", export.parent / "work" / "track_landmarks" / "poses.npz"):
        arrays = load_arrays(path) if path.exists() else {}
        if "gaze" in arrays:
            index = arrays.get("frame_index", np.arange(len(arrays["gaze"])))
            return dict(zip(index.tolist(), arrays["gaze"], strict=True))
    return {}


def gaze_errors(truth: np.ndarray, found: Mapping[int, np.ndarray], truth_from_result: np.ndarray) -> dict:
    """Angles in degrees between true gaze [F, 2, 2] and that found, where both eyes' lids are open in both: `deg` of
    all, and of `right` and `left`; `deg_centred` after one constant offset in yaw and pitch of each eye. `shut`: of
    blinks, how many eyes are shut in the frames compared, which share of them was found (`recall`; left out where none
    is shut), and which share of open ones was said to be shut (`false`). Angles are left out where no eye is open.

    truth_from_result [3, 3] turns the result's head space into the truth's.
    """
    frames = [frame for frame in sorted(found) if frame < len(truth)]
    true, seen = truth[frames], np.array([found[frame] for frame in frames]).reshape(-1, 2, 2)
    seen = gaze_towards(gaze_direction(seen) @ truth_from_result.T)
    shut, said = np.isnan(true).any(-1), np.isnan(seen).any(-1)
    scores: dict = {"frames": len(frames), "shut": {"eyes": int(shut.sum())}}
    if shut.any():
        scores["shut"]["recall"] = float(said[shut].mean())
    if not shut.all():
        scores["shut"]["false"] = float(said[~shut].mean())
    both = ~shut & ~said
    if not both.any():
        return scores
    centred = seen.copy()
    for eye, name in enumerate(SIDES):
        own = both[:, eye]
        if own.any():
            centred[own, eye] -= (seen[own, eye] - true[own, eye]).mean(0)
            scores[name] = summary(_apart_deg(true[own, eye], seen[own, eye]))
    return scores | {"deg": summary(_apart_deg(true[both], seen[both])),
                     "deg_centred": summary(_apart_deg(true[both], centred[both]))}


def iris_errors_px(truth: Mapping[str, np.ndarray], tracked: Path) -> dict | None:
    """Distances in px of the clip between the true irises' centres and those that track_landmarks, in folder tracked,
    found, of open eyes with a gaze; None where it found none. truth: gt/poses.npz of living eyes."""
    if not (tracked / "landmarks.npz").exists():
        return None
    marks, poses = load_arrays(tracked / "landmarks.npz"), load_arrays(tracked / "poses.npz")
    if not ("iris_px" in marks and "gaze" in poses):
        return None
    frames, place, own = np.intersect1d(marks["frame_index"], poses["frame_index"], return_indices=True)
    crop, lens = poses["intrinsics_crop"], poses["intrinsics"]
    found = (marks["iris_px"][place, :, 0] - crop[:2, 2]) / crop[[0, 1], [0, 1]]
    found = np.where(np.isfinite(poses["gaze"][own]), found * lens[[0, 1], [0, 1]] + lens[:2, 2], np.nan)
    ahead = np.sqrt(float(truth["eyeball_radius"]) ** 2 - IRIS_MM**2)
    irises = truth["eyeball_centres"] + ahead * gaze_direction(truth["gaze"][frames])
    seen_from = zip(irises, truth["camera_from_head"][frames], strict=True)
    true = np.array([project(both, pose, truth["K"])[0] for both, pose in seen_from])
    apart = np.linalg.norm(found - true, axis=-1)
    return summary(apart[np.isfinite(apart)]) if np.isfinite(apart).any() else None


def _apart_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[N, 2] pairs -> [N] degrees, accurate for small angles."""
    chord = np.linalg.norm(gaze_direction(first) - gaze_direction(second), axis=-1)
    return np.degrees(2.0 * np.arcsin(np.clip(0.5 * chord, 0.0, 1.0)))


def seen_places(depth: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """[H, W, 3] mm in head space: what each pixel of depth [H, W] mm shows; camera_from_head [4, 4], intrinsics [3, 3].
    """
    height, width = depth.shape
    place = pixel_directions(intrinsics, width, height) * depth[..., None]
    return (place - camera_from_head[:3, 3]) @ camera_from_head[:3, :3]


def eye_pixels(depth: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray, centres: np.ndarray,
               radius: float) -> np.ndarray:
    """[H, W] bool: pixels that show an eye with its lids; depth [H, W] mm of the true surface, 0 beside it;
    camera_from_head [4, 4], intrinsics [3, 3]; centres [2, 3] and radius of the eyeballs, mm."""
    arm = seen_places(depth, camera_from_head, intrinsics)[..., None, :] - centres
    off = (arm[..., :2] / (radius * np.array(REGION))) ** 2
    before = (arm[..., 2] > 0) & (arm[..., 2] < DEEP * radius)
    return (depth > 0) & ((off.sum(-1) < 1.0) & before).any(-1)
