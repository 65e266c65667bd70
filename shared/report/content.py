"""What the report shows, and its way there from what the stages left behind: settings, costs, warnings, frames."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from shared.geometry.blend_shapes import BlendShape
from shared.geometry.eyeballs import Eyeball
from shared.geometry.mesh import Mesh
from shared.geometry.transforms import WORLD_FROM_CAMERA, invert_rigid
from shared.io.arrays import read_json
from shared.io.export_maps import HAIR_MAPS, SOLVED_MAPS
from shared.io.frames import FrameSet
from shared.io.images import read_exr, read_png
from shared.rendering.view_set import ViewCamera, ViewSet
from shared.report.eye_pictures import close_up_frames, eye_rectangle

SELECTION_SECONDS = "model_selection_seconds.json"
RESULT_FILES = {"sample_frames": "frames.json", "track_landmarks": "tracking.json", "inverse_render": "solve.json"}
FRAMES_OF_OTHER_CLIPS = 3
FRAMES_COMPOSED = 3


@dataclass(frozen=True)
class Frame:
    """A frame of the clip beside its re-render, both [H, W, 3] linear, cropped alike; 0 where nothing was rendered.

    clipped [H, W] bool: pixels whose code value is the maximum; eyes: left, top, right and bottom px of a close-up of
    both, of frames that are chosen for one.
    """

    frame_index: int
    time_s: float
    clip: np.ndarray
    render: np.ndarray
    clipped: np.ndarray
    held_out: bool
    eyes: tuple[int, int, int, int] | None = None


@dataclass(frozen=True)
class StageCost:
    """What a stage took; None where that is not known."""

    stage: str
    wall_s: float | None
    cpu_s: float | None
    peak_memory_mb: float | None


@dataclass(frozen=True)
class ClipContent:
    """Another clip that the head was solved from, in a light of its own; fields as in ReportContent."""

    name: str
    facts: Sequence[tuple[str, str]]
    frames: Iterable[Frame]
    envmap: np.ndarray
    frame_index: np.ndarray
    angles_deg: np.ndarray
    position_mm: np.ndarray
    excluded: Sequence[tuple[int, str, str]] = ()


@dataclass(frozen=True)
class ReportContent:
    """One subject's result.

    facts, numbers, files: (label, value) pairs. maps {name: [S, S] or [S, S, 3]}, envmap [H, W, 3] linear. mesh: as the
    3D view shows it, with few faces; normals [V, 3] of its vertices.
    angles_deg [F, 3] yaw, pitch, roll and position_mm [F, 3] at frame_index [F]. excluded: (frame, stage, reason).
    views: None when they were not wished; relit_eyes: where its relit pictures show both eyes, as Frame.eyes. eyes,
    actions: of the mesh, or none; hair: what stands off the head, a mesh with the maps hair_albedo and hair_alpha, or
    None. composites {frame: [H, W, 3] linear}: crops with the re-render in the old head's place. selection: the models
    tried, one dictionary each, in order. residuals: nested
    dictionaries of numbers. iterations: one dictionary of numbers each. warnings: (stage, text). parameters: (stage,
    name, value). clips: all but the first, where there are several. methods: paragraphs and references.
    """

    name: str
    facts: Sequence[tuple[str, str]]
    numbers: Sequence[tuple[str, str]]
    frames: Iterable[Frame]
    maps: Mapping[str, np.ndarray]
    envmap: np.ndarray
    mesh: Mesh
    normals: np.ndarray
    frame_index: np.ndarray
    angles_deg: np.ndarray
    position_mm: np.ndarray
    views: ViewSet | None = None
    relit_eyes: tuple[int, int, int, int] | None = None
    eyes: Sequence[Eyeball] = ()
    actions: Sequence[BlendShape] = ()
    hair: Mesh | None = None
    composites: Mapping[int, np.ndarray] = field(default_factory=dict)
    overlay: np.ndarray | None = None
    shape: np.ndarray | None = None
    chart: np.ndarray | None = None
    excluded: Sequence[tuple[int, str, str]] = ()
    selection: Sequence[Mapping[str, object]] = ()
    model: Mapping[str, object] = field(default_factory=dict)
    residuals: Mapping[str, object] = field(default_factory=dict)
    iterations: Sequence[Mapping[str, float]] = ()
    costs: Sequence[StageCost] = ()
    warnings: Sequence[tuple[str, str]] = ()
    parameters: Sequence[tuple[str, str, object]] = ()
    files: Sequence[tuple[str, str]] = ()
    clips: Sequence[ClipContent] = ()
    methods: tuple[Sequence[str], Sequence[str]] = ((), ())


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

    folders {stage: folder} of the stages before it; mesh: the head with few faces, normals [V, 3]: those of its
    vertices in the whole one; record: the content of run.json; files: (name, text) pairs; views: None when they were
    not wished; clips: all but the first, where there are several; methods: paragraphs, references; eyes: the right and
    the left eyeball of the whole mesh, where poses say how they look, or none; actions: its blend shapes; hair: what
    stands off the head, a mesh, or None; composites: as in ReportContent.
    """

    name: str
    folders: Mapping[str, Path]
    frames: FrameSet
    mesh: Mesh
    normals: np.ndarray
    poses: Mapping[str, np.ndarray]
    maps: Mapping[str, np.ndarray]
    envmap: np.ndarray
    solve: Mapping[str, object]
    record: Mapping[str, object]
    files: Sequence[tuple[str, str]]
    views: ViewSet | None = None
    clips: Sequence[ClipResult] = ()
    methods: tuple[Sequence[str], Sequence[str]] = ((), ())
    eyes: Sequence[Eyeball] = ()
    actions: Sequence[BlendShape] = ()
    hair: Mesh | None = None
    composites: Mapping[int, np.ndarray] = field(default_factory=dict)


def result_content(result: ReportInputs, frame_count: int) -> ReportContent:
    """What the page of one result shows, comparing at most frame_count frames."""
    frames, poses, solve, record = result.frames, result.poses, result.solve, result.record
    tracked, solved = result.folders["track_landmarks"], result.folders["inverse_render"]
    held_out = solve.get("held_out_frames", [])
    again = result.views.held_out if result.views else {}
    chosen = chosen_frames([*solve["render_frames"], *again], held_out, frame_count)
    angles, position = motion(poses["camera_from_head"], frames.moves)
    overlay, chart = tracked / "overlay.png", result.folders["sample_frames"] / "chart.png"
    shape = solved / "shape.png"
    excluded = excluded_frames(result.folders["sample_frames"], tracked)
    hair_maps = () if result.hair is None else HAIR_MAPS
    return ReportContent(
        name=result.name,
        facts=_facts(frames, float(poses["intrinsics"][0, 0])),
        numbers=_numbers(angles, len(excluded), record),
        frames=compared_frames(frames, solved / "renders", chosen, held_out, again, _eyes_in(result, chosen)),
        maps={name: result.maps[name] for name in (*SOLVED_MAPS, "material", *hair_maps)},
        envmap=result.envmap,
        views=result.views,
        relit_eyes=_eyes_seen_by(result.views.relit_camera, result.eyes) if result.views and result.eyes else None,
        eyes=result.eyes,
        actions=result.actions,
        hair=result.hair,
        composites=result.composites,
        mesh=result.mesh,
        normals=result.normals,
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


def _eyes_in(result: ReportInputs, chosen: Sequence[int]) -> dict[int, tuple[int, int, int, int]]:
    """{frame: close-up of the eyes} of a few of the chosen frames; empty where no eyes are known."""
    if not result.eyes:
        return {}
    poses, frames = result.poses, result.frames
    place = {int(frame): f for f, frame in enumerate(poses["frame_index"])}
    lens = poses.get("intrinsics_crop", frames.intrinsics)
    shown = close_up_frames(chosen, poses["frame_index"], poses["camera_from_head"], poses["gaze"])
    cameras = {frame: ViewCamera(poses["camera_from_head"][place[frame]], lens, frames.size) for frame in shown}
    found = {frame: _eyes_seen_by(camera, result.eyes) for frame, camera in cameras.items()}
    return {frame: rectangle for frame, rectangle in found.items() if rectangle}


def _eyes_seen_by(camera: ViewCamera, eyes: Sequence[Eyeball]) -> tuple[int, int, int, int] | None:
    return eye_rectangle(eyes, camera.camera_from_head, camera.intrinsics, camera.size)


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


def number(value: object) -> str:
    """Four significant digits for numbers, lists element by element, anything else as text."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(number(item) for item in value)
    return str(value)


def stage_record(manifest: Mapping, provenance: Mapping) -> dict:
    """{"version", "parameters", "wall_s", "cpu_s", "peak_memory_mb", "warnings"} of one finished stage."""
    costs = {name: provenance.get(name) for name in ("wall_s", "cpu_s", "peak_memory_mb")}
    warnings = list(provenance.get("warnings", []))
    return {"version": manifest["version"], "parameters": manifest["parameters"], "warnings": warnings, **costs}


def selection_record(folder: Path, solve: Mapping) -> list[dict]:
    """The candidates of inverse_render's model selection with the seconds that each took; empty where there was
    none."""
    candidates, seconds = solve.get("model_selection", ()), folder / SELECTION_SECONDS
    took = read_json(seconds) if seconds.is_file() else [None] * len(candidates)
    return [{**candidate, "seconds": value} for candidate, value in zip(candidates, took, strict=True)]


def own_record(version: int, parameters: Mapping, wall_s: float) -> dict:
    """The same for the stage that is running: its costs so far."""
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    costs = {"wall_s": round(wall_s, 3), "cpu_s": round(time.process_time(), 3), "peak_memory_mb": round(peak_mb, 1)}
    return {"version": version, "parameters": dict(parameters), "warnings": [], **costs}


def warnings_of(stage: str, folder: Path, record: Mapping) -> list[tuple[str, str]]:
    """(stage, text) of the stage's provenance and of its own result file, each text once."""
    texts = list(record["warnings"])
    if stage in RESULT_FILES:
        texts += read_json(folder / RESULT_FILES[stage]).get("warnings", [])
    return [(stage, text) for text in dict.fromkeys(texts)]


def excluded_frames(sample_folder: Path, track_folder: Path) -> list[tuple[int, str, str]]:
    """(frame, stage, reason) for every frame that was dropped or excluded, in the clip's order."""
    dropped = read_json(sample_folder / "frames.json").get("dropped", [])
    excluded = read_json(track_folder / "tracking.json").get("excluded", [])
    rows = [(int(row["frame_index"]), "sample_frames", str(row["reason"])) for row in dropped]
    rows += [(int(row["frame_index"]), "track_landmarks", str(row["reason"])) for row in excluded]
    return sorted(rows)


def motion(camera_from_head: np.ndarray, moves: str) -> tuple[np.ndarray, np.ndarray]:
    """[F, 4, 4] -> yaw, pitch, roll in degrees [F, 3] and position in mm [F, 3] of what moved.

    moves "head": the head as the camera sees it, y up. "camera": the camera around the head, its axes y up.
    Intrinsic rotations about y, x, z.
    """
    turn = np.diag([*np.diag(WORLD_FROM_CAMERA), 1.0])
    poses = turn @ camera_from_head
    if moves == "camera":
        poses = invert_rigid(camera_from_head) @ turn
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("YXZ", degrees=True)
    return np.degrees(np.unwrap(np.radians(angles), axis=0)), poses[:, :3, 3]


def chosen_frames(available: Sequence[int], held_out: Sequence[int], count: int) -> list[int]:
    """At most count of the available frames, evenly spread, with at least one held-out frame where there is one."""
    available = sorted(available)
    if len(available) <= count:
        return available
    picked = [available[round(i)] for i in np.linspace(0, len(available) - 1, count)]
    rest = [frame for frame in available if frame in set(held_out)]
    if rest and not set(picked) & set(rest):
        middle = rest[len(rest) // 2]
        picked[min(range(count), key=lambda i: abs(picked[i] - middle))] = middle
    return sorted(picked)


def compared_frames(
    frames: FrameSet,
    renders: Path,
    chosen: Sequence[int],
    held_out: Sequence[int],
    again: Mapping[int, np.ndarray] | None = None,
    eyes: Mapping[int, tuple[int, int, int, int]] | None = None,
) -> Iterator[Frame]:
    """The chosen frames of the clip with their re-renders, one at a time: those in again {frame: [H, W, 3]}, else from
    the folder renders. eyes {frame: close-up as in Frame}."""
    known, close_ups = again or {}, eyes or {}
    for frame_index in chosen:
        position = frames.position(frame_index)
        codes = frames.read_codes(position)
        found = known[frame_index] if frame_index in known else read_exr(renders / f"{frame_index:06d}.exr")
        yield Frame(
            frame_index=frame_index,
            time_s=float(frames.time_s[position]),
            clip=frames.read_linear(position),
            render=found,
            clipped=(codes >= np.iinfo(codes.dtype).max - (1 if codes.dtype == np.uint8 else 256)).any(-1),
            held_out=frame_index in set(held_out),
            eyes=close_ups.get(frame_index),
        )
