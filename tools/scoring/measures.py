"""The measures behind a score: pure functions of arrays, returning small dictionaries of floats.

Colours are scene-linear Rec.709. PSNR and dE2000 values marked `aligned` remove one gain per colour channel, which a
clip without a chart cannot fix; `one_gain` removes a single common factor; `raw` removes nothing.
"""

from __future__ import annotations

import numpy as np

from shared.geometry.transforms import camera_centres, nearest_rotation, similarity_from_points
from shared.imaging.color import delta_e_2000, encode_srgb

COVERED_CHI_SQUARED = 6.251
"""90 % of a chi-squared variable of three degrees of freedom."""
DELTA_E_SAMPLES = 100_000
CONFIDENT, ACCEPTABLE_DELTA_E, WRONG_DELTA_E = 0.5, 8.0, 6.0
"""Confidence from which on a texel counts as seen, the dE2000 that no such texel of the face's skin should exceed, and
the one that few of all the head may."""
CLIPPED = 0.98
ENVMAP_WIDTH = 96
ENVMAP_LOBE_SHARPNESS = 12.0
FRONT_LIMIT = -0.2
LEAST_ALBEDO = 1e-4
"""Smaller ones count as this where ratios are taken."""


def summary(values: np.ndarray) -> dict[str, float]:
    """Mean, median and 95th percentile of the values."""
    return {
        "mean": float(np.mean(values)),
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
    }


def rotation_angle_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle between rotations [...,3,3], degrees, accurate for small angles (through the Frobenius distance)."""
    chord = np.linalg.norm(first - second, axis=(-2, -1)) / np.sqrt(8.0)
    return np.degrees(2 * np.arcsin(np.clip(chord, 0, 1)))


def psnr(truth: np.ndarray, result: np.ndarray) -> float:
    """Peak signal to noise ratio in dB for a peak of 1."""
    return float(-10 * np.log10(max(np.mean((truth.astype(np.float64) - result) ** 2), 1e-12)))


def channel_gain(truth: np.ndarray, result: np.ndarray) -> np.ndarray:
    """[N,C] pairs -> [C] least-squares gains on the result."""
    return (truth * result).sum(0) / np.maximum((result * result).sum(0), 1e-12)


def pose_errors(truth: np.ndarray, result: np.ndarray) -> dict:
    """camera_from_head [F,4,4] in the same head frame and unit: rotation (deg), translation (mm), depth (mm)."""
    shift = result[:, :3, 3] - truth[:, :3, 3]
    return {
        "frames": len(truth),
        "rotation_deg": summary(rotation_angle_deg(truth[:, :3, :3], result[:, :3, :3])),
        "translation_mm": summary(np.linalg.norm(shift, axis=1)),
        "depth_mm_median": float(np.median(np.abs(shift[:, 2]))),
    }


def pose_errors_own_alignment(truth: np.ndarray, result: np.ndarray) -> dict:
    """Pose errors that no mesh enters: rotations after one mean rotation, camera centres after one similarity."""
    mean = nearest_rotation(np.einsum("fji,fjk->ik", truth[:, :3, :3], result[:, :3, :3]))
    source, target = camera_centres(result), camera_centres(truth)
    scale, rotation, shift = similarity_from_points(source, target)
    residual = scale * source @ rotation.T + shift - target
    return {
        "rotation_deg": summary(rotation_angle_deg(truth[:, :3, :3] @ mean, result[:, :3, :3])),
        "camera_centre_mm": summary(np.linalg.norm(residual, axis=1)),
    }


def rotation_coverage(apart: np.ndarray, covariance: np.ndarray) -> float:
    """Share of frames whose rotation error lies within the 90 % region that its covariance states.

    apart [F, 3]: rotation vectors from the truth; covariance [F, 3, 3] about the same axes, radians squared.
    """
    distance = np.einsum("fi,fi->f", apart, np.linalg.solve(covariance, apart[..., None])[..., 0])
    return float((distance < COVERED_CHI_SQUARED).mean())


def rotation_acceleration_deg(apart: np.ndarray, frame_index: np.ndarray) -> float:
    """Mean length of the second difference of rotation errors: how much poses tremble, degrees per frame squared.

    apart [F, 3]: rotation vectors from the truth, radians; frame_index [F]. Three poses in a row count where they are
    evenly spaced; a spacing of d frames divides by d squared. NaN where there are none.
    """
    step = np.diff(frame_index)
    even = step[1:] == step[:-1]
    change = np.diff(apart, n=2, axis=0)[even] / step[1:][even, None] ** 2
    return float(np.degrees(np.linalg.norm(change, axis=1)).mean()) if even.any() else float("nan")


def albedo_differences(truth: np.ndarray, result: np.ndarray) -> np.ndarray:
    """[N,3] linear albedo pairs -> dE2000 [N]; what is negative counts as black."""
    return delta_e_2000(np.clip(truth, 0, None), np.clip(result, 0, None))


def albedo_errors(
    truth: np.ndarray, result: np.ndarray, rng: np.random.Generator, confidence: np.ndarray | None = None
) -> dict:
    """[N,3] linear albedo pairs -> PSNR, RMSE and median dE2000, with three, one and no gain removed; gain, by least
    squares, and median_gain, the median over the pixels, which whites of eyes among dark skin leave alone.

    confidence [N] of the result, where it states one: `confident` then has the errors where it is above CONFIDENT.
    """
    truth, result = truth.astype(np.float64), result.astype(np.float64)
    gain = channel_gain(truth, result)
    common = (truth * result).sum() / max((result * result).sum(), 1e-12)
    subset = rng.choice(len(truth), min(len(truth), DELTA_E_SAMPLES), replace=False)
    scores: dict = {}
    for name, value in (("aligned", result * gain), ("aligned_one_gain", result * common), ("raw", result)):
        difference = albedo_differences(truth[subset], value[subset])
        scores[name] = {
            "psnr_linear": psnr(truth, value),
            "psnr_srgb": psnr(srgb(truth), srgb(value)),
            "rmse_linear": float(np.sqrt(np.mean((truth - value) ** 2))),
            "delta_e2000_median": float(np.median(difference)),
        }
    scores["gain"] = gain.tolist()
    scores["median_gain"] = np.exp(np.median(np.log(np.maximum(truth, LEAST_ALBEDO) / np.maximum(result, LEAST_ALBEDO)),
                                             axis=0)).tolist()
    if confidence is not None:
        scores["confident"] = confident_errors(truth[subset], result[subset], confidence[subset])
    return scores


def confident_errors(truth: np.ndarray, result: np.ndarray, confidence: np.ndarray) -> dict[str, float]:
    """[N,3] linear albedo pairs and confidence [N] -> the share of confident ones, and their dE2000 after one gain per
    channel, taken from them alone: what the clip did not see must not set it. Where none is confident, no dE2000."""
    sure = confidence > CONFIDENT
    scores = {"share": float(sure.mean())}
    if not sure.any():
        return scores
    truth, result = truth[sure].astype(np.float64), result[sure].astype(np.float64)
    result = result * channel_gain(truth, result)
    difference = albedo_differences(truth, result)
    return scores | {
        "delta_e2000_median": float(np.median(difference)),
        "delta_e2000_p99": float(np.percentile(difference, 99)),
        "acceptable": float((difference < ACCEPTABLE_DELTA_E).mean()),
        "psnr_linear": psnr(truth, result),
    }


def scalar_errors(truth: np.ndarray, result: np.ndarray) -> dict[str, float]:
    """[N] specular intensity or roughness pairs -> errors, best common scale and correlation."""
    truth, result = truth.astype(np.float64), result.astype(np.float64)
    scale = float((truth * result).sum() / max((result * result).sum(), 1e-12))
    varied = truth.std() > 1e-6 and result.std() > 1e-6
    return {
        "rmse": float(np.sqrt(np.mean((truth - result) ** 2))),
        "rmse_scaled": float(np.sqrt(np.mean((truth - scale * result) ** 2))),
        "scale": scale,
        "correlation": float(np.corrcoef(truth, result)[0, 1]) if varied else 0.0,
        "mean_gt": float(truth.mean()),
        "mean_result": float(result.mean()),
    }


def image_errors(pairs: list[tuple[np.ndarray, np.ndarray]]) -> dict:
    """(truth, result) lists of linear pixels [N,3] -> sRGB-coded PSNR, raw and after one gain per channel for all.

    The gain is taken where the truth is not clipped.
    """
    truth, result = (np.concatenate(side) for side in zip(*pairs, strict=True))
    valid = (truth < CLIPPED).all(1)
    gain = channel_gain(truth[valid].astype(np.float64), result[valid])
    return {
        "psnr": psnr(srgb(truth), srgb(result)),
        "psnr_gain": psnr(srgb(truth), srgb(result * gain)),
        "gain": gain.tolist(),
    }


def srgb(linear: np.ndarray) -> np.ndarray:
    """Linear colours -> sRGB codes, clipped to [0, 1] as a camera would."""
    return encode_srgb(np.clip(linear, 0, 1))


def envmap_errors(truth: np.ndarray, result: np.ndarray) -> dict:
    """Lat-long maps [h,96,3] of the same size -> how differently they light a face, per-channel gain removed.

    Compared through two kernels: the clamped cosine (what a matte surface sees) and a lobe of about 25 degrees (what
    skin reflects). `_front` keeps only directions that can light the visible side.
    """
    directions, solid_angle = latlong_directions(*truth.shape[:2])
    cosine = directions @ directions.T
    kernels = {"irradiance": np.clip(cosine, 0, 1), "lobe25": np.exp(ENVMAP_LOBE_SHARPNESS * (cosine - 1))}
    regions = {"": np.ones(len(directions), bool), "_front": directions[:, 2] > FRONT_LIMIT}
    scores: dict = {}
    for name, kernel in kernels.items():
        kernel = kernel * solid_angle
        kernel = kernel / kernel.sum(1, keepdims=True)
        blurred = [kernel @ image.reshape(-1, 3).astype(np.float64) for image in (truth, result)]
        for region, inside in regions.items():
            weight = (solid_angle[inside] / solid_angle[inside].sum())[:, None]
            gain, error, correlation = _weighted_match(blurred[0][inside], blurred[1][inside], weight)
            scores[f"{name}{region}_rel_rmse"] = float(error.mean())
            scores[f"{name}{region}_correlation"] = float(correlation.mean())
            if not region:
                scores[f"{name}_gain"] = gain.tolist()
    return scores


def latlong_directions(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """World directions [h*w,3] of lat-long pixels and their share of the sphere [h*w]."""
    polar = np.pi * (np.arange(height)[:, None] + 0.5) / height
    azimuth = 2 * np.pi * (np.arange(width)[None] + 0.5) / width
    up = np.broadcast_to(np.cos(polar), (height, width))
    directions = np.stack([np.sin(azimuth) * np.sin(polar), up, -np.cos(azimuth) * np.sin(polar)], -1)
    share = np.broadcast_to(np.sin(polar), (height, width)).ravel()
    return directions.reshape(-1, 3), share / share.sum()


def _weighted_match(
    truth: np.ndarray, result: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[N,3] pairs, weights [N,1] of sum 1 -> per channel: gain on the result, relative RMSE, correlation."""
    gain = (weight * truth * result).sum(0) / np.maximum((weight * result * result).sum(0), 1e-12)
    error = np.sqrt((weight * (truth - gain * result) ** 2).sum(0) / (weight * truth * truth).sum(0))
    centred_truth = truth - (weight * truth).sum(0)
    centred_result = gain * result - (weight * gain * result).sum(0)
    spread = np.sqrt((weight * centred_truth**2).sum(0) * (weight * centred_result**2).sum(0) + 1e-20)
    return gain, error, (weight * centred_truth * centred_result).sum(0) / spread
