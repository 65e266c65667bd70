"""How well heads are tracked: errors on subjects with known truth (tracking), and how far the poses of a clip are from
those of the same clip run backwards, for which no truth is needed (backwards).

    python -m tools.bench tracking SUBJECT... --out DIR
    python -m tools.bench backwards SUBJECT... --out DIR

Runs sample_frames and track_landmarks on each subject. Rotations are compared after one common turn of the head, so
that the mesh does not enter; the head's place across the view and in depth after the mesh's alignment, as tools.score
does. `covered`: share of frames whose true rotation error lies within the 90 % region of the reported covariance.
backwards: each clip is tracked from its first frame and from its last. What bad clips do to tracking is measured by
tools.bench.stress.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import yaml

from shared.contract.subject import load_subject
from shared.errors import InputError
from shared.io.arrays import load_arrays, read_json
from shared.io.images import write_png
from shared.io.meshes import load_mesh
from shared.io.video import open_video
from shared.tracking.pose_uncertainty import rotations_apart
from stages.sample_frames import STAGE as SAMPLED
from stages.track_landmarks import STAGE as TRACKED
from tools.bench.runner import Bench, Entry, measured
from tools.scoring.rotations import rotation_errors
from tools.scoring.score import score_geometry

STAGES = ("sample_frames", "track_landmarks")

COLUMNS = (
    "case", "frames", "excluded", "rotation_mean_deg", "rotation_max_deg", "jitter_deg", "across_mm", "depth_mm",
    "covered", "geometry_median_mm", "geometry_p95_mm", "reprojection_px", "focal_gain", "seconds", "warnings",
)  # fmt: skip

BACKWARDS_COLUMNS = ("clip", "frames", "rotation_mean_deg", "rotation_max_deg", "deviation_deg", "focal_gains")


def track(subject: Path, out: Path) -> float:
    """Seconds that sample_frames and track_landmarks took. InputError with their own words when one fails."""
    seconds = 0.0
    for stage in STAGES:
        command = [sys.executable, "-m", f"stages.{stage}", "--subject", str(subject), "--out", str(out)]
        seconds += measured(command, out / f"{subject.name}_{stage}.log")["wall_s"]
    return seconds


def errors_of(subject: Path, work: Path) -> dict[str, object]:
    """Errors of one tracked subject against its truth."""
    tracked = work / "track_landmarks"
    found, record = load_arrays(tracked / "poses.npz"), read_json(tracked / "tracking.json")
    every = load_arrays(subject / "gt" / "poses.npz")["camera_from_head"]
    true, poses = every[found["frame_index"]], found["camera_from_head"]
    apart = rotations_apart(poses[:, :3, :3], true[:, :3, :3])
    rotations = rotation_errors(found, every)
    alignment, geometry = score_geometry(
        subject, load_mesh(tracked / "mesh.npz"), true, poses, np.random.default_rng(0)
    )
    off = np.stack([alignment.pose(pose) for pose in poses])[:, :3, 3] - true[:, :3, 3]
    return {
        "frames": len(poses),
        "excluded": len(record["excluded"]),
        "rotation_mean_deg": rotations["rotation_mean_deg"],
        "rotation_max_deg": rotations["rotation_max_deg"],
        "jitter_deg": np.degrees(np.linalg.norm(np.diff(apart, axis=0), axis=1)).mean(),
        "across_mm": np.linalg.norm(off[:, :2], axis=1).mean(),
        "depth_mm": np.abs(off[:, 2]).mean(),
        "covered": rotations["covered"],
        "geometry_median_mm": geometry["geometry_mm"]["median"],
        "geometry_p95_mm": geometry["geometry_mm"]["p95"],
        "reprojection_px": record["reprojection_px"]["median"],
        "focal_gain": record["focal"]["gain"],
        "warnings": "; ".join(record["warnings"]),
    }


def run_backwards(subject: Path, destination: Path) -> int:
    """Writes the subject with its frames in reverse order, without its truth, unless it is there -> how many frames."""
    if not (destination / "subject.yaml").exists():
        (destination / "frames").mkdir(parents=True, exist_ok=True)
        frames = [frame.codes() for frame in open_video(load_subject(subject).video).frames()]
        for number, codes in enumerate(reversed(frames)):
            eight = codes if codes.dtype == np.uint8 else (codes >> 8).astype(np.uint8)
            write_png(destination / "frames" / f"{number:04d}.png", eight)
        content = yaml.safe_load((subject / "subject.yaml").read_text(encoding="utf-8"))
        text = yaml.safe_dump({**content, "video": "frames/%04d.png"})
        (destination / "subject.yaml").write_text(text, encoding="utf-8")
    return len(list((destination / "frames").iterdir()))


def both_ways(subject: Path, out: Path) -> dict[str, object]:
    """How far apart the poses are when the clip is tracked from either end. deviation_deg: what the stage reports."""
    backwards = out / "cases" / f"{subject.name}_backwards"
    count = run_backwards(subject, backwards)
    results, gains, deviation = [], [], 0.0
    for clip in (subject, backwards):
        track(clip, out / "runs")
        tracked = out / "runs" / clip.name / "work" / "track_landmarks"
        found, record = load_arrays(tracked / "poses.npz"), read_json(tracked / "tracking.json")
        index = found["frame_index"] if clip is subject else count - 1 - found["frame_index"]
        results.append(dict(zip(index.tolist(), found["camera_from_head"][:, :3, :3], strict=True)))
        gains.append(record["focal"]["gain"])
        deviation = max(deviation, record["rotation_deviation_deg"]["median"])
    common = sorted(set(results[0]) & set(results[1]))
    forward, reverse = (np.stack([result[i] for i in common]) for result in results)
    angle = np.degrees(np.linalg.norm(rotations_apart(forward, reverse), axis=1))
    return {
        "clip": subject.name,
        "frames": len(common),
        "rotation_mean_deg": angle.mean(),
        "rotation_max_deg": angle.max(),
        "deviation_deg": deviation,
        "focal_gains": " ".join(f"{gain:.4f}" for gain in gains),
    }


class BackwardsBench(Bench):
    """Each clip from either end."""

    name, columns = "backwards", BACKWARDS_COLUMNS

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("subjects", nargs="+", type=Path, help="subjects' folders")

    def __init__(self, options: argparse.Namespace):
        super().__init__(options)
        self.subjects = {folder.resolve().name: folder.resolve() for folder in options.subjects}
        self.out = options.out.resolve()

    def facts(self) -> dict[str, int]:
        return {stage.name: stage.version for stage in (SAMPLED, TRACKED)}

    def cases(self) -> dict[str, Path]:
        return self.subjects

    def measure(self, case: Path, entry: Entry) -> None:
        entry.add(both_ways(case, self.out))


class TrackingBench(BackwardsBench):
    """Errors on each subject. A stage that refuses a clip is a result, too."""

    name, columns = "tracking", COLUMNS

    def __init__(self, options: argparse.Namespace):
        super().__init__(options)
        for folder in self.subjects.values():
            if not (folder / "gt" / "poses.npz").exists():
                raise InputError("no ground truth", where=str(folder), hint="see tools/synthesize.py")

    def measure(self, case: Path, entry: Entry) -> None:
        runs = self.out / "runs"
        try:
            entry.add({"seconds": track(case, runs), **errors_of(case, runs / case.name / "work")})
        except InputError as error:
            entry.add({"warnings": str(error)})
