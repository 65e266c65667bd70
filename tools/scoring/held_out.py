"""Measures of a result that has no truth but its own clip: re-renders against frames that it was not fitted to.

Pictures are scene-linear Rec.709, 1 is the clip's white. Errors are summed over the pixels of a region in all frames,
so that a frame counts by how much of the region it shows.

References: [Wang2004] (structural similarity).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from shared.geometry.transforms import vector_from_rotation
from shared.imaging.color import LUMINANCE, encode_srgb

SSIM_SIGMA_PX, SSIM_FLOOR = 1.5, (0.01**2, 0.03**2)
"""The window and the two constants of [Wang2004], for values from 0 to 1."""


@dataclass(frozen=True, eq=False)
class HeldOutFrame:
    """frame: its number in the source; picture, render [H, W, 3] linear; regions {name: [H, W] bool}."""

    frame: int
    picture: np.ndarray
    render: np.ndarray
    regions: Mapping[str, np.ndarray]


def region_errors(frames: Iterable[HeldOutFrame]) -> dict[str, dict[str, float]]:
    """{region: {"db", "srgb_db", "ssim", "pixels"}}, of regions that some frame shows: PSNR in dB for a peak of 1 of
    linear values and of sRGB codes, mean structural similarity of the sRGB codes of the luminance."""
    sums: dict[str, np.ndarray] = {}
    for item in frames:
        linear = ((item.render.astype(np.float64) - item.picture) ** 2).mean(-1)
        codes = ((encode_srgb(item.render) - encode_srgb(item.picture)) ** 2).mean(-1)
        likeness = structural_similarity(*(encode_srgb(image @ LUMINANCE) for image in (item.render, item.picture)))
        kinds = np.stack([linear, codes, likeness, np.ones_like(linear)])
        for name, region in item.regions.items():
            sums[name] = sums.get(name, 0.0) + kinds[:, region].sum(1)
    return {
        name: {"db": decibel(linear / count), "srgb_db": decibel(codes / count), "ssim": float(likeness / count),
               "pixels": int(count)}
        for name, (linear, codes, likeness, count) in sums.items() if count
    }  # fmt: skip


def decibel(squared_error: float) -> float:
    """A mean squared error as PSNR in dB for a peak of 1."""
    return float(-10.0 * np.log10(max(squared_error, 1e-12)))


def structural_similarity(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[H, W] of two pictures [H, W] from 0 to 1: equation 13 of [Wang2004] in a Gaussian window about each pixel."""

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values, (0, 0), SSIM_SIGMA_PX)

    a, b = first.astype(np.float64), second.astype(np.float64)
    mean_a, mean_b = mean(a), mean(b)
    variances = mean(a * a) - mean_a**2 + mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    level, contrast = SSIM_FLOOR
    alike = (2.0 * mean_a * mean_b + level) * (2.0 * covariance + contrast)
    return alike / ((mean_a**2 + mean_b**2 + level) * (variances + contrast))


def pose_acceleration(camera_from_head: np.ndarray, frame_index: np.ndarray) -> dict[str, float]:
    """How much poses [F, 4, 4] tremble: median second difference of the rotation (deg) and of the translation across
    the view and along it (mm), per frame squared.

    The head's own motion is in it, so it compares results of one clip. Three poses in a row count where they are evenly
    spaced; a spacing of d frames divides by d squared. NaN where there are none.
    """
    step = np.diff(frame_index)
    even = step[1:] == step[:-1]
    if not even.any():
        return {"deg": float("nan"), "across_mm": float("nan"), "depth_mm": float("nan")}
    turn, place = camera_from_head[:, :3, :3], camera_from_head[:, :3, 3]
    turned = vector_from_rotation(np.einsum("fij,fkj->fik", turn[1:], turn[:-1]))
    squared = step[1:][even, None] ** 2
    rotation = np.diff(turned, axis=0)[even] / squared
    translation = np.diff(place, n=2, axis=0)[even] / squared
    return {
        "deg": float(np.degrees(np.median(np.linalg.norm(rotation, axis=1)))),
        "across_mm": float(np.median(np.linalg.norm(translation[:, :2], axis=1))),
        "depth_mm": float(np.median(np.abs(translation[:, 2]))),
    }
