"""From the result's arrays and records to the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shared.geometry.mesh import Mesh
from shared.io.export_maps import SOLVED_MAPS
from shared.io.frames import FrameSet
from shared.io.images import read_png
from shared.rendering.view_set import ViewSet
from shared.report.content import ClipContent, ReportContent, StageCost
from shared.report.gather import chosen_frames, compared_frames, excluded_frames, motion
from shared.report.page import report_html
from shared.report.sections import number

FRAMES_OF_OTHER_CLIPS = 3


@dataclass(frozen=True)
class ClipResult:
    """Another clip that the head was solved from. folders {stage: folder} of its own stages; solved: folder of its
    light, poses and re-renders; solve: what solve.json says of it."""

    name: str
    folders: Mapping[str, Path]
    solved: Path
    frames: FrameSet
    poses: Mapping[str, np.ndarray]
    envmap: np.ndarray
    solve: Mapping[str, object]


@dataclass(frozen=True)
class ReportInputs:
    """What the export holds in memory while it writes: the report's raw material.

    folders {stage: folder} of the stages before it; record: the content of run.json; files: (name, text) pairs; views:
    None when they were not wished; clips: all but the first, where there are several; methods: paragraphs, references.
    """

    name: str
    folders: Mapping[str, Path]
    frames: FrameSet
    mesh: Mesh
    poses: Mapping[str, np.ndarray]
    maps: Mapping[str, np.ndarray]
    envmap: np.ndarray
    solve: Mapping[str, object]
    record: Mapping[str, object]
    files: Sequence[tuple[str, str]]
    views: ViewSet | None = None
    clips: Sequence[ClipResult] = ()
    methods: tuple[Sequence[str], Sequence[str]] = ((), ())


def result_report(result: ReportInputs, frame_count: int) -> str:
    """The page of one result, comparing at most frame_count frames."""
    frames, poses, solve, record = result.frames, result.poses, result.solve, result.record
    tracked, solved = result.folders["track_landmarks"], result.folders["inverse_render"]
    held_out = solve.get("held_out_frames", [])
    again = result.views.held_out if result.views else {}
    chosen = chosen_frames([*solve["render_frames"], *again], held_out, frame_count)
    angles, position = motion(poses["camera_from_head"], frames.moves)
    overlay, chart = tracked / "overlay.png", result.folders["sample_frames"] / "chart.png"
    shape = solved / "shape.png"
    excluded = excluded_frames(result.folders["sample_frames"], tracked)
    content = ReportContent(
        name=result.name,
        facts=_facts(frames, float(poses["intrinsics"][0, 0])),
        numbers=_numbers(angles, len(excluded), record),
        frames=compared_frames(frames, solved / "renders", chosen, held_out, again),
        maps={name: result.maps[name] for name in SOLVED_MAPS},
        envmap=result.envmap,
        views=result.views,
        mesh=result.mesh,
        frame_index=poses["frame_index"],
        angles_deg=angles,
        position_mm=position,
        overlay=read_png(overlay) if overlay.is_file() else None,
        shape=read_png(shape) if shape.is_file() else None,
        chart=read_png(chart) if chart.is_file() else None,
        excluded=excluded,
        model={**solve.get("model", {}), "albedo_scale": solve.get("albedo_scale")},
        selection=record.get("model_selection", ()),
        residuals=solve.get("residuals", {}),
        iterations=solve.get("iterations", []),
        costs=[_cost(name, values) for name, values in record["stages"].items()],
        warnings=[(row["stage"], row["text"]) for row in record["warnings"]],
        parameters=_parameters(record),
        files=result.files,
        clips=[_clip(clip) for clip in result.clips],
        methods=result.methods,
    )
    return report_html(content)


def _clip(clip: ClipResult) -> ClipContent:
    frames, poses, held_out = clip.frames, clip.poses, clip.solve["held_out_frames"]
    angles, position = motion(poses["camera_from_head"], frames.moves)
    chosen = chosen_frames(clip.solve["render_frames"], held_out, FRAMES_OF_OTHER_CLIPS)
    return ClipContent(
        name=clip.name,
        facts=_facts(frames, float(poses["intrinsics"][0, 0])),
        frames=compared_frames(frames, clip.solved / "renders", chosen, held_out),
        envmap=clip.envmap,
        frame_index=poses["frame_index"],
        angles_deg=angles,
        position_mm=position,
        excluded=excluded_frames(clip.folders["sample_frames"], clip.folders["track_landmarks"]),
    )


def _facts(frames: FrameSet, focal_px: float) -> list[tuple[str, str]]:
    width, height = frames.source_size
    lens = "given" if frames.focal_known else "estimated"
    mover = {"head": "the head turns", "camera": "the camera moves"}[frames.moves]
    return [
        ("clip", frames.source_name),
        ("size", f"{width} x {height}"),
        ("at", f"{frames.fps:.4g} frames/s"),
        (mover + ",", f"colour {frames.transfer}"),
        ("focal length", f"{focal_px:.0f} px ({lens})"),
    ]


def _numbers(angles: np.ndarray, excluded: int, record: Mapping) -> list[tuple[str, str]]:
    turn = np.ptp(angles[:, 0])
    total = sum(values.get("wall_s") or 0.0 for values in record["stages"].values())
    rows = [("frames used", str(len(angles))), ("frames left out", str(excluded)), ("turn", f"{turn:.0f}\u00b0")]
    for key, value in record.get("residuals", {}).items():
        if isinstance(value, (int, float)):
            rows.append((f"residual, {key.replace('_', ' ')}", number(float(value))))
    return [*rows, ("seconds, all stages", f"{total:.0f}"), ("warnings", str(len(record["warnings"])))]


def _cost(stage: str, values: Mapping) -> StageCost:
    return StageCost(stage, values.get("wall_s"), values.get("cpu_s"), values.get("peak_memory_mb"))


def _parameters(record: Mapping) -> list[tuple[str, str, object]]:
    return [
        (stage, name, value)
        for stage, values in record["stages"].items()
        for name, value in values["parameters"].items()
    ]
