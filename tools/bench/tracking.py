"""How tracking stands up to bad clips: a table of errors over perturbations of subjects with known truth.

    python -m tools.bench.tracking SUBJECT... --out DIR [--degrade [--cases flicker,...]]
    python -m tools.bench.tracking SUBJECT... --out DIR --backwards

Runs sample_frames and track_landmarks on each subject as it is, and with --degrade on the degraded copies of the first
(tools/bench/degrade.py) as well. Writes DIR/tracking.csv and tracking.md. Rotations are compared after one common turn
of the head, so that the mesh does not enter; the head's place across the view and in depth after the mesh's alignment,
as tools.score does. `covered`: share of frames whose true rotation error lies within the 90 %
region of the reported covariance. With --backwards no truth is needed: each clip is tracked from its first frame and
from its last, and DIR/backwards.csv and .md say how far the poses are apart.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from shared.errors import InputError
from shared.io.arrays import load_arrays, read_json
from shared.io.meshes import load_mesh
from shared.tracking.pose_uncertainty import rotations_apart
from tools.bench import degrade as perturb
from tools.scoring.score import score_geometry

COVERED_CHI_SQUARED = 6.251
"""90 % of a chi-squared variable of three degrees of freedom."""

COLUMNS = (
    "case", "frames", "excluded", "rotation_mean_deg", "rotation_max_deg", "jitter_deg", "across_mm", "depth_mm",
    "covered", "geometry_median_mm", "geometry_p95_mm", "reprojection_px", "focal_gain", "seconds", "warnings",
)  # fmt: skip

BACKWARDS_COLUMNS = ("clip", "frames", "rotation_mean_deg", "rotation_max_deg", "deviation_deg", "focal_gains")


def run_stage(stage: str, subject: Path, out: Path) -> float:
    """Seconds that one stage took. InputError with the stage's own words when it fails."""
    began = time.monotonic()
    command = [sys.executable, "-m", f"stages.{stage}", "--subject", str(subject), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"{stage} failed", where=str(subject), got=done.stderr.strip().splitlines()[-1])
    return time.monotonic() - began


def measure(subject: Path, work: Path) -> dict[str, object]:
    """Errors of one tracked subject against its truth."""
    tracked = work / "track_landmarks"
    found, record = load_arrays(tracked / "poses.npz"), read_json(tracked / "tracking.json")
    true = load_arrays(subject / "gt" / "poses.npz")["camera_from_head"][found["frame_index"]]
    poses = found["camera_from_head"]
    apart = rotations_apart(poses[:, :3, :3], true[:, :3, :3])
    angle = np.degrees(np.linalg.norm(apart, axis=1))
    rotation_covariance = found["covariance"][:, :3, :3]
    distance = np.einsum("fi,fi->f", apart, np.linalg.solve(rotation_covariance, apart[..., None])[..., 0])
    alignment, geometry = score_geometry(
        subject, load_mesh(tracked / "mesh.npz"), true, poses, np.random.default_rng(0)
    )
    off = np.stack([alignment.pose(pose) for pose in poses])[:, :3, 3] - true[:, :3, 3]
    return {
        "frames": len(poses),
        "excluded": len(record["excluded"]),
        "rotation_mean_deg": angle.mean(),
        "rotation_max_deg": angle.max(),
        "jitter_deg": np.degrees(np.linalg.norm(np.diff(apart, axis=0), axis=1)).mean(),
        "across_mm": np.linalg.norm(off[:, :2], axis=1).mean(),
        "depth_mm": np.abs(off[:, 2]).mean(),
        "covered": (distance < COVERED_CHI_SQUARED).mean(),
        "geometry_median_mm": geometry["geometry_mm"]["median"],
        "geometry_p95_mm": geometry["geometry_mm"]["p95"],
        "reprojection_px": record["reprojection_px"]["median"],
        "focal_gain": record["focal"]["gain"],
        "warnings": "; ".join(record["warnings"]),
    }


def degraded_copies(subject: Path, tracked: Path, folder: Path) -> dict[str, Path]:
    """{case: subject}; made once, reused later."""
    frames = len(load_arrays(subject / "gt" / "poses.npz")["camera_from_head"])
    cases = {
        name: lambda to, f=degrade: perturb.degrade_pixels(subject, to, f) for name, degrade in perturb.PIXELS.items()
    }
    cases |= {
        name: lambda to, f=degrade: perturb.degrade_landmarks(subject, tracked, to, f)
        for name, degrade in perturb.LANDMARKS.items()
    }
    cases |= {
        "focal_10_longer": lambda to: perturb.degrade_focal(subject, to, 1.1),
        "focal_10_shorter": lambda to: perturb.degrade_focal(subject, to, 0.9),
        "backwards": lambda to: perturb.degrade_pixels(subject, to, perturb.unchanged, slice(None, None, -1)),
    }
    for step in (2, 4):
        if frames // step >= 12:
            order = slice(None, None, step)
            cases[f"every_{step}"] = lambda to, s=order: perturb.degrade_pixels(subject, to, perturb.unchanged, s)
    for name, make in cases.items():
        if not (folder / name / "subject.yaml").exists():
            make(folder / name)
    return {name: folder / name for name in cases}


def bench(subject: Path, case: str, out: Path) -> dict[str, object]:
    """One row of the table."""
    try:
        seconds = sum(run_stage(stage, subject, out) for stage in ("sample_frames", "track_landmarks"))
        return {"case": case, "seconds": seconds, **measure(subject, out / subject.name / "work")}
    except InputError as error:
        return {"case": case, "warnings": str(error)}


def both_ways(subject: Path, out: Path) -> dict[str, object]:
    """How far apart the poses are when the clip is tracked from either end. deviation_deg: what the stage reports."""
    backwards = out / "cases" / f"{subject.name}_backwards"
    if not (backwards / "subject.yaml").exists():
        perturb.degrade_pixels(subject, backwards, perturb.unchanged, slice(None, None, -1))
    count = len(list((backwards / "frames").iterdir()))
    results, gains, deviation = [], [], 0.0
    for clip in (subject, backwards):
        for stage in ("sample_frames", "track_landmarks"):
            run_stage(stage, clip, out / "runs")
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


def write_table(rows: list[dict[str, object]], out: Path, name: str = "tracking", columns=COLUMNS) -> None:
    """name.csv and name.md."""
    with open(out / f"{name}.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        cells = (row.get(column, "") for column in columns)
        lines.append("| " + " | ".join(f"{c:.4g}" if isinstance(c, float) else str(c) for c in cells) + " |")
    (out / f"{name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 2 when a subject has no truth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("subjects", nargs="+", type=Path, help="folders with subject.yaml and gt/")
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--degrade", action="store_true", help="also the degraded copies of the first subject")
    parser.add_argument("--cases", default="", help="only these degraded copies, by commas")
    parser.add_argument("--backwards", action="store_true", help="compare with the clip run backwards; no truth needed")
    options = parser.parse_args(arguments)
    if options.backwards:
        options.out.mkdir(parents=True, exist_ok=True)
        rows = []
        for subject in options.subjects:
            rows.append(both_ways(subject.resolve(), options.out))
            write_table(rows, options.out, "backwards", BACKWARDS_COLUMNS)
        print((options.out / "backwards.md").read_text(encoding="utf-8"))
        return 0
    for subject in options.subjects:
        if not (subject / "gt" / "poses.npz").exists():
            print(f"error: no ground truth: {subject}; see tools/synthesize.py", file=sys.stderr)
            return 2
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for subject in options.subjects:
        rows.append(bench(subject.resolve(), subject.resolve().name, options.out / "runs"))
        write_table(rows, options.out)
    if options.degrade:
        first = options.subjects[0].resolve()
        tracked = options.out / "runs" / first.name / "work" / "track_landmarks"
        copies = degraded_copies(first, tracked, options.out / "cases")
        wanted = options.cases.split(",") if options.cases else list(copies)
        for case in wanted:
            rows.append(bench(copies[case], case, options.out / "runs"))
            write_table(rows, options.out)
    print((options.out / "tracking.md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
