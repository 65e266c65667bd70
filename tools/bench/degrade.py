"""Spoilt copies of a subject with known truth: what a bad clip, a bad landmark network or a wrong lens would give.

Each copy is a subject of its own, with the truth of the original. Pixels are degraded in code values, as a camera or a
codec would; landmarks go in as a file of another tracker.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml

from shared.contract.subject import load_subject
from shared.io.arrays import load_arrays, save_arrays
from shared.io.images import write_png
from shared.io.video import open_video

Degradation = Callable[[np.ndarray, int, int], np.ndarray]
"""Frame's code values [H, W, 3] uint8, its number and how many there are -> the degraded frame."""


def flicker(codes: np.ndarray, index: int, count: int) -> np.ndarray:
    """Brightness up and down by 20 % from frame to frame."""
    return _scaled(codes, 1.0 + 0.2 * np.sin(2.4 * index))


def motion_blur(codes: np.ndarray, index: int, count: int) -> np.ndarray:
    """Two pixels along the rows."""
    return cv2.filter2D(codes, -1, np.array([[0.25, 0.5, 0.25]]))


def rolling_exposure(codes: np.ndarray, index: int, count: int) -> np.ndarray:
    """Bands that wander down the picture, as a lamp on mains gives with a rolling shutter."""
    rows = np.arange(codes.shape[0])[:, None, None]
    return _scaled(codes, 1.0 + 0.12 * np.sin(2 * np.pi * (rows / codes.shape[0] * 2.0 + 0.17 * index)))


def _scaled(codes: np.ndarray, gain: float | np.ndarray) -> np.ndarray:
    """Scene brightness times gain; the codes are sRGB, close to a power of 2.2."""
    return np.clip(codes * np.power(gain, 1 / 2.2) + 0.5, 0, 255).astype(np.uint8)


PIXELS: dict[str, Degradation] = {"flicker": flicker, "motion_blur": motion_blur, "rolling_exposure": rolling_exposure}


def unchanged(codes: np.ndarray, index: int, count: int) -> np.ndarray:
    """The frame as it is, for copies that differ in the order of their frames only."""
    return codes


def landmark_bias(points: np.ndarray, yaw: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Three pixels to the side that the head turns to, at its widest turn."""
    return points + (3.0 * yaw / np.abs(yaw).max())[:, None, None] * [1.0, 0.0]


def landmark_outliers(points: np.ndarray, yaw: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A fifth of all landmarks lies anywhere within a quarter of the face's width."""
    wrong = rng.random(points.shape[:2]) < 0.2
    reach = 0.25 * np.ptp(points[..., 0], axis=1).mean()
    return points + wrong[..., None] * rng.uniform(-reach, reach, points.shape)


def landmark_gaps(points: np.ndarray, yaw: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Five stretches without any; NaN frames are left out of the file."""
    points = np.array(points)
    for start in np.linspace(0.08, 0.88, 5) * len(points):
        points[int(start) : int(start) + max(1, len(points) // 24)] = np.nan
    return points


LANDMARKS = {"landmark_bias": landmark_bias, "landmark_outliers": landmark_outliers, "landmark_gaps": landmark_gaps}


def degrade_pixels(subject: Path, destination: Path, degrade: Degradation, order: slice = slice(None)) -> None:
    """A copy with degraded frames, or with some frames only (order), as an image sequence with its own truth."""
    source = load_subject(subject)
    frames = [frame.codes() for frame in open_video(source.video).frames()]
    chosen = range(len(frames))[order]
    (destination / "frames").mkdir(parents=True)
    for number, index in enumerate(chosen):
        codes = frames[index] if frames[index].dtype == np.uint8 else (frames[index] >> 8).astype(np.uint8)
        write_png(destination / "frames" / f"{number:04d}.png", degrade(codes, number, len(chosen)))
    _describe(subject, destination, {"video": "frames/%04d.png"}, np.array(chosen))


def degrade_landmarks(subject: Path, tracked: Path, destination: Path, degrade, seed: int = 0) -> None:
    """A copy that brings degraded landmarks; tracked: folder of track_landmarks with the subject's own."""
    from shared.io.frames import FrameSet

    landmarks = load_arrays(tracked / "landmarks.npz")
    frames = FrameSet.open(tracked.parent / "sample_frames")
    points = landmarks["landmarks_px"] / frames.crop[2] + frames.crop[:2]
    poses = load_arrays(tracked / "poses.npz")["camera_from_head"]
    degraded = degrade(points, np.arctan2(poses[:, 2, 0], poses[:, 0, 0]), np.random.default_rng(seed))
    kept = np.isfinite(degraded).all((1, 2))
    destination.mkdir(parents=True)
    save_arrays(
        destination / "landmarks.npz", landmarks_px=degraded[kept], frame_index=landmarks["frame_index"][kept]
    )
    _describe(subject, destination, {"tracking": {"landmarks": "landmarks.npz"}}, None)


def degrade_focal(subject: Path, destination: Path, gain: float) -> None:
    """A copy that states a wrong focal length."""
    destination.mkdir(parents=True)
    camera = yaml.safe_load((subject / "subject.yaml").read_text(encoding="utf-8"))["camera"]
    camera = {key: value * gain if key.startswith("focal") else value for key, value in camera.items()}
    _describe(subject, destination, {"camera": camera}, None)


def _describe(subject: Path, destination: Path, changes: dict, chosen: np.ndarray | None) -> None:
    """subject.yaml with changes, the clip, links to the truth; chosen: frames of the original that are left."""
    content = yaml.safe_load((subject / "subject.yaml").read_text(encoding="utf-8"))
    if chosen is None:
        head = Path(content["video"]).parts[0]
        take = shutil.copytree if (subject / head).is_dir() else shutil.copyfile
        take(subject / head, destination / head)
        (destination / "gt").symlink_to((subject / "gt").resolve())
    elif (subject / "gt").exists():
        (destination / "gt").mkdir()
        for file in (subject / "gt").iterdir():
            if file.name != "poses.npz":
                (destination / "gt" / file.name).symlink_to(file.resolve())
        truth = load_arrays(subject / "gt" / "poses.npz")
        truth["camera_from_head"] = truth["camera_from_head"][chosen]
        save_arrays(destination / "gt" / "poses.npz", **truth)
    if (subject / "capture.json").exists():
        (destination / "capture.json").symlink_to((subject / "capture.json").resolve())
    (destination / "subject.yaml").write_text(yaml.safe_dump({**content, **changes}), encoding="utf-8")
