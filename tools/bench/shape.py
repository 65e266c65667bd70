"""Measures the refined shape against a subject's truth, for several lambda of the large steps.

    python -m tools.bench shape SUBJECT RUN --out DIR [--smoothness 1 5 19 50 200] [--set key=value]
    python -m tools.bench shape SUBJECT RUN --out DIR --only exported

SUBJECT: a folder with gt/; RUN: a run's folder whose work/ holds sample_frames and track_landmarks. The first row is
the tracked mesh, unrefined. distance: of the true face to the surface after a similarity. normals: where frames see the
face, of the mesh alone, without its normal map. stopped: vertices that moved less than wanted, since the surface would
have cut itself. cuts: edges that pass through a face.
exported: the mesh of RUN/export; DIR/profile.png then has truth and mesh in profile, the outlines (truth black, tracked
mesh blue, exported mesh red), and both from three quarters.
"""

from __future__ import annotations

import argparse
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
from tools.bench.clips import ClipBench, settings_of
from tools.bench.runner import Clock, Entry
from tools.scoring.score import ScoredResult, camera_intrinsics, score_appearance, score_geometry, scored_frames

SMOOTHNESS = (1.0, 5.0, 19.0, 50.0, 200.0)
COLUMNS = ("smoothness", "distance_median_mm", "distance_p95_mm", "normal_median_deg", "normal_p95_deg", "stopped",
           "cuts", "held_out_residual", "seconds")
PROFILE_MM = 140.0
TRACKED, EXPORTED = "tracked", "exported"


def shape_errors(subject: Path, clip: ClipInputs, mesh: Mesh) -> dict[str, float]:
    """Distances in mm and angles in degrees of a mesh in the clip's head space to the true face."""
    gt_frames = load_arrays(subject / "gt" / "poses.npz")["gt_frames"]
    alignment, distance = _aligned(subject, clip, mesh)
    poses = dict(zip(clip.frame_index.tolist(), clip.views.camera_from_head, strict=True))
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
    alignment, scores = score_geometry(subject, mesh, poses, clip.views.camera_from_head, rng)
    return alignment, scores["geometry_mm"]


def profile_picture(subject: Path, clip: ClipInputs, mesh: Mesh, size: int = 480) -> np.ndarray:
    """uint8 [size, 5 size, 3]: truth and mesh in profile, the outlines, truth and mesh from three quarters."""
    truth = read_obj(subject / "gt" / "mesh.obj")
    alignment, _ = _aligned(subject, clip, mesh)
    tracked, placed = (own.replace(vertices=alignment.points(own.vertices)) for own in (clip.surface.mesh, mesh))
    tip = truth.vertices[np.argmax(truth.vertices[:, 2])]
    view = tip - [0.0, 5.0, 25.0], PROFILE_MM, size
    drawn = [shaded_picture(own, np.radians(yaw), *view) for yaw in (-90.0, -40.0) for own in (truth, placed)]
    camera = turned_camera(np.radians(-90.0), *view)
    outlines = np.full_like(drawn[0], 255)
    for own, ink in ((tracked, (60, 140, 255)), (truth, (0, 0, 0)), (placed, (255, 0, 0))):
        covered = camera_hits(RayScene(own.vertices, own.faces), *camera, size, size)[0] >= 0
        outlines[cv2.morphologyEx(covered.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0] = ink
    return np.concatenate([*drawn[:2], outlines, *drawn[2:]], axis=1)


class ShapeBench(ClipBench):
    """The tracked mesh, the mesh refined with each lambda, and the run's export."""

    name, columns, always_tracked = "shape", COLUMNS, True

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        super().add_arguments(parser)
        parser.add_argument("--smoothness", nargs="*", type=float, default=SMOOTHNESS, metavar="LAMBDA")

    def cases(self) -> dict[str, float | None]:
        return {TRACKED: None} | {f"{value:g}": value for value in self.options.smoothness} | {EXPORTED: None}

    @property
    def default(self) -> list[str]:
        """All but the export."""
        return list(self.cases())[:-1]

    def measure(self, case: float | None, entry: Entry) -> None:
        subject, clip = self.options.subject, self.clip
        if entry.name == TRACKED:
            entry.add({"smoothness": entry.name, **shape_errors(subject, clip, clip.surface.mesh)})
        elif entry.name == EXPORTED:
            mesh = read_obj(self.options.run / "export" / "mesh.obj")
            entry.add({"smoothness": entry.name, **shape_errors(subject, clip, mesh)})
            write_png(self.options.out / "profile.png", profile_picture(subject, clip, mesh))
        else:
            entry.add(self.refined(case))

    def refined(self, smoothness: float) -> dict[str, float]:
        """A row of the table: the clip solved with that lambda, maps as small as they can be."""
        small = {"model": "full", "map_size": 64, "normal_map": False}
        settings, clock = settings_of({**small, **self.given, "shape_smoothness": smoothness}), Clock()
        result = solve_clip(self.clip.views, self.clip.surface, settings)
        found = {"smoothness": smoothness, "seconds": clock.wall_s, "held_out_residual": result.solution.held_out,
                 "stopped": result.record["shape"]["stopped_vertices"]}
        return found | shape_errors(self.options.subject, self.clip, result.texels.viewer.mesh)
