"""Makes the subject of a stress case on disk: clip, subject.yaml, what else comes with it, and its truth."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from shared.geometry.transforms import project, rotation_from_vector
from shared.io.arrays import load_arrays, save_arrays
from shared.io.images import read_exr, read_png, write_exr, write_png
from shared.io.meshes import read_obj, write_obj
from tools.bench.stress.camera import image_motion, photograph, shaken
from tools.bench.stress.perturbations import StressCase
from tools.bench.stress.scenes import SETTINGS, camera, render_scene
from tools.synthesis import output
from tools.synthesis.head import smooth_random
from tools.synthesis.subject import FPS, SENSOR_MM

VIDEO = "frames/%04d.png"
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
"""Left and right exchanged, in head space as in the camera's axes."""


def make_subject(case: StressCase, folder: Path, scenes: Path) -> Path:
    """Writes the case's subject into folder, unless it is there; scenes: where rendered scenes are kept."""
    if (folder / "subject.yaml").exists():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "frames").mkdir(parents=True)
    (folder / "gt" / "frames").mkdir(parents=True)
    parts = [(render_scene(scene, scenes), gain) for scene, gain in case.mix if gain]
    first = parts[0][0]
    truth = load_arrays(first / "gt" / "poses.npz")
    poses, points = truth["camera_from_head"], load_arrays(first / "landmarks.npz")["points_head"]
    kept = _kept(truth["gt_frames"], len(poses), case.keep)
    pictures = sum(gain * np.load(path / "radiance.npy", mmap_mode="r")[kept].astype(np.float32)
                   for path, gain in parts)
    known = np.nonzero(np.isin(kept, truth["gt_frames"]))[0]
    if case.shake_px:
        pictures, poses[kept] = shaken(pictures, poses[kept], camera().intrinsics, case.shake_px, known)
    motion = image_motion(poses, camera().intrinsics, points)[kept]
    for number, codes in enumerate(photograph(pictures, motion, case.sensor)):
        write_png(folder / (VIDEO % number), codes[:, ::-1] if case.mirrored else codes)
    _write_truth(folder / "gt", parts, kept, poses)
    if case.mirrored:
        mirror_truth(folder / "gt")
    tracking = _given_tracking(case, folder, poses[kept], points)
    output.write_description(folder, camera(), SETTINGS.focal_mm, SENSOR_MM, len(kept), FPS, VIDEO)
    description = yaml.safe_load((folder / "subject.yaml").read_text(encoding="utf-8"))
    description["camera"]["focal_length_mm"] *= case.focal_gain
    changed = yaml.safe_dump({**description, **({"tracking": tracking} if tracking else {})})
    (folder / "subject.yaml").write_text(changed, encoding="utf-8")
    return folder


def _kept(truth: np.ndarray, count: int, keep: int) -> np.ndarray:
    """Indices of the frames that are left: all, or so many, first of all those with truth, evenly spread."""
    if not keep:
        return np.arange(count)
    if keep <= len(truth):
        return truth[((np.arange(keep) + 0.5) * len(truth) / keep).astype(int)]
    others = np.setdiff1d(np.arange(count), truth)
    more = others[np.linspace(0, len(others) - 1, keep - len(truth)).round().astype(int)]
    return np.union1d(truth, more)


def _write_truth(folder: Path, parts: list[tuple[Path, float]], kept: np.ndarray, poses: np.ndarray) -> None:
    """gt/: the first scene's, of the frames that are left, with all frames' poses, and the light that stands still."""
    source = parts[0][0] / "gt"
    truth = load_arrays(source / "poses.npz")
    for file in source.iterdir():
        if file.suffix in (".obj", ".exr") and file.name != "envmap.exr":
            (folder / file.name).symlink_to(file.resolve())
    numbers = {int(frame): number for number, frame in enumerate(kept)}
    known = [frame for frame in truth["gt_frames"].tolist() if frame in numbers]
    for frame in known:
        for file in (source / "frames").glob(f"{frame:04d}_*"):
            (folder / "frames" / f"{numbers[frame]:04d}_{file.name[5:]}").symlink_to(file.resolve())
    eyes = {name: truth[name][kept] if name in ("gaze", "aperture") else truth[name] for name in truth
            if name not in ("camera_from_head", "K", "gt_frames")}
    save_arrays(folder / "poses.npz", camera_from_head=poses[kept], K=truth["K"],
                gt_frames=np.array([numbers[frame] for frame in known], np.int64), **eyes)
    still = [(path, gain) for path, gain in parts if not path.name.startswith("cap")]
    light = sum(gain * read_exr(path / "gt" / "envmap.exr") for path, gain in still)
    output.write_environment(folder / "envmap.exr", light)


def mirror_truth(folder: Path) -> None:
    """Makes the truth in gt/ that of the mirrored head in mirrored light, before a camera whose principal point is in
    the middle."""
    mesh = read_obj(folder / "mesh.obj")
    _replace(folder / "mesh.obj", write_obj, mesh.replace(
        vertices=mesh.vertices * MIRROR.diagonal()[:3], faces=mesh.faces[:, ::-1], face_uvs=mesh.face_uvs[:, ::-1]))
    poses = load_arrays(folder / "poses.npz")
    save_arrays(folder / "poses.npz", **{**poses, "camera_from_head": MIRROR @ poses["camera_from_head"] @ MIRROR})
    output.write_environment(folder / "envmap.exr", read_exr(folder / "envmap.exr")[:, ::-1])
    for file in sorted((folder / "frames").iterdir()):
        if file.suffix == ".png":
            _replace(file, write_png, read_png(file)[:, ::-1])
            continue
        image = read_exr(file)[:, ::-1]
        if file.stem.endswith("_normal"):
            image = image * np.float32([-1.0, 1.0, 1.0])
        _replace(file, lambda path, content: write_exr(path, content, colour_space="data", half=False), image)


def _replace(file: Path, write: Callable[[Path, Any], None], content: Any) -> None:
    """In place of a link into the scene, which other subjects share."""
    file.unlink()
    write(file, content)


def _given_tracking(case: StressCase, folder: Path, poses: np.ndarray, points: np.ndarray) -> dict:
    """Poses or landmarks of "another tracker" with their errors -> `tracking` of subject.yaml."""
    index = np.arange(len(poses))
    if case.pose_error_deg:
        save_arrays(folder / "poses.npz", camera_from_head=wrong_poses(poses, case.pose_error_deg), frame_index=index)
        return {"poses": "poses.npz", "hold_poses": True}
    if case.landmark_slide is not None:
        landmarks = sliding_landmarks(poses, points, case.landmark_slide)
        save_arrays(folder / "landmarks.npz", landmarks_px=landmarks, frame_index=index)
        return {"landmarks": "landmarks.npz"}
    return {}


def wrong_poses(poses: np.ndarray, error_deg: float) -> np.ndarray:
    """[F, 4, 4] turned about the head's origin by a slowly varying error of that root mean square."""
    rng, time = np.random.default_rng(11), (np.arange(len(poses)) + 0.5) / len(poses)
    errors = np.stack([smooth_random(time, rng) for _ in range(3)], 1)
    errors *= np.radians(error_deg) / np.sqrt((errors**2).sum(1).mean())
    wrong = np.array(poses)
    wrong[:, :3, :3] = poses[:, :3, :3] @ rotation_from_vector(errors)
    return wrong


def sliding_landmarks(poses: np.ndarray, points: np.ndarray, slide: float) -> np.ndarray:
    """[F, 468, 2] px of points [468, 3], off sideways in step with the turn: at its widest by a share of the width."""
    places = np.stack([project(points, pose, camera().intrinsics)[0] for pose in poses])
    yaw = np.arctan2(poses[:, 2, 0], poses[:, 0, 0])
    width = np.ptp(places[..., 0], axis=1).mean()
    return places + (slide * width * yaw / np.abs(yaw).max())[:, None, None] * [1.0, 0.0]
