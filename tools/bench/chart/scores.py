"""All scores of one result of tools/bench/chart/bench.py, as {dotted name: number}.

What tools.score compares beside maps, mesh, poses and light are pictures: re-renders of the clip's frames and of the
head under lights that it did not see. Here one renderer makes them for all results, with visibility and bounces,
whatever model was solved: the maps are judged, not the solver's own renderer.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from shared.io.arrays import load_arrays
from shared.io.images import read_exr, read_png, write_exr
from shared.io.meshes import write_obj
from shared.rendering.precomputed_transfer import Sizes
from shared.rendering.views import HeadViews, ViewCamera
from tools.relight.inputs import Asset, open_asset
from tools.scoring.align import Similarity, result_poses
from tools.scoring.score import camera_intrinsics, score

SIZES = Sizes(directions=512, nodes=400)
SCORED_FRAMES, RENDERED_FRAMES = 12, 3
RELIT_VIEW = "front"
REACH_PX = 6
"""How far beside the face skin vertices are shaded as well."""
CODE = ("tools/bench/chart/scores.py", "tools/scoring/score.py", "tools/scoring/align.py", "tools/scoring/measures.py",
        "tools/scoring/buffers.py")  # fmt: skip
"""What the numbers depend on beside the result."""


@dataclass(frozen=True)
class ScoredShot:
    """A picture to make: its file below the result, camera, light [H, 2 H, 3], what moves against it, and where the
    truth has face skin [h, w]."""

    file: str
    camera: ViewCamera
    light: np.ndarray
    moves: str
    skin: np.ndarray


def scores_of(subject: Path, result: Path) -> dict[str, float]:
    """result: a folder with maps/, poses.npz, envmap.exr, solve.json, and mesh.npz or mesh.obj."""
    asset = open_asset(result, (0.5,) * 3, 0.0, 0.5)
    with tempfile.TemporaryDirectory() as folder:
        export = Path(folder)
        write_obj(export / "mesh.obj", asset.mesh)
        for name in ("maps", "poses.npz", "envmap.exr"):
            os.symlink((result / name).resolve(), export / name)

        def make_pictures(alignment: Similarity) -> None:
            render_shots(asset, [*clip_shots(subject, asset), *relit_shots(subject, alignment)], export)

        return flat(score(subject, export, SCORED_FRAMES, prepare=make_pictures))


def clip_shots(subject: Path, asset: Asset) -> list[ScoredShot]:
    """Some of the frames that hold truth, through the result's lens, under its light."""
    place = {int(frame): k for k, frame in enumerate(asset.frame_index)}
    known = [int(frame) for frame in load_arrays(subject / "gt" / "poses.npz")["gt_frames"] if int(frame) in place]
    chosen = np.unique(np.linspace(0, len(known) - 1, RENDERED_FRAMES).astype(int))
    shots = []
    for frame in (known[k] for k in chosen):
        skin = read_png(subject / "gt" / "frames" / f"{frame:04d}_mask.png") > 127
        camera = ViewCamera(asset.poses[place[frame]], asset.intrinsics, skin.shape[::-1])
        shots.append(ScoredShot(f"renders/{frame:04d}.exr", camera, asset.envmap, asset.moves, skin))
    return shots


def relit_shots(subject: Path, alignment: Similarity) -> list[ScoredShot]:
    """The front view of relight/ under each of its lights, in the result's head space."""
    shots = []
    for path in sorted((subject / "relight").glob("*_envmap.exr")):
        name = f"{path.name.removesuffix('_envmap.exr')}_{RELIT_VIEW}"
        pose = load_arrays(subject / "relight" / "poses.npz")[RELIT_VIEW]
        skin = read_png(subject / "relight" / f"{name}_mask.png") > 127
        camera = ViewCamera(result_poses(pose[None], alignment)[0], camera_intrinsics(subject), skin.shape[::-1])
        shots.append(ScoredShot(f"relit/{name}.exr", camera, read_exr(path).astype(np.float64), "head", skin))
    return shots


def render_shots(asset: Asset, shots: list[ScoredShot], export: Path) -> None:
    """Writes the pictures; only what shows in face skin is shaded with care."""
    near = [_projects_into(asset.mesh.vertices, shot) for shot in shots]
    views = HeadViews(asset.mesh, asset.maps, SIZES, [shot.camera for shot in shots], only=np.any(near, axis=0),
                      head_faces=asset.head_faces)
    for shot in shots:
        picture = views.render(shot.light, [shot.camera], shot.moves, fade=False)[0]
        path = export / shot.file
        path.parent.mkdir(exist_ok=True)
        write_exr(path, picture.astype(np.float32), colour_space="lin_rec709_scene")


def _projects_into(points: np.ndarray, shot: ScoredShot) -> np.ndarray:
    """[N] whether points [N, 3] land in the skin of a shot or within REACH_PX of it."""
    reach = np.ones((2 * REACH_PX + 1,) * 2, np.uint8)
    skin = cv2.dilate(shot.skin.astype(np.uint8), reach) > 0
    pose = shot.camera.camera_from_head
    seen = (points @ pose[:3, :3].T + pose[:3, 3]) @ shot.camera.intrinsics.T
    column, row = np.floor(seen[:, :2] / seen[:, 2:]).astype(int).T
    inside = (column >= 0) & (column < skin.shape[1]) & (row >= 0) & (row < skin.shape[0])
    found = np.zeros(len(points), bool)
    found[inside] = skin[row[inside], column[inside]]
    return found


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
