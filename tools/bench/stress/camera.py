"""What a camera makes of linear pictures: exposure, blur, noise, its transfer function, compression.

Order as in a camera: the lens blurs, the shutter smears, light is counted, the amplifier scales, the codec rounds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from shared.geometry.transforms import project, rotation_from_vector
from shared.imaging.color import encode_srgb

DRIFT_CYCLES = (1.0, 2.3)
"""Slow waves over the clip that automatic exposure and white balance follow."""
BANDS = 2.0
"""Bands that a lamp on mains leaves in a picture under a rolling shutter."""

FLICKER_CYCLES = 0.37
"""A frame: a lamp on mains beside the shutter's rate."""
LOG_GAIN = 200.0
"""Of the logarithmic curve log(1 + gain x): the dark half of the codes shows a hundredth of the light, as footage that
is meant to be graded does."""


@dataclass(frozen=True)
class Sensor:
    """exposure: gain on the light. shot_noise: standard deviation at full scale; read_noise: of black.

    defocus_px: radius of the lens's disc. motion_px: length of the smear where the head turns fastest.
    exposure_drift, white_drift, bands: amplitude of the gain's logarithm over time, between red and blue, over rows.
    flicker: amplitude of the gain's logarithm from one frame to the next.
    gamma: exponent between the light and what the stated transfer function reads. log_curve: share of a logarithmic
    curve in the codes. jpeg: quality, 0: none.
    """

    exposure: float = 1.0
    shot_noise: float = 0.006
    read_noise: float = 0.001
    defocus_px: float = 0.0
    motion_px: float = 0.0
    exposure_drift: float = 0.0
    white_drift: float = 0.0
    bands: float = 0.0
    flicker: float = 0.0
    gamma: float = 1.0
    log_curve: float = 0.0
    jpeg: int = 0


def photograph(pictures: np.ndarray, motion_px: np.ndarray, sensor: Sensor, seed: int = 0) -> Iterator[np.ndarray]:
    """Linear radiance [F, H, W, 3] -> uint8 codes [H, W, 3] of each frame.

    motion_px [F, 2]: which way and how far the head moves in a frame, in the picture.
    """
    fastest = max(float(np.linalg.norm(motion_px, axis=1).max()), 1e-9)
    for number, radiance in enumerate(pictures):
        rng = np.random.default_rng([seed, number, 9])
        light = sensor.exposure * radiance.astype(np.float32)
        light = smeared(defocused(light, sensor.defocus_px), motion_px[number] * (sensor.motion_px / fastest))
        light = light * drift(sensor, number, len(pictures), len(light))
        noise = np.sqrt(sensor.shot_noise**2 * np.clip(light, 0.0, 1.0) + sensor.read_noise**2)
        counted = np.clip(light + noise * rng.normal(size=light.shape), 0.0, 1.0)
        yield compressed(np.uint8(np.round(255 * encoded(counted, sensor))), sensor.jpeg)


def encoded(light: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Light 0 to 1 -> codes 0 to 1."""
    codes = encode_srgb(light**sensor.gamma)
    if not sensor.log_curve:
        return codes
    return (1.0 - sensor.log_curve) * codes + sensor.log_curve * np.log1p(LOG_GAIN * light) / np.log1p(LOG_GAIN)


def drift(sensor: Sensor, number: int, count: int, rows: int) -> np.ndarray:
    """[rows, 1, 3] gain of a frame."""
    wave = np.sin(2 * np.pi * np.outer(DRIFT_CYCLES, number / count) + [[0.4], [1.9]]).ravel()
    log_gain = np.zeros((rows, 1, 3)) + sensor.exposure_drift * wave[0]
    log_gain += sensor.flicker * np.sin(2 * np.pi * FLICKER_CYCLES * number)
    log_gain += sensor.white_drift * wave[1] * np.array([1.0, 0.0, -1.0])
    phase = BANDS * np.arange(rows) / rows + 0.17 * number
    return np.exp(log_gain + (sensor.bands * np.sin(2 * np.pi * phase))[:, None, None]).astype(np.float32)


def defocused(light: np.ndarray, radius: float) -> np.ndarray:
    """Under a disc of that radius, px."""
    if radius <= 0:
        return light
    reach = int(np.ceil(radius)) + 1
    y, x = np.mgrid[-reach:reach + 1, -reach:reach + 1]
    disc = np.clip(radius + 0.5 - np.hypot(x, y), 0.0, 1.0)
    return cv2.filter2D(light, -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)


def smeared(light: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Along a motion [2], px, at even speed."""
    length = float(np.linalg.norm(motion))
    if length < 0.1:
        return light
    reach = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for part in (np.arange(64) + 0.5) / 64 - 0.5:
        x, y = reach + part * motion
        column, row = int(x), int(y)
        right, down = x - column, y - row
        kernel[row:row + 2, column:column + 2] += np.outer([1 - down, down], [1 - right, right])
    return cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def compressed(codes: np.ndarray, quality: int) -> np.ndarray:
    """Through a JPEG with halved colour resolution; quality 0: as it is."""
    if not quality:
        return codes
    options = (cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
               cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420)
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(codes[..., ::-1]), options)
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def shaken(
    pictures: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray, shake_px: float, still: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pictures [F, H, W, 3] and poses [F, 4, 4] from a camera held by hand that turns by some shake_px.

    The turn differs from frame to frame; frames whose index is in `still` keep their place.
    """
    count, focal = len(pictures), intrinsics[0, 0]
    turn = np.random.default_rng(7).normal(size=(count, 2)) * shake_px / focal
    turn[still] = 0.0
    rotation = rotation_from_vector(np.column_stack([turn, np.zeros(count)]))
    warp = intrinsics @ rotation @ np.linalg.inv(intrinsics)
    half = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]])  # OpenCV's pixel centres are whole numbers
    size = pictures.shape[2], pictures.shape[1]
    moved = [cv2.warpPerspective(picture, np.linalg.inv(half) @ way @ half, size, flags=cv2.INTER_CUBIC,
                                 borderMode=cv2.BORDER_REPLICATE) for picture, way in zip(pictures, warp, strict=True)]
    turned = np.array(poses)
    turned[:, :3] = rotation @ poses[:, :3]
    return np.maximum(np.stack(moved), 0.0), turned


def image_motion(camera_from_head: np.ndarray, intrinsics: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[F, 2] px per frame: mean over head-space points [N, 3] of what moves in the picture."""
    places = np.stack([project(points, pose, intrinsics)[0].mean(0) for pose in camera_from_head])
    return np.gradient(places, axis=0)
