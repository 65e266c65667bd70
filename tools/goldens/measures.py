"""What of a stage's results is compared: what the method determines, in units of how well it does.

Poses count in standard deviations of their own covariance, maps by their confidence, light by what a matte surface and
a lobe of 25 degrees see of it from the front, plots by their structure. A texel of the light behind the head, or of the
skin behind an ear, is determined by priors alone and by which way a sum was rounded: it is left out.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pxr import Usd
from scipy.spatial.transform import Rotation

from shared.io.arrays import load_arrays, read_json
from shared.io.images import read_exr, read_png
from shared.io.meshes import load_mesh, read_obj
from tools.scoring.measures import ENVMAP_LOBE_SHARPNESS, FRONT_LIMIT, latlong_directions

BLOCKS = 8
LEAST_WEIGHT = 0.05
"""Blocks of a map with a smaller share of the best block's weight are not compared."""
_SKIN = ("forehead", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "chin")
_POINTS = 60
_LIGHT_HEIGHT = 24


@dataclass(frozen=True)
class Measure:
    """values [...] and the scale by which differences from them count (broadcast to them); exact: must be the same."""

    values: np.ndarray
    scale: np.ndarray | float = 1.0
    exact: bool = False


Measures = dict[str, Measure]


def measure(stage: str, folder: Path) -> Measures:
    """{name: Measure} of one stage's folder."""
    return _OF_STAGE[stage](folder)


def _same(*values: object) -> Measure:
    return Measure(np.array([str(value) for value in values]), exact=True)


def _relative(values: object, least: float = 1e-6) -> Measure:
    values = np.asarray(values, np.float64)
    return Measure(values, np.maximum(np.abs(values), least))


def _sample_frames(folder: Path) -> Measures:
    facts = read_json(folder / "frames.json")
    frames, files = facts["frames"], [folder / "frames" / Path(frame["file"]).name for frame in facts["frames"]]
    masks = [read_png(folder / frame["mask"]) for frame in frames]
    return {
        "frames kept": _same(*(frame["frame_index"] for frame in frames)),
        "frames dropped": _same(*(row["frame_index"] for row in facts["dropped"])),
        "crop": _relative(list(facts["crop"].values()), 1.0),
        "intrinsics": _relative(facts["intrinsics"], 1.0),
        "sharpness": Measure(np.array([frame["sharpness"] for frame in frames])),
        "face boxes, px": Measure(np.array([frame["face_box"] for frame in frames])),
        "frames, block means": Measure(np.array([_block_means(read_png(path) / 255.0) for path in files])),
        "masks, shares": Measure(np.array([[(mask == kind).mean() for kind in (128, 255)] for mask in masks])),
        "masks, centres px": Measure(np.array([np.argwhere(mask > 0).mean(0) for mask in masks])),
        "contact sheet": _same(read_png(folder / "contact_sheet.png").shape),
    }


def _track_landmarks(folder: Path) -> Measures:
    facts, poses, tracks = (read_json(folder / "tracking.json"), load_arrays(folder / "poses.npz"),
                            load_arrays(folder / "tracks.npz"))
    deviation = np.sqrt(np.einsum("fii->fi", poses["covariance"]))
    segment = load_arrays(folder / "mesh.npz")["face_segment"]
    mesh = load_mesh(folder / "mesh.npz")
    skin = np.unique(mesh.faces[np.isin(segment, [facts["segments"].index(name) for name in _SKIN])])
    return _poses(poses, deviation) | {
        "frames": _same(*poses["frame_index"]),
        "frames left out": _same(*(row["frame_index"] for row in facts["excluded"])),
        "log deviations": Measure(np.log(deviation)),
        "landmarks, px": Measure(load_arrays(folder / "landmarks.npz")["landmarks_px"][:, ::20]),
        "skin, mm": Measure(mesh.vertices[_spread(skin)]),
        "gaze": Measure(np.nan_to_num(poses["gaze"])),
        "eyes that are shut": _same(*(len(facts["eyes"][f"shut_{side}"]) for side in ("right", "left"))),
        "number of tracks": _relative(facts["tracks"]),
        "reprojection": _relative(list(facts["reprojection_px"].values())),
        "depth noise": _relative(np.percentile(tracks["sigma_mm"], [10, 50, 90])),
        "noise factor": _relative(facts["noise_factor"]),
        "focal gain": Measure(np.array(facts["focal"]["gain"]), facts["focal"]["log_deviation"]),
        "identity": Measure(np.array(facts["identity"])),
        "expression": Measure(np.array(facts["expression"])),
        "curves.png": _plot(read_png(folder / "curves.png")),
        "pictures": _same(*(read_png(folder / f"{name}.png").shape for name in ("overlay", "residuals"))),
    }


def _init_albedo(folder: Path) -> Measures:
    facts = read_json(folder / "init.json")
    weight = read_exr(folder / "weight.exr")
    segments = [facts["segments"][name] for name in sorted(facts["segments"])]
    return {
        "mean texture": _map(read_exr(folder / "mean_texture.exr"), weight, relative=True),
        "weight": _relative(_block_means(weight), 0.1),
        "segments": _same(*sorted(facts["segments"])),
        "colours of segments": _relative([segment["albedo"] for segment in segments], 0.01),
        "texels seen": _relative([segment["texels_seen"] for segment in segments], 10.0),
        "segment map": Measure(_block_means(read_exr(folder / "segment_albedo.exr"))),
        "segments.png": _same(read_png(folder / "segments.png").shape),
    }


def _inverse_render(folder: Path) -> Measures:
    facts, poses = read_json(folder / "solve.json"), load_arrays(folder / "poses.npz")
    arrays = load_arrays(folder / "mesh.npz")
    skin = np.unique(arrays["faces"][arrays["face_segment"] < len(_SKIN)])
    model, residuals = facts["model"], facts["residuals"]
    renders = [read_exr(path) for path in sorted((folder / "renders").glob("*.exr"))]
    return _light(folder / "envmap.exr") | _maps(folder / "maps", "") | _poses(poses, np.full((1, 6), 0.1)) | {
        "frames held out": _same(*facts["held_out_frames"]),
        "light model": _same(model["light"]),
        "residuals": _relative([residuals["fitted"], residuals["held_out"]]),
        "specular intensity, roughness": Measure(np.array([model["specular_intensity"], model["roughness"]])),
        "skin albedo": _relative(facts["albedo_scale"]["skin_albedo"]),
        "skin, mm": Measure(arrays["vertices"][_spread(skin)]),
        "re-renders": Measure(np.array([_block_means(image) for image in renders])),
        "shape.png": _same(read_png(folder / "shape.png").shape),
    }


def _export_usd(folder: Path) -> Measures:
    mesh, record = read_obj(folder / "mesh.obj"), read_json(folder / "run.json")
    views = sorted((folder / "views").glob("*.exr")) + sorted((folder / "renders").glob("*.exr"))
    stage = Usd.Stage.Open(str(folder / "head.usda"))
    prims = [f"{prim.GetPath()} {prim.GetTypeName()} {len(prim.GetAuthoredPropertyNames())}"
             for prim in stage.Traverse()]
    page = (folder / "report.html").read_text(encoding="utf-8")
    plates = [read_png_or_jpeg(path).shape for path in sorted((folder / "plates").iterdir())]
    return _light(folder / "envmap.exr") | _maps(folder / "maps", "") | {
        "mesh, counts": _same(mesh.vertices.shape, mesh.faces.shape, mesh.uvs.shape),
        "mesh, mm": Measure(mesh.vertices[_spread(np.arange(len(mesh.vertices)))]),
        "USD prims": _same(*prims),
        "head.glb": _same(*_glb_structure((folder / "head.glb").read_bytes())),
        "run.json": _same(*_keys(record)),
        "report's headings": _same(*re.findall(r"<h[123][^>]*>(.*?)</h", page)),
        "pictures": Measure(np.array([_block_means(read_exr(path)).mean(-1) for path in views]), 1.0),
        "plates": _same(*plates),
    }


_OF_STAGE: dict[str, Callable[[Path], Measures]] = {
    "sample_frames": _sample_frames,
    "track_landmarks": _track_landmarks,
    "init_albedo": _init_albedo,
    "inverse_render": _inverse_render,
    "export_usd": _export_usd,
}


def _poses(poses: dict[str, np.ndarray], deviation: np.ndarray) -> Measures:
    """Turns and places of the head, in deviations [F, 6] of radians and mm, and the lens."""
    turn = Rotation.from_matrix(poses["camera_from_head"][:, :3, :3]).as_rotvec()
    return {
        "rotation, deviations": Measure(turn, deviation[:, :3]),
        "translation, deviations": Measure(poses["camera_from_head"][:, :3, 3], deviation[:, 3:]),
        "intrinsics of the source": _relative(poses["intrinsics"], 1.0),
    }


def _light(path: Path) -> Measures:
    """What a matte surface and a lobe of 25 degrees see of a lat-long light, from where the visible side is lit."""
    image = read_exr(path)
    image = cv2.resize(image, (2 * _LIGHT_HEIGHT, _LIGHT_HEIGHT), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    directions, share = latlong_directions(_LIGHT_HEIGHT, 2 * _LIGHT_HEIGHT)
    front = directions[:, 2] > FRONT_LIMIT
    cosine = directions[front] @ directions.T
    measures = {}
    kernels = {"irradiance": np.clip(cosine, 0, 1), "light, lobe of 25 degrees":
               np.exp(ENVMAP_LOBE_SHARPNESS * (cosine - 1))}
    for name, kernel in kernels.items():
        kernel = kernel * share
        seen = kernel / kernel.sum(1, keepdims=True) @ image.astype(np.float64)
        measures[name] = _relative(seen[:: max(1, len(seen) // _POINTS)])
    return measures


def _maps(folder: Path, prefix: str) -> Measures:
    """Maps, each by the confidence of the albedo."""
    confidence = read_exr(folder / "confidence.exr")
    weight = confidence if confidence.ndim == 2 else confidence[..., 0]
    measures = {f"{prefix}confidence": Measure(_block_means(weight))}
    for name in ("diffuse_albedo", "specular_intensity", "roughness", "normal"):
        measures[prefix + name] = _map(read_exr(folder / f"{name}.exr"), weight, relative=name == "diffuse_albedo")
    return measures


def _map(image: np.ndarray, weight: np.ndarray, relative: bool) -> Measure:
    """Weighted means over the blocks that have weight."""
    weight = weight if weight.ndim == 2 else weight[..., 0]
    image = image if image.ndim == 3 else image[..., None]
    whole = np.array(list(_blocks(weight[..., None]))).mean((1, 2))[:, 0]
    used = whole > LEAST_WEIGHT * whole.max()
    sums = np.array([block.sum((0, 1)) for block in _blocks(image * weight[..., None])])
    totals = np.array([block.sum() for block in _blocks(weight[..., None])])
    means = sums[used] / totals[used, None]
    return _relative(means, 0.01) if relative else Measure(means)


def _blocks(image: np.ndarray) -> Iterator[np.ndarray]:
    for rows in np.array_split(image, BLOCKS):
        yield from np.array_split(rows, BLOCKS, axis=1)


def _block_means(image: np.ndarray) -> np.ndarray:
    """[64] or [64, C] means over the blocks."""
    return np.array([block.mean((0, 1)) for block in _blocks(image.astype(np.float64))])


def _spread(index: np.ndarray) -> np.ndarray:
    return index[np.linspace(0, len(index) - 1, _POINTS).astype(int)]


def _plot(picture: np.ndarray) -> Measure:
    """A plot's structure: its size; of each of its colours the columns that it spans, the share of them where it shows
    and the number of pieces it falls into above and below (its legend's words and its curves), in tens of pixels."""
    rows = [[*picture.shape[:2], 0.0]]
    bright = picture.max(-1).astype(int) - picture.min(-1) > 90
    hue = cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)[..., 0] // 30
    for kind in range(6):
        columns = np.nonzero((bright & (hue == kind)).any(0))[0]
        if len(columns):
            rows.append([columns[0], columns[-1], len(columns) / (columns[-1] - columns[0] + 1)])
        else:
            rows.append([-1.0, -1.0, 0.0])
    return Measure(np.array(rows, float), np.array([10.0, 10.0, 1.0]))


def read_png_or_jpeg(path: Path) -> np.ndarray:
    """A plate as [H, W, 3]."""
    return cv2.imread(str(path), cv2.IMREAD_COLOR)


def _glb_structure(data: bytes) -> list[str]:
    import json

    length = int.from_bytes(data[12:16], "little")
    content = json.loads(data[20 : 20 + length])
    return [f"{name}: {len(value) if isinstance(value, list | dict) else value}" for name, value in content.items()]


def _keys(value: object, path: str = "") -> list[str]:
    """Names of all entries of a record, whatever stands there; of lists of records the first."""
    if isinstance(value, dict):
        return [name for key in sorted(value) for name in [f"{path}/{key}", *_keys(value[key], f"{path}/{key}")]]
    return _keys(value[0], path) if isinstance(value, list) and value and isinstance(value[0], dict) else []
