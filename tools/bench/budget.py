"""The least that the data demand of each phase of a stage: bytes, rays and float products over this machine's limits.

All counts come from what a run has left: its manifests, frames.json, solve.json and meshes. They are lower bounds: each
byte once in and once out, each ray once, each product once per step that was taken. A phase without a count (imports,
the workflow, networks whose products nobody states) has none: data do not demand it, or we cannot tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from shared.contract.declare import folder_of
from shared.contract.manifest import read_manifest
from shared.errors import InputError
from shared.io.arrays import load_arrays, read_json
from tools.bench.machine_limits import MachineLimits

FLOAT, CODE, CHANNELS = 4, 1, 3
LOBE_BYTES = 2
"""Bytes of a single-precision number, a code value, channels, bytes of a lobe's weight."""


@dataclass(frozen=True)
class Least:
    """What a phase has to do at least. memory, disk_in, disk_out in bytes; why: what was counted, in words."""

    memory: float = 0.0
    flops: float = 0.0
    rays: float = 0.0
    disk_in: float = 0.0
    disk_out: float = 0.0
    why: str = ""

    def seconds(self, limits: MachineLimits) -> float:
        """On all cores; memory, products, rays and disk at the same time, so that the slowest counts."""
        return max(
            1e-9 * self.memory / limits.memory_gb_s,
            1e-9 * self.flops / limits.gflops,
            self.rays / (limits.rays_per_core_s * limits.cores),
            1e-6 * self.disk_in / limits.disk_read_mb_s,
            1e-6 * self.disk_out / limits.disk_write_mb_s,
        )


@dataclass(frozen=True)
class RunCounts:
    """A finished run's sizes. frames: kept; crop: pixels of a crop; parameters: {stage: its parameters}; written:
    {stage: bytes}; solve: solve.json; vertices: of the refined mesh; model_size: coefficients of the head model;
    pictures: {file: pixels} of the export."""

    clip_bytes: int
    source_frames: int
    source_pixels: int
    frames: int
    crop: int
    parameters: Mapping[str, Mapping]
    written: Mapping[str, int]
    solve: Mapping
    vertices: int
    tracked_vertices: int
    model_size: int
    pictures: Mapping[str, int]


def count_run(root: Path, clip_bytes: int) -> RunCounts:
    """Counts of the run in root (it holds work/ and export/). InputError where a stage has not run."""
    names = ("sample_frames", "track_landmarks", "init_albedo", "inverse_render", "export_usd")
    folders = {name: root / folder_of(name) for name in names}
    manifests = {name: read_manifest(folder) for name, folder in folders.items()}
    if missing := [name for name, manifest in manifests.items() if manifest is None]:
        raise InputError("has not run", where=str(root), got=", ".join(missing), expected="all stages")
    record = read_json(folders["sample_frames"] / "frames.json")
    tracking = read_json(folders["track_landmarks"] / "tracking.json")
    source, outputs = record["source"], manifests["export_usd"]["outputs"]
    pixels = {name: entry["shape"][0] * entry["shape"][1] for name, entry in outputs.items()
              if entry.get("kind") == "image"}  # fmt: skip
    return RunCounts(
        clip_bytes=clip_bytes,
        source_frames=source["frame_count"],
        source_pixels=source["width"] * source["height"],
        frames=len(record["frames"]),
        crop=record["size"][0] * record["size"][1],
        parameters={name: manifest["parameters"] for name, manifest in manifests.items()},
        written={name: sum(entry["bytes"] for entry in manifest["outputs"].values() if "bytes" in entry)
                 for name, manifest in manifests.items()},
        solve=read_json(folders["inverse_render"] / "solve.json"),
        vertices=len(load_arrays(folders["inverse_render"] / "mesh.npz")["vertices"]),
        tracked_vertices=len(load_arrays(folders["track_landmarks"] / "mesh.npz")["vertices"]),
        model_size=len(tracking["identity"]) + len(tracking["expression"]),
        pictures=pixels,
    )  # fmt: skip


def budget(run: RunCounts) -> dict[str, dict[str, Least]]:
    """{stage: {phase: least}}."""
    return {
        "sample_frames": _sampling(run),
        "track_landmarks": _tracking(run),
        "init_albedo": _mean_texture(run),
        "inverse_render": _inverse(run),
        "export_usd": _export(run),
    }


def _encoding(run: RunCounts, stage: str) -> Least:
    return Least(disk_out=run.written[stage], why="the stage's outputs onto the disk")


def _reading(run: RunCounts, frames: int, *stages: str) -> Least:
    """Crops as decoded, once through memory; the files from disk."""
    share = min(1.0, frames / run.frames)
    files = share * run.written["sample_frames"] + sum(run.written[stage] for stage in stages)
    return Least(memory=frames * run.crop * CHANNELS * CODE, disk_in=files, why=f"{frames} crops and the stages' files")


def _sampling(run: RunCounts) -> dict[str, Least]:
    shown, kept = run.source_frames * run.source_pixels * CHANNELS, run.frames * run.crop * CHANNELS
    return {
        "decode": Least(memory=shown, disk_in=run.clip_bytes, why=f"{run.source_frames} source frames written once"),
        "frame quality and survey": Least(memory=shown, why="each source frame read once"),
        "crops": Least(memory=2 * kept, why=f"{run.frames} crops read and written"),
        "encoding": _encoding(run, "sample_frames"),
    }


def _tracking(run: RunCounts) -> dict[str, Least]:
    own = run.parameters["track_landmarks"]
    picture, tracks, unknowns = run.crop * CHANNELS * CODE, own["tracks"], 9
    return {
        "reading pictures": _reading(run, run.frames),
        "dense tracks": Least(memory=run.frames * own["references"] * picture,
                              why=f"each frame read for each of {own['references']} references"),
        "texture tracks": Least(memory=run.frames * picture * own["fine_passes"],
                                why=f"each frame read in each of {own['fine_passes']} passes"),
        "bundle": Least(flops=2 * run.frames * tracks * 2 * unknowns**2,
                        why=f"normal equations of {tracks} tracks in all frames, once"),
        "head fit": Least(flops=2 * 3 * run.tracked_vertices * run.model_size**2,
                          why=f"normal equations of {run.model_size} coefficients, once"),
        "encoding": _encoding(run, "track_landmarks"),
    }  # fmt: skip


def _mean_texture(run: RunCounts) -> dict[str, Least]:
    own = run.parameters["init_albedo"]
    frames = min(run.frames, own["frames"]) if own["frames"] else run.frames
    texels = own["size"] ** 2
    return {
        "reading pictures": _reading(run, frames, "track_landmarks"),
        "sampling of pictures": Least(memory=frames * texels * CHANNELS * FLOAT,
                                      why=f"{texels} texels in {frames} frames"),
        "encoding": _encoding(run, "init_albedo"),
    }  # fmt: skip


def _inverse(run: RunCounts) -> dict[str, Least]:
    own, solve = run.parameters["inverse_render"], run.solve
    directions, points, steps = own["directions"], own["points"], max(1, len(solve.get("iterations", ())))
    frames = min(run.frames, own["light_frames"] or run.frames)
    entries = points * frames * directions
    texels = solve["seen_share_of_texels"] * own["map_size"] ** 2
    seen = run.frames * texels * CHANNELS * FLOAT
    traced = points + own["bounce_nodes"] + run.vertices
    found = {
        "reading pictures": _reading(run, run.frames, "track_landmarks", "init_albedo"),
        "sampling of pictures": Least(memory=seen, why=f"{texels:.0f} seen texels in {run.frames} frames"),
        "rays": Least(rays=traced * directions / 2, why=f"half of {directions} directions from {traced} points, once"),
        "tables of lobes": Least(memory=entries * LOBE_BYTES,
                                 why=f"a weight for {points} points, {frames} frames, {directions} directions, once"),
        "light and material products": Least(
            flops=steps * 2 * 2 * CHANNELS * entries, memory=steps * 2 * entries * LOBE_BYTES,
            why=f"lobes times light and transposed, in each of {steps} steps"),
        "texture pass": Least(memory=2 * seen, why="samples and shading of all seen texels read once"),
        "shading": Least(memory=run.vertices * directions * 2, flops=2 * CHANNELS * run.vertices * directions,
                         why=f"transfer of {run.vertices} vertices times the light"),
        "encoding": _encoding(run, "inverse_render"),
    }  # fmt: skip
    if own["normal_map"]:
        found["fine normals"] = Least(memory=2 * seen, why="samples and shading of all seen texels read once")
    if solve.get("shape", {}).get("refined"):
        shaped = run.vertices * min(run.frames, own["shape_frames"] or run.frames)
        found["shape equations"] = Least(memory=2 * shaped * CHANNELS * FLOAT * own["shape_steps"],
                                         why="samples and shading of all vertices, once a step")
    return found


def _export(run: RunCounts) -> dict[str, Least]:
    views = sum(pixels for name, pixels in run.pictures.items() if name.startswith("views/"))
    shown = sum(run.pictures.values())
    frames = min(run.frames, run.parameters["export_usd"]["report_frames"])
    return {
        "reading pictures": _reading(run, frames, "inverse_render"),
        "re-renders and views": Least(rays=views, memory=views * CHANNELS * FLOAT,
                                      why=f"a ray for each of {views} pixels"),
        "report": Least(memory=shown * CHANNELS, why=f"{shown} pixels of all pictures read once"),
        "encoding": _encoding(run, "export_usd"),
    }  # fmt: skip
