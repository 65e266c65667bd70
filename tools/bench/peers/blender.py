"""Opens an exported head in Blender and compares what arrives with the export, a Cycles render with our re-render.

    python -m tools.bench.peers.blender RUN --blender-python BPY/bin/python [--frame N] [--size PX] [--samples N] [--out
    DIR]

RUN: a folder with work/ and export/. Blender's Python has the bpy wheel (`python -m venv BPY; BPY/bin/pip install
bpy==5.0.1`); it wants an older numpy than Limn, hence its own environment. LIMN_BLENDER_PYTHON may name it too.
Prints the agreement on the face skin and writes comparison.png: our re-render, Blender's, and ten times their
difference about grey.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from shared.errors import InputError
from shared.geometry.raycast import RayScene, camera_hits
from shared.imaging.color import encode_srgb
from shared.inverse.problem import FACE_SKIN
from shared.io.arrays import load_arrays, read_json
from shared.io.images import read_exr, write_png
from shared.io.meshes import load_mesh
from tools.scoring import measures

VARIABLE = "LIMN_BLENDER_PYTHON"
_PROBE = Path(__file__).with_name("blender_probe.py")
_TIME_LIMIT_S = 600


@dataclass(frozen=True)
class Probe:
    """facts: content of probe.json; mesh: arrays of mesh.npz; renders {frame: [H, W, 3] linear}."""

    facts: dict
    mesh: dict[str, np.ndarray]
    renders: dict[int, np.ndarray]


def blender_python() -> Path | None:
    """The interpreter that LIMN_BLENDER_PYTHON names; None when it is not set. InputError when it does not exist."""
    value = os.environ.get(VARIABLE)
    if not value:
        return None
    if not Path(value).is_file():
        raise InputError("no such interpreter", where=VARIABLE, got=value, hint="name the python that has bpy")
    return Path(value)


def probe(python: Path, asset: Path, frames: list[int], size: tuple[int, int] = (320, 320), samples: int = 0) -> Probe:
    """What Blender makes of the asset; samples per pixel, 0: no render. InputError when Blender fails on it."""
    with tempfile.TemporaryDirectory() as scratch:
        words = [python, _PROBE, asset, scratch, "--frames", *frames, "--size", *size, "--samples", samples]
        done = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=_TIME_LIMIT_S)
        if not (Path(scratch) / "probe.json").is_file():
            last = (done.stderr or done.stdout).strip().splitlines()[-1:]
            raise InputError("Blender could not open it", where=str(asset), got=" ".join(last))
        renders = {frame: read_exr(Path(scratch) / f"{frame:04d}.exr") for frame in frames} if samples else {}
        facts = json.loads((Path(scratch) / "probe.json").read_text())
        return Probe(facts, load_arrays(Path(scratch) / "mesh.npz"), renders)


def skin_mask(run: Path, frame: int, size: tuple[int, int], intrinsics: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels whose centre shows a face-skin segment, one pixel away from anything else."""
    solved = run / "work" / "inverse_render"
    arrays, mesh = load_arrays(solved / "mesh.npz"), load_mesh(solved / "mesh.npz")
    names = read_json(run / "work" / "track_landmarks" / "tracking.json")["segments"]
    wanted = [names.index(name) for name in FACE_SKIN if name in names]
    poses = load_arrays(run / "export" / "poses.npz")
    pose = poses["camera_from_head"][list(poses["frame_index"]).index(frame)]
    face, _, _ = camera_hits(RayScene(mesh.vertices, mesh.faces), pose, intrinsics, *size, (0.5, 0.5))
    skin = (face >= 0) & np.isin(arrays["face_segment"], wanted)[np.maximum(face, 0)]
    return cv2.erode(skin.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


@dataclass(frozen=True)
class Agreement:
    """Blender's render against ours on the face skin: decibels of sRGB codes and of linear light, and the mean ratio
    per channel; ours and blender [H, W, 3] linear, skin [H, W] bool."""

    psnr_srgb: float
    psnr_linear: float
    ratio: list[float]
    ours: np.ndarray
    blender: np.ndarray
    skin: np.ndarray


def compare_render(run: Path, python: Path, frame: int, width: int, samples: int) -> Agreement:
    """Renders frame through the asset's camera and compares it with export/renders."""
    ours = read_exr(run / "export" / "renders" / f"{frame:04d}.exr")
    scale = width / ours.shape[1]
    size = (width, round(ours.shape[0] * scale))
    blender = probe(python, run / "export" / "head.usda", [frame], size, samples).renders[frame]
    intrinsics = np.diag([scale, scale, 1.0]) @ load_arrays(run / "export" / "poses.npz")["intrinsics"]
    covered = cv2.resize((ours > 0).any(-1).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    skin = skin_mask(run, frame, size, intrinsics) & covered
    ours = cv2.resize(ours, size, interpolation=cv2.INTER_AREA)
    first, second = ours[skin], blender[skin]
    return Agreement(
        measures.psnr(encode_srgb(first), encode_srgb(second)),
        measures.psnr(np.clip(first, 0, 1), np.clip(second, 0, 1)),
        (second.mean(0) / first.mean(0)).tolist(),
        ours,
        blender,
        skin,
    )


def comparison_picture(found: Agreement) -> np.ndarray:
    """uint8 [H, 3 W, 3]: ours, Blender's, ten times the difference about grey on the skin."""
    difference = np.clip(0.5 + 10.0 * (found.blender - found.ours), 0.0, 1.0)
    difference[~found.skin] = 0.5
    parts = (encode_srgb(found.ours), encode_srgb(found.blender), difference)
    return (np.concatenate(parts, axis=1) * 255.0 + 0.5).astype(np.uint8)


def main() -> int:
    """Compares and prints; exit code 2 when Blender or the run is not there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--blender-python", type=Path, default=None)
    parser.add_argument("--frame", type=int, default=None, help="one of export/renders; default: the middle one")
    parser.add_argument("--size", type=int, default=360, help="width of the render, px")
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    try:
        python = options.blender_python or blender_python()
        if python is None:
            raise InputError("no Blender", where=VARIABLE, hint="give --blender-python, or set the variable")
        rendered = sorted(int(path.stem) for path in (options.run / "export" / "renders").glob("*.exr"))
        if not rendered:
            raise InputError("no re-renders", where=str(options.run / "export" / "renders"), hint="run limn run first")
        frame = rendered[len(rendered) // 2] if options.frame is None else options.frame
        found = compare_render(options.run, python, frame, options.size, options.samples)
    except InputError as error:
        print(f"tools.bench.peers.blender: {error}")
        return 2
    print(f"frame {frame}, {int(found.skin.sum())} skin pixels, {options.samples} samples: "
          f"{found.psnr_srgb:.1f} dB sRGB, {found.psnr_linear:.1f} dB linear, "
          f"Blender / ours {', '.join(f'{value:.3f}' for value in found.ratio)}")
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        write_png(options.out / "comparison.png", comparison_picture(found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
