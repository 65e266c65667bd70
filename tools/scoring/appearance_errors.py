"""What inverse_render found against a subject's truth: maps, light, and re-renders against the video's own frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shared.geometry.mesh import Mesh
from shared.inverse.clip_inputs import ClipInputs
from shared.io.arrays import load_arrays
from shared.io.images import read_exr, read_png
from tools.scoring import measures
from tools.scoring.buffers import BufferRenderer as BufferViewer

SCALAR_ERRORS = "rmse", "correlation", "mean_gt", "mean_result"
"""Of specular intensity and roughness where the result is confident; NaN where it nowhere is."""


def map_errors(
    subject: Path, inputs: ClipInputs, index: np.ndarray, mesh: Mesh, maps: dict[str, np.ndarray]
) -> dict:
    """Albedo, specular intensity, roughness and the calibration of the confidence, in the frames that hold truth."""
    viewer, pairs = BufferViewer(mesh, maps), {name: [] for name in ("albedo", "specular", "roughness")}
    fields = {"albedo": "diffuse_albedo", "specular": "specular_intensity", "roughness": "roughness"}
    confidence = []
    place = {int(frame): i for i, frame in enumerate(index)}
    for frame in load_arrays(subject / "gt" / "poses.npz")["gt_frames"]:
        stem = subject / "gt" / "frames" / f"{int(frame):04d}"
        if int(frame) not in place:
            continue
        inside = read_png(Path(f"{stem}_mask.png")) > 127
        row, column = np.nonzero(inside)
        intrinsics = inputs.frames.intrinsics_source
        seen = viewer.view(inputs.views.camera_from_head[place[int(frame)]], intrinsics, np.stack([column, row], 1))
        hit = seen["coverage"] > 0.5
        confidence.append(seen["confidence"][hit].ravel())
        for name, field in fields.items():
            found = seen[field][hit].reshape(hit.sum(), -1)
            truth = read_exr(f"{stem}_{name}.exr")[row[hit], column[hit]].reshape(hit.sum(), -1)
            pairs[name].append((truth[:, : found.shape[1]], found))
    joined = {name: tuple(np.concatenate(side) for side in zip(*both, strict=True)) for name, both in pairs.items()}
    is_confident = np.concatenate(confidence) > measures.CONFIDENT
    result = _albedo_errors(*joined["albedo"], np.concatenate(confidence))
    result["confident_share"] = float(is_confident.mean())
    for name in ("specular", "roughness"):
        truth, found = (side[is_confident, 0] for side in joined[name])
        errors = measures.scalar_errors(truth, found) if is_confident.any() else dict.fromkeys(SCALAR_ERRORS, np.nan)
        result |= {f"{name}_{key}": errors[key] for key in SCALAR_ERRORS}
    return result


def _albedo_errors(truth: np.ndarray, found: np.ndarray, confidence: np.ndarray) -> dict:
    """[N, 3] pairs and confidence [N]: all of them, and those where the clip saw light, with gains from there: what it
    did not see must not set them."""
    errors, apart, gain = _aligned_errors(truth, found)
    sure = confidence > measures.CONFIDENT
    confident = _aligned_errors(truth[sure], found[sure])[0] if sure.any() else dict.fromkeys(errors, float("nan"))
    edges = np.array([0.0, 0.25, 0.5, 0.75, 0.9, 0.97, 1.001])
    bins = [(confidence >= low) & (confidence < high) for low, high in zip(edges[:-1], edges[1:], strict=True)]
    calibration = [
        [float(low), int(inside.sum()), float(np.median(apart[inside])) if inside.any() else None]
        for low, inside in zip(edges[:-1], bins, strict=True)
    ]
    return {
        **{f"confident_{name}": value for name, value in confident.items()},
        **errors,
        "delta_e2000_raw_median": float(np.median(measures.albedo_differences(truth, found))),
        "gain": [round(float(value), 4) for value in gain],
        "calibration": calibration,
    }


def _aligned_errors(truth: np.ndarray, found: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray]:
    """After one gain per channel: the errors of [N, 3] pairs, the dE2000 of each [N], and the gains [3]."""
    gain = measures.channel_gain(truth.astype(np.float64), found)
    apart = measures.albedo_differences(truth, found * gain)
    errors = {
        "delta_e2000_median": float(np.median(apart)),
        "delta_e2000_p90": float(np.percentile(apart, 90)),
        "psnr_linear": measures.psnr(truth, found * gain),
    }
    return errors, apart, gain
