"""Every measure of one whole run against its subject's truth, as one row of a table.

    python -m tools.bench.whole_run SUBJECT RUN [--json FILE]

SUBJECT: a folder with gt/; RUN: a run's folder with work/ and export/.
Rotations are compared after one common turn of the head, so that the mesh does not enter: those of track_landmarks
(tracked_...) and the final ones, which inverse_render may have tracked again. `covered`: share of frames whose error
lies within the 90 % region of the reported covariance. acceleration_deg: mean second difference of the error, how much
the head trembles. detail: energy of the gradient of the frames' mean texture on the final mesh, in the finest detail,
under the final poses; tracked_detail: under those of track_landmarks. All else is tools.score's: the albedo on all face
skin and where the result is confident, re-renders as the result has them, and relit pictures, which
tools/bench/chart/scores.py makes. shadow_residual: share of the squared re-render error within 3 mm of cast shadows'
edges, which are shadow_pixels of the face.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shared.contract.declare import folder_of
from shared.contract.manifest import PROVENANCE
from shared.contract.pipeline import load_pipeline
from shared.errors import InputError
from shared.geometry.surface import Surface
from shared.geometry.transforms import nearest_rotation, rigid
from shared.inverse.clip_inputs import read_inputs
from shared.inverse.pose_rounds import FINE
from shared.io.arrays import load_arrays, read_json, write_json
from shared.io.meshes import load_mesh
from shared.tracking.first_poses import UNTRACKED_SEGMENTS
from shared.tracking.texture_tracking import AtlasTracker
from shared.tracking.texture_tracks import MeanContrast
from tools.bench.chart.runs import SHOWN, fingerprints
from tools.bench.chart.scores import relit_shots, render_shots
from tools.bench.runner import plain, shown_value
from tools.relight.inputs import open_asset
from tools.scoring.align import Similarity
from tools.scoring.rotations import final_poses, rotation_errors
from tools.scoring.score import score
from tools.scoring.shadows import shadow_edge_residual

COLUMNS = (
    "frames", "rotation_mean_deg", "rotation_max_deg", "covered", "acceleration_deg", "tracked_rotation_mean_deg",
    "tracked_rotation_max_deg", "tracked_covered", "tracked_acceleration_deg", "detail", "tracked_detail",
    "pose_rounds", "poses_kept", "albedo_db", "albedo_de", "albedo_raw_de", "confident_share", "confident_de_p99",
    "confident_within_8", "rerender_db", "relit_db", "lobe25", "geometry_median_mm", "normal_median_deg",
    "shadow_residual", "shadow_pixels", "rerendered", "solve_wall_s", "solve_cpu_s", "wall_s", "cpu_s", "peak_mb",
    "warnings",
)  # fmt: skip
"""lobe25: relative error of the light through a lobe of 25 degrees. rerendered: frames that hold truth and were
re-rendered. solve_: of inverse_render; the others of all stages."""
LEAST_SEEN = 3.0
"""Frames, by their weights, from which on a texel's mean is one."""


def row_of(subject: Path, run: Path) -> dict[str, object]:
    """All of COLUMNS. InputError where the subject lacks truth or the run a stage."""
    if not (subject / "gt").is_dir():
        raise InputError("no ground truth", where=str(subject), expected="a gt/ folder", hint="see tools/synthesize.py")
    costs = cost_row(run)
    return {**pose_row(subject, run), **detail_row(run), **scored_row(subject, run / "export"), **costs}


def cost_row(run: Path) -> dict[str, object]:
    """What the stages took, and what they warn of. InputError where one has not run."""
    records = {}
    for stage in load_pipeline(None).stages:
        path = run / folder_of(stage) / PROVENANCE
        if not path.is_file():
            raise InputError("a stage has not run", where=str(path), expected="a run from the clip to the export")
        records[stage] = read_json(path)
    solve, every = records["inverse_render"], records.values()
    return {
        "solve_wall_s": solve["wall_s"],
        "solve_cpu_s": solve["cpu_s"],
        "wall_s": sum(record["wall_s"] for record in every),
        "cpu_s": sum(record["cpu_s"] for record in every),
        "peak_mb": max(record["peak_memory_mb"] for record in every),
        "warnings": "; ".join(dict.fromkeys(text for record in every for text in record["warnings"])),
    }


def code_of(run: Path, scored_by: Sequence[str]) -> dict[str, str]:
    """{file of the repository: fingerprint} of what made the run, and of scored_by as they are now, which made its row.
    """
    made: dict[str, str] = {}
    for stage in load_pipeline(None).stages:
        code = read_json(run / folder_of(stage) / PROVENANCE)["code"]
        made |= {file: digest[:SHOWN] for file, digest in code.items()}
    return dict(sorted((made | fingerprints(scored_by)).items()))


def pose_row(subject: Path, run: Path) -> dict[str, object]:
    """Errors of the final poses and of those of track_landmarks, and whether inverse_render tracked again."""
    true = load_arrays(subject / "gt" / "poses.npz")["camera_from_head"]
    tracked, solved = run / "work" / "track_landmarks", run / "work" / "inverse_render"
    final = final_poses(tracked, solved)
    repeated = read_json(solved / "solve.json").get("poses") or {}
    before = rotation_errors(load_arrays(tracked / "poses.npz"), true)
    return {
        "frames": len(final["frame_index"]),
        **rotation_errors(final, true),
        **{f"tracked_{name}": value for name, value in before.items()},
        "pose_rounds": len(repeated.get("rounds_deg", ())),
        "poses_kept": bool(repeated.get("kept", False)),
    }


def detail_row(run: Path) -> dict[str, float]:
    """How sharp the mean texture of all frames is on the final mesh, under the final poses and under the tracked ones,
    which are first brought to the final head frame."""
    sampled, tracked, solved = (run / "work" / stage for stage in ("sample_frames", "track_landmarks",
                                                                   "inverse_render"))  # fmt: skip
    inputs, path = read_inputs(sampled, tracked), solved / "mesh.npz"
    final, segment = load_arrays(solved / "poses.npz")["camera_from_head"], load_arrays(path).get("face_segment")
    if inputs.tracked is None or segment is None:
        raise InputError("poses or mesh were given, not tracked", where=str(solved), expected="what was tracked")
    surface = Surface(load_mesh(path), segment, inputs.surface.segment_names)
    clip, depth = inputs.tracked.look(), float(np.median(final[:, 2, 3]))
    tracker = AtlasTracker(clip, surface.mesh, ~surface.faces_of(UNTRACKED_SEGMENTS), depth, FINE)
    both = final, in_head_frame_of(inputs.views.camera_from_head, final)
    textures = [tracker.mean(np.arange(clip.count), poses, lambda items, label: items) for poses in both]
    energies = gradient_energies(textures)
    return {"detail": energies[0], "tracked_detail": energies[1]}


def in_head_frame_of(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    """poses [F, 4, 4] after the one rigid motion of the head that brings them nearest to others [F, 4, 4]."""
    turn = nearest_rotation(np.einsum("fji,fjk->ik", poses[:, :3, :3], others[:, :3, :3]))
    shift = np.einsum("fji,fj->fi", poses[:, :3, :3], others[:, :3, 3] - poses[:, :3, 3]).mean(0)
    return poses @ rigid(turn, shift)


def gradient_energies(textures: list[MeanContrast]) -> list[float]:
    """Mean squared gradient of textures [h, w] of one layout, code values squared, where all are known with their
    neighbours."""
    known = np.all([texture.seen >= LEAST_SEEN for texture in textures], axis=0)
    inner = np.zeros_like(known)
    inner[1:-1, 1:-1] = (known[1:-1, 1:-1] & known[:-2, 1:-1] & known[2:, 1:-1] & known[1:-1, :-2] & known[1:-1, 2:])
    return [float(sum((part[inner].astype(np.float64) ** 2).mean() for part in texture.gradient))
            for texture in textures]  # fmt: skip


def scored_row(subject: Path, export: Path) -> dict[str, object]:
    """Albedo, pictures, light and shape by tools.score, the relit pictures made here; where re-renders err."""
    asset = open_asset(export, (0.5,) * 3, 0.0, 0.5)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for name in ("mesh.obj", "maps", "poses.npz", "envmap.exr", "renders"):
            os.symlink((export / name).resolve(), folder / name)

        def relight(alignment: Similarity) -> None:
            render_shots(asset, relit_shots(subject, alignment), folder)

        scores = score(subject, folder, prepare=relight)
    albedo, edges = scores["albedo"], shadow_edge_residual(subject, export)
    confident = albedo.get("confident", {})
    return {
        "albedo_db": albedo["aligned"]["psnr_linear"],
        "albedo_de": albedo["aligned"]["delta_e2000_median"],
        "albedo_raw_de": albedo["raw"]["delta_e2000_median"],
        "confident_share": confident.get("share"),
        "confident_de_p99": confident.get("delta_e2000_p99"),
        "confident_within_8": confident.get("acceptable"),
        "rerender_db": scores.get("rerender", {}).get("psnr"),
        "relit_db": scores.get("relight", {}).get("mean", {}).get("psnr_gain"),
        "lobe25": scores["envmap"]["lobe25_rel_rmse"],
        "geometry_median_mm": scores["geometry_mm"]["median"],
        "normal_median_deg": scores["normal_deg"]["median"],
        "shadow_residual": edges["residual"],
        "shadow_pixels": edges["pixels"],
        "rerendered": edges["frames"],
    }


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0, or 2 when the input is at fault."""
    as_written = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tools.bench.whole_run", description=__doc__, formatter_class=as_written)
    parser.add_argument("subject", type=Path, help="folder with gt/")
    parser.add_argument("run", type=Path, help="the run's folder, with work/ and export/")
    parser.add_argument("--json", type=Path, help="write the row to this file as well")
    options = parser.parse_args(arguments)
    try:
        row = plain(row_of(options.subject, options.run))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for name in COLUMNS:
        print(f"{name:26s} {shown_value(row[name])}")
    if options.json:
        write_json(options.json, row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
