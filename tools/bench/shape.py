"""Measures the refined shape against a subject's truth, for several lambda of the large steps.

    python -m tools.bench.shape SUBJECT RUN [--smoothness 1 5 19 50 200] [--set key=value] [--out shape.csv]
    python -m tools.bench.shape SUBJECT RUN --picture profile.png
        the exported mesh beside the truth in profile and from three quarters, and the outlines: truth black, tracked
        mesh blue, exported mesh red

SUBJECT: a folder with gt/; RUN: a run's folder whose work/ holds sample_frames and track_landmarks. The first row is
the tracked mesh, unrefined. distance: of the true face to the surface after a similarity. normals: where frames see the
face, of the mesh alone, without its normal map. stopped: vertices that moved less than wanted, since the surface would
have cut itself. cuts: edges that pass through a face.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

import cv2
import numpy as np

from shared.geometry.intersections import crossing_edges
from shared.geometry.mesh import Mesh
from shared.geometry.raycast import RayScene, camera_hits
from shared.geometry.transforms import Similarity
from shared.inverse.clip_inputs import ClipInputs
from shared.inverse.solve import solve_clip
from shared.io.arrays import load_arrays
from shared.io.images import write_png
from shared.io.meshes import read_obj
from shared.report.shape_pictures import shaded_picture, turned_camera
from tools.bench.appearance import open_clip, settings_of, silent
from tools.scoring.score import ScoredResult, camera_intrinsics, score_appearance, score_geometry, scored_frames

SMOOTHNESS = (1.0, 5.0, 19.0, 50.0, 200.0)
COLUMNS = ("smoothness", "distance_median_mm", "distance_p95_mm", "normal_median_deg", "normal_p95_deg", "stopped",
           "cuts", "held_out_residual", "seconds")
PROFILE_MM = 140.0


def shape_errors(subject: Path, clip: ClipInputs, mesh: Mesh) -> dict[str, float]:
    """Distances in mm and angles in degrees of a mesh in the clip's head space to the true face."""
    gt_frames = load_arrays(subject / "gt" / "poses.npz")["gt_frames"]
    alignment, distance = _aligned(subject, clip, mesh)
    poses = dict(zip(clip.frame_index.tolist(), clip.camera_from_head, strict=True))
    result = ScoredResult(subject, mesh, {}, poses, camera_intrinsics(subject))
    rng = np.random.default_rng(0)
    normals = score_appearance(subject, result, scored_frames(gt_frames, result), alignment.rotation, rng)["normal_deg"]
    return {
        "distance_median_mm": distance["median"],
        "distance_p95_mm": distance["p95"],
        "normal_median_deg": normals["median"],
        "normal_p95_deg": normals["p95"],
        "cuts": len(crossing_edges(mesh.vertices, mesh.faces)),
    }


def _aligned(subject: Path, clip: ClipInputs, mesh: Mesh) -> tuple[Similarity, dict]:
    """truth_from_head of the mesh, and a summary of its distances in mm."""
    poses = load_arrays(subject / "gt" / "poses.npz")["camera_from_head"][clip.frame_index]
    rng = np.random.default_rng(0)
    alignment, scores = score_geometry(subject, mesh, poses, clip.camera_from_head, rng)
    return alignment, scores["geometry_mm"]


def profile_picture(subject: Path, clip: ClipInputs, mesh: Mesh, size: int = 480) -> np.ndarray:
    """uint8 [size, 5 size, 3]: truth and mesh in profile, the outlines, truth and mesh from three quarters."""
    truth = read_obj(subject / "gt" / "mesh.obj")
    alignment, _ = _aligned(subject, clip, mesh)
    tracked, placed = (own.replace(vertices=alignment.points(own.vertices)) for own in (clip.mesh, mesh))
    tip = truth.vertices[np.argmax(truth.vertices[:, 2])]
    view = tip - [0.0, 5.0, 25.0], PROFILE_MM, size
    drawn = [shaded_picture(own, np.radians(yaw), *view) for yaw in (-90.0, -40.0) for own in (truth, placed)]
    camera = turned_camera(np.radians(-90.0), *view)
    outlines = np.full_like(drawn[0], 255)
    for own, ink in ((tracked, (60, 140, 255)), (truth, (0, 0, 0)), (placed, (255, 0, 0))):
        covered = camera_hits(RayScene(own.vertices, own.faces), *camera, size, size)[0] >= 0
        outlines[cv2.morphologyEx(covered.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0] = ink
    return np.concatenate([*drawn[:2], outlines, *drawn[2:]], axis=1)


def refined(subject: Path, clip: ClipInputs, smoothness: float, given: dict) -> dict:
    """A row of the table: the clip solved with that lambda, maps as small as they can be."""
    settings = settings_of({"map_size": 64, "normal_map": False, **given, "shape_smoothness": smoothness})
    begun = time.perf_counter()
    result = solve_clip(clip, settings, silent, lambda text: None)
    seconds = time.perf_counter() - begun
    stopped, residual = result.record["shape"]["stopped_vertices"], result.solution.held_out
    return {"smoothness": smoothness, **shape_errors(subject, clip, result.viewer.mesh), "stopped": stopped,
            "held_out_residual": residual, "seconds": seconds}


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("subject", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--smoothness", nargs="*", type=float, default=SMOOTHNESS, metavar="LAMBDA")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="parameters for every row")
    parser.add_argument("--out", type=Path, help="the table as CSV")
    parser.add_argument("--picture", type=Path, help="the run's export beside the truth, instead of the table")
    options = parser.parse_args(arguments)
    if options.picture:
        clip, mesh = open_clip(options.subject, options.run, True)[0], read_obj(options.run / "export" / "mesh.obj")
        write_png(options.picture, profile_picture(options.subject, clip, mesh))
        return 0
    clip, given = open_clip(options.subject, options.run, True)[0], dict(text.split("=", 1) for text in options.set)
    rows = [{"smoothness": "tracked", **shape_errors(options.subject, clip, clip.mesh)}]
    print(" ".join(f"{name:>19s}" for name in COLUMNS))
    _show(rows[0])
    for smoothness in options.smoothness:
        rows.append(refined(options.subject, clip, smoothness, given))
        _show(rows[-1])
    if options.out:
        with options.out.open("w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, COLUMNS, restval="")
            table.writeheader()
            table.writerows(rows)
    return 0


def _show(row: dict) -> None:
    cells = (row.get(name, "") for name in COLUMNS)
    print(" ".join(f"{cell:19.4f}" if isinstance(cell, float) else f"{cell!s:>19s}" for cell in cells), flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
