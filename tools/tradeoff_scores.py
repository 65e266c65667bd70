"""All scores of one result of tools/chart.py, as {dotted name: number}.

What tools.score compares beside maps, mesh, poses and light are pictures: re-renders of the clip's frames and of the
head under lights that it did not see. Here one renderer makes them for all results, with visibility and bounces,
whatever model was solved: the maps are judged, not the solver's own renderer.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from shared.io.arrays import load_arrays, read_json
from shared.io.images import read_exr, write_exr
from shared.io.meshes import write_obj
from shared.solve.capture import Sizes
from shared.solve.views import Camera, HeadViews
from tools.bench_relight import result_poses
from tools.relight_inputs import Asset, open_asset
from tools.score import camera_intrinsics, score, score_geometry

SIZES = Sizes(directions=768, nodes=500)
SCORED_FRAMES, RENDERED_FRAMES = 12, 4
CODE = ("tools/tradeoff_scores.py", "tools/score.py", "tools/score_align.py", "tools/score_measures.py",
        "tools/score_buffers.py")  # fmt: skip
"""What the numbers depend on beside the result."""


def scores_of(subject: Path, result: Path) -> dict[str, float]:
    """result: a folder with maps/, poses.npz, envmap.exr, solve.json, and mesh.npz or mesh.obj."""
    asset = open_asset(result, (0.5,) * 3, 0.0, 0.5)
    with tempfile.TemporaryDirectory() as folder:
        export = Path(folder)
        write_obj(export / "mesh.obj", asset.mesh)
        for name in ("maps", "poses.npz", "envmap.exr"):
            os.symlink((result / name).resolve(), export / name)
        render_pictures(subject, asset, export)
        return flat(score(subject, export, SCORED_FRAMES))


def render_pictures(subject: Path, asset: Asset, export: Path) -> None:
    """renders/NNNN.exr of some frames that hold truth, relit/NAME.exr of all of relight/, through the true lens."""
    capture, truth = read_json(subject / "capture.json"), load_arrays(subject / "gt" / "poses.npz")
    size = capture["width"], capture["height"]
    place = {int(frame): k for k, frame in enumerate(asset.frame_index)}
    known = [int(frame) for frame in truth["gt_frames"] if int(frame) in place]
    frames = [known[k] for k in np.unique(np.linspace(0, len(known) - 1, RENDERED_FRAMES).astype(int))]
    clip = [Camera(asset.poses[place[frame]], asset.intrinsics, size) for frame in frames]
    relit = _relit_cameras(subject, asset, truth["camera_from_head"], size)
    views = HeadViews(asset.mesh, asset.maps, SIZES, [*clip, *relit.values()])
    for folder in ("renders", "relit"):
        (export / folder).mkdir()
    for frame, picture in zip(frames, views.render(asset.envmap, clip, asset.moves, fade=False), strict=True):
        write_exr(export / "renders" / f"{frame:04d}.exr", picture, colour_space="lin_rec709_scene")
    for path in sorted((subject / "relight").glob("*_envmap.exr")):
        light = path.name.removesuffix("_envmap.exr")
        pictures = views.render(read_exr(path).astype(np.float64), list(relit.values()), "head", fade=False)
        for name, picture in zip(relit, pictures, strict=True):
            write_exr(export / "relit" / f"{light}_{name}.exr", picture, colour_space="lin_rec709_scene")


def _relit_cameras(subject: Path, asset: Asset, poses: np.ndarray, size: tuple[int, int]) -> dict[str, Camera]:
    """{view: camera} of the pictures in relight/, in the result's head space."""
    if not (subject / "relight" / "poses.npz").is_file():
        return {}
    true_poses = poses[asset.frame_index]
    alignment, _ = score_geometry(subject, asset.mesh, true_poses, asset.poses, np.random.default_rng(0))
    views = load_arrays(subject / "relight" / "poses.npz")
    found = result_poses(np.stack(list(views.values())), alignment)
    return {
        name: Camera(pose, camera_intrinsics(subject), size) for name, pose in zip(views, found, strict=True)
    }


def flat(scores: Mapping, prefix: str = "") -> dict[str, float]:
    """Nested dictionaries -> {"albedo.raw.psnr_linear": number}; numbers of lists by their place, texts left out."""
    found: dict[str, float] = {}
    for name, value in scores.items():
        if isinstance(value, list):
            value = dict(enumerate(value))
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{name}.")
        elif isinstance(value, int | float) and np.isfinite(value):
            found[f"{prefix}{name}"] = round(float(value), 5)
    return found
