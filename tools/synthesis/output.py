"""Writes a synthetic subject to disk, in the layout that tools/score.py and the workflow read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from shared.errors import LimnError
from shared.geometry.mesh import Mesh
from shared.imaging.color import encode_srgb
from shared.io.arrays import save_arrays, write_json
from shared.io.images import write_exr, write_png
from shared.io.meshes import write_obj
from tools.synthesis.camera import PinholeCamera
from tools.synthesis.render import Scene

COVERAGES = ("mask", "head")
SMALL_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_FILTERED)
COLOURS = ("radiance", "albedo")


class ClipWriter:
    """The clip itself: FFV1 in AVI (lossless), or PNG files when the name holds a %d."""

    def __init__(self, path: Path, size: tuple[int, int], fps: float):
        self._path, self._count, self._video = path, 0, None
        path.parent.mkdir(parents=True, exist_ok=True)
        if "%" not in path.name:
            self._video = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), fps, size)
            if not self._video.isOpened():
                raise LimnError(f"{path}: this OpenCV cannot encode FFV1")

    def add(self, codes: np.ndarray) -> None:
        """Appends a frame, uint8 RGB [H, W, 3]."""
        if self._video is None:
            path = self._path.parent / (self._path.name % self._count)
            if not cv2.imwrite(str(path), np.ascontiguousarray(codes[..., ::-1]), SMALL_PNG):
                raise LimnError(f"{path}: could not be written")
        else:
            self._video.write(np.ascontiguousarray(codes[..., ::-1]))
        self._count += 1

    def close(self) -> None:
        """Ends the file."""
        if self._video is not None:
            self._video.release()


def sensor_codes(radiance: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """Linear radiance [H, W, 3] -> uint8 sRGB codes with shot noise of that standard deviation at full scale."""
    rng = np.random.default_rng([seed, 3])
    exposed = radiance + noise * np.sqrt(np.clip(radiance, 0.0, 1.0)) * rng.normal(size=radiance.shape)
    return np.uint8(np.round(255 * encode_srgb(np.clip(exposed, 0.0, 1.0))))


def write_buffers(stem: str, images: dict[str, np.ndarray], names: Iterable[str], mantissa_bits: int) -> None:
    """stem_NAME.exr (half) for radiance and buffers, stem_NAME.png for coverages and labels."""
    for name in names:
        if name == "label":
            write_png(f"{stem}_label.png", images[name])
        elif name in COVERAGES:
            write_png(f"{stem}_{name}.png", np.uint8(np.round(255 * images[name])))
        else:
            space = "lin_rec709_scene" if name in COLOURS else "data"
            image = rounded(images[name], mantissa_bits)
            write_exr(f"{stem}_{name}.exr", image, colour_space=space, half=True)


def rounded(values: np.ndarray, mantissa_bits: int) -> np.ndarray:
    """Floats with that many binary digits, so that they compress better; 10 is all that half floats have."""
    fraction, exponent = np.frexp(values)
    return np.ldexp(np.round(np.ldexp(fraction, mantissa_bits + 1)), exponent - mantissa_bits - 1)


def write_scene_truth(folder: Path, scene: Scene, mesh: Mesh, mantissa_bits: int) -> None:
    """gt/: mesh.obj (`mesh`: all of the scene's or part of it), the UV textures, labels where
    they are known, and the clip's environment."""
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    write_obj(folder / "mesh.obj", mesh)
    for name in ("albedo", "specular", "roughness", "mask"):
        space = "lin_rec709_scene" if name in COLOURS else "data"
        texture = rounded(getattr(scene.materials, name), mantissa_bits)
        write_exr(folder / f"{name}.exr", texture, colour_space=space, half=True)
    if scene.materials.label is not None:
        write_png(folder / "label.png", scene.materials.label)
    write_environment(folder / "envmap.exr", scene.lights[0])
    if scene.lamps_at is not None:
        write_lamp(folder / "lamp.json", scene)


def write_lamp(path: Path, scene: Scene) -> None:
    """lamp.json: where the main lamp of the clip's near lamps stands, mm, world space (origin: the camera)."""
    sphere, direction = scene.lamps_at, scene.environments()[0].main_lamp()
    write_json(path, {
        "distance_mm": sphere.distance_mm,
        "reference_mm": sphere.centre.tolist(),
        "direction": direction.tolist(),
        "position_mm": (sphere.centre + sphere.distance_mm * direction).tolist()})


def write_environment(path: Path, image: np.ndarray) -> None:
    """Lat-long radiance, linear."""
    write_exr(path, image, colour_space="lin_rec709_scene", half=True, latlong=True)


def write_description(folder: Path, camera: PinholeCamera, focal_mm: float, sensor_mm: float, frames: int, fps: float,
                      video: str) -> None:
    """subject.yaml and capture.json: what is known about the clip without its truth."""
    (folder / "subject.yaml").write_text(
        f"video: {video}\n"
        f"camera: {{focal_length_mm: {focal_mm:g}, sensor_width_mm: {sensor_mm:g}}}\n"
        "colour: {transfer: srgb}\n"
        "capture: {moves: head}\n", encoding="utf-8")
    write_json(folder / "capture.json", {
        "name": folder.name, "width": camera.width, "height": camera.height, "fps": fps, "frames": frames,
        "focal_length_mm": focal_mm, "sensor_width_mm": sensor_mm, "focal_length_px": camera.focal_px,
        "principal_point_px": [camera.width / 2, camera.height / 2],
        "color_space": "sRGB, 8 bit; linear radiance 1 = code 255; no tone mapping", "lens_distortion": "none"})


def write_poses(path: Path, poses: np.ndarray, camera: PinholeCamera, truth_frames: np.ndarray,
                eyes: Mapping[str, np.ndarray] | None = None) -> None:
    """gt/poses.npz: camera_from_head [F, 4, 4], K [3, 3], the frames that have buffers, and where the head has living
    eyes what is true of them."""
    save_arrays(path, camera_from_head=poses, K=camera.intrinsics, gt_frames=np.asarray(truth_frames, np.int64),
                **(eyes or {}))
