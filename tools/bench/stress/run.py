"""Runs Limn on the subject of a stress case and scores what comes out, in one process.

Limn runs as `limn run` would, with small settings, up to the maps; packing them into USD takes longer than all the rest
at this size and adds nothing to be scored. Gates and warnings are those that an operator sees.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from shared.contract import main as run_stage
from shared.contract.folders import RunFolder
from shared.contract.manifest import read_record
from shared.contract.pipeline import Pipeline
from shared.inverse.clip_inputs import read_inputs
from shared.io.arrays import load_arrays
from shared.io.export_maps import read_map
from shared.io.meshes import load_mesh, write_obj
from tools.cli.gates import Flag
from tools.cli.measures import MEASURES
from tools.scoring.appearance_errors import map_errors
from tools.scoring.rotations import final_poses, rotation_errors
from tools.scoring.score import score

SETTINGS = {
    "sample_frames": {},
    "track_landmarks": {"start_frames": 24, "references": 1, "flow_tracks": 600, "tracks": 1000, "texel_px": 1.5},
    "init_albedo": {"size": 256, "frames": 12},
    "inverse_render": {"map_size": 256, "light_resolution": 8, "points": 1200, "directions": 512, "bounce_nodes": 300,
                       "light_frames": 24, "render_count": 1, "shape": False, "local_roughness": False},
}
"""Near the preset draft, for pictures of 224 px."""


def run_case(subject: Path, out: Path, pipeline: Pipeline) -> dict:
    """{"exit", "message", "seconds", "scores", "warnings", "gates", "missed_gates"} of one subject.

    Stages whose results in out are current are not run again; seconds are those that they took when they were.
    """
    run, done = RunFolder.of(subject, subject.name, out), []
    for stage in SETTINGS:
        code, message = _run_stage(stage, subject, out)
        if code:
            named = message.replace(str(subject), "the subject")
            records = provenances(run, done)
            return {"exit": code, "message": named, "seconds": sum(record["wall_s"] for record in records),
                    "scores": {}, "warnings": warnings_of(records), "gates": {}, "missed_gates": []}
        done.append(stage)
    records = provenances(run, done)
    export_maps(run)
    gates = {name: MEASURES[name](run) for name in pipeline.gates}
    missed = [str(Flag(name, value, pipeline.gates[name].limit)) for name, value in gates.items()
              if value is not None and not pipeline.gates[name].holds(value)]
    seconds = sum(record["wall_s"] for record in records)
    return {"exit": 0, "message": "", "seconds": seconds, "scores": scores_of(subject, run),
            "warnings": warnings_of(records), "gates": gates, "missed_gates": missed,
            "diagnostics": (read_record(run.published("inverse_render") / "solve.json") or {}).get("diagnostics", {})}


def _run_stage(name: str, subject: Path, out: Path) -> tuple[int, str]:
    """Exit code and the last line of one stage."""
    module = importlib.import_module(f"stages.{name}")
    values = [f"{key}={str(value).lower()}" for key, value in SETTINGS[name].items()]
    arguments = ["--subject", str(subject), "--out", str(out), *(part for value in values for part in ("--set", value))]
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = run_stage(module.STAGE, module.run, module.check, arguments)
    lines = said.getvalue().strip().splitlines() or [""]
    if code == 1 and lines[-1].endswith("interrupted"):
        raise KeyboardInterrupt
    return code, lines[-1]


def export_maps(run: RunFolder) -> None:
    """export/ as tools.score and the gates read it: mesh, poses, light and maps."""
    solved, export = run.published("inverse_render"), run.root / "export"
    shutil.rmtree(export, ignore_errors=True)
    export.mkdir()
    shutil.copytree(solved / "maps", export / "maps")
    for name in ("envmap.exr", "poses.npz"):
        shutil.copy(solved / name, export / name)
    write_obj(export / "mesh.obj", load_mesh(solved / "mesh.npz"))


def provenances(run: RunFolder, stages: Iterable[str]) -> list[dict]:
    """provenance.json of finished stages."""
    return [read_record(run.published(stage) / "provenance.json") for stage in stages]


def warnings_of(records: Iterable[dict]) -> list[str]:
    """What the stages of these provenances warn of, each text once."""
    return list(dict.fromkeys(text for record in records for text in record["warnings"]))


def scores_of(subject: Path, run: RunFolder) -> dict[str, float]:
    """The scores of verdict.LIMITS, those of confident texels, and some that are shown only."""
    export = run.root / "export"
    found = score(subject, export)
    inputs = read_inputs(run.published("sample_frames"), run.published("track_landmarks"))
    maps = {path.stem: read_map(path, path.stem) for path in (export / "maps").glob("*.exr")}
    mesh = load_mesh(run.published("inverse_render") / "mesh.npz")
    poses = final_poses(run.published("track_landmarks"), run.published("inverse_render"))
    errors = map_errors(subject, inputs, inputs.frame_index, mesh, maps)
    return {
        "albedo": errors["delta_e2000_median"],
        "albedo_p90": errors["delta_e2000_p90"],
        "confident_albedo": errors["confident_delta_e2000_median"],
        "confident_albedo_p90": errors["confident_delta_e2000_p90"],
        "confident_share": errors["confident_share"],
        "normals": found["normal_deg"]["median"],
        "geometry": found["geometry_mm"]["median"],
        "rotation": found["pose_own_alignment"]["rotation_deg"]["mean"],
        "light": found["envmap"]["lobe25_front_rel_rmse"],
        "specular_bias": found["specular"]["mean_result"] - found["specular"]["mean_gt"],
        "roughness_bias": found["roughness"]["mean_result"] - found["roughness"]["mean_gt"],
        "covered": rotation_errors(poses, load_arrays(subject / "gt" / "poses.npz")["camera_from_head"])["covered"],
        "log_scale": float(-np.log(np.mean(found["albedo"]["gain"]))),
    }
