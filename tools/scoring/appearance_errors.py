"""What inverse_render found against a subject's truth: maps, light, and re-renders against the video's own frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from shared.geometry.mesh import Mesh, interpolate
from shared.geometry.raycast import RayScene, camera_hits
from shared.imaging.color import encode_srgb
from shared.imaging.texture import sample_bilinear
from shared.inverse.clip_inputs import ClipInputs
from shared.inverse.problem import InverseResult
from shared.io.arrays import load_arrays
from shared.io.images import read_exr, read_png
from shared.io.meshes import read_obj
from shared.rendering.render import SurfaceMaps, render_frame
from tools.scoring import measures
from tools.scoring.buffers import BufferRenderer as BufferViewer

CONFIDENT = 0.5
RENDERED_FRAMES = 6


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
    is_confident = np.concatenate(confidence) > CONFIDENT
    result = _albedo_errors(*joined["albedo"], np.concatenate(confidence))
    result["confident_share"] = float(is_confident.mean())
    for name in ("specular", "roughness"):
        truth, found = (side[is_confident, 0] for side in joined[name])
        errors = measures.scalar_errors(truth, found)
        result |= {f"{name}_{key}": errors[key] for key in ("rmse", "correlation", "mean_gt", "mean_result")}
    return result


def _albedo_errors(truth: np.ndarray, found: np.ndarray, confidence: np.ndarray) -> dict:
    """[N, 3] pairs and confidence [N]: all of them, and those where the clip saw light, with gains from there: what it
    did not see must not set them."""
    errors, apart, gain = _aligned_errors(truth, found)
    sure = confidence > CONFIDENT
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


def light_errors(subject: Path, latlong: np.ndarray) -> dict:
    """Correlation and relative error of the light through a lobe of 25 degrees, everywhere and in front."""
    size = (measures.ENVMAP_WIDTH, measures.ENVMAP_WIDTH // 2)
    truth = cv2.resize(read_exr(subject / "gt" / "envmap.exr"), size, interpolation=cv2.INTER_AREA)
    errors = measures.envmap_errors(truth, cv2.resize(latlong, size, interpolation=cv2.INTER_AREA))
    return {name: errors[name] for name in ("lobe25_correlation", "lobe25_rel_rmse", "lobe25_front_correlation")}


def render_errors(subject: Path, inputs: ClipInputs, result: InverseResult) -> dict:
    """sRGB-coded PSNR of re-renders against the video's own frames on the face skin, fitted and held out."""
    truth_mesh, mask = read_obj(subject / "gt" / "mesh.obj"), read_exr(subject / "gt" / "mask.exr")
    poses = load_arrays(subject / "gt" / "poses.npz")["camera_from_head"]
    scene, views = RayScene(truth_mesh.vertices, truth_mesh.faces), inputs.views
    maps = SurfaceMaps(*(result.maps[name] for name in ("diffuse_albedo", "specular_intensity")))
    errors: dict[str, list] = {"fitted": [], "held_out": []}
    for name, chosen in (("fitted", result.fitted), ("held_out", ~result.fitted)):
        index = np.nonzero(chosen[: len(views)])[0]
        for f in index[np.unique(np.linspace(0, len(index) - 1, RENDERED_FRAMES).astype(int))]:
            frame, pose = int(inputs.frame_index[f]), views.camera_from_head[f]
            face, bary, _ = camera_hits(scene, poses[frame], inputs.lens, *views.size)
            hit = face >= 0
            uv = interpolate(truth_mesh.uvs, truth_mesh.face_uvs, face[hit], bary[hit])
            skin = np.zeros(face.shape, bool)
            skin[hit] = sample_bilinear(mask, uv).reshape(len(uv), -1)[:, 0] > 0.5
            skin = cv2.erode(skin.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            image, coverage = render_frame(result.viewer, result.shading, maps, f, pose, inputs.lens, views.size)
            seen = skin & (coverage > 0.99)
            video = views.picture(f).levels[0]
            difference = encode_srgb(np.clip(video[seen], 0, 1)) - encode_srgb(np.clip(image[seen], 0, 1))
            errors[name].append((float(np.square(difference).sum()), difference.size))
    mean = {name: np.sum(parts, 0) for name, parts in errors.items()}
    return {f"rerender_{name}": float(-10 * np.log10(total / count)) for name, (total, count) in mean.items()}
