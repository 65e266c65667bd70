"""The published solver and the transfer solver on one subject from the same start: albedo error over processor time.

    python -m tools.bench.published SUBJECT RUN OUT --solve reference transfer [--minutes 5] [--set key=value ...]
    python -m tools.bench.published SUBJECT RUN OUT --solve compared [--minutes 2] [--sizes small] [--set key=value ...]

SUBJECT: a folder with gt/; RUN: a run's folder whose work/ holds sample_frames and track_landmarks. True mesh and poses
unless --tracked. Rows go to OUT/accuracy.csv: the median dE2000 of the albedo on the face skin after one gain per
channel, its PSNR, and processor seconds of the solver alone. The reference solver, lightened unless --set says
otherwise, stops after --minutes; called again, it goes on from its checkpoint. The transfer solver is run at several
sizes. Then OUT/accuracy.svg shows both, and it is said how much sooner the transfer solver reaches the reference's best
error.
compared: both solvers with the models of other methods, --minutes for each of them, in OUT/compared.csv and
compared.md. What is there already is not measured again.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from shared.contract.pipeline import load_pipeline
from shared.imaging.image_sampling import SurfaceViewer
from shared.inverse.clip_inputs import ClipInputs
from shared.inverse.problem import frames_to_fit
from shared.inverse.published_clip import solve_by_reference
from shared.inverse.solve import solve_clip
from shared.published.solver import ReferenceSolver
from tools.bench.appearance import open_clip, settings_of
from tools.bench.chart.cases import LIGHTENED
from tools.bench.svg_file import save_line_chart
from tools.scoring.appearance_errors import map_errors

FIELDS = ("label", "solver", "size", "seconds", "iteration", "delta_e2000_median", "delta_e2000_p90", "psnr_linear")
FIXED_SHAPE = {"shape": False, "local_roughness": False, "normal_map": False}
TRANSFER_SIZES: dict[str, dict] = {
    "tiny": {
        "points": 200, "directions": 128, "bounce_nodes": 50, "light_resolution": 4, "light_frames": 6,
        "light_steps": 2, "map_size": 64, "fit_roughness": False, **FIXED_SHAPE,
    },
    "least": {
        "points": 300, "directions": 192, "bounce_nodes": 100, "light_resolution": 8, "light_frames": 10,
        "light_steps": 4, "map_size": 128, "fit_roughness": False, **FIXED_SHAPE,
    },
    "small": {
        "points": 800, "directions": 384, "bounce_nodes": 250, "light_resolution": 8, "light_frames": 16,
        "light_steps": 8, "map_size": 256, **FIXED_SHAPE,
    },
    "draft": dict(load_pipeline().presets["draft"]["inverse_render"]),
    "fixed": FIXED_SHAPE,
    "standard": {},
}  # fmt: skip
"""From a few seconds to the defaults, on the way the preset draft; all but the last leave the mesh as it is."""
MATTE = {"specular": False}
COMPARED: dict[str, dict] = {
    "full model": {},
    "no bounce": {"bounce": False},
    "no visibility": {"visibility": False},
    "three frames": {"fit_frames": 3},
    "sun and sky": {"light_model": "sun_sky"},
    "lamp at the camera": {"light_model": "camera"},
    "matte": MATTE,
    "matte, true mesh and poses": MATTE,
    "matte, true mesh and poses, no visibility": MATTE | {"visibility": False},
}
"""The models that other methods use, as settings."""
TRUE_SHAPE = "true mesh"
"""In the names of those that are given mesh and poses."""
CHECKPOINT_EVERY = 10
SCORED_GROWTH = 1.35
"""The reference is scored after 5 iterations and then whenever they have grown by this factor."""


Clip = tuple[ClipInputs, np.ndarray]
"""A clip's inputs and its frames' numbers in the source."""


class _Enough(Exception):
    """The minutes are over; the checkpoint stands."""


class Log:
    """Rows of a .csv file."""

    def __init__(self, path: Path):
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text(",".join(FIELDS) + "\n", encoding="utf-8")

    def add(self, row: dict) -> None:
        with open(self.path, "a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, FIELDS, extrasaction="ignore", lineterminator="\n").writerow(row)
        print(" ".join(f"{row[k]:.3f}" if isinstance(row[k], float) else str(row[k]) for k in FIELDS), flush=True)

    def rows(self) -> list[dict]:
        with open(self.path, encoding="utf-8") as file:
            found = list(csv.DictReader(file))
        numbers = FIELDS[3:]
        return [row | {name: float(row[name]) for name in numbers} for row in found]


class _Scored:
    """Scores the reference's maps at growing distances and when the minutes are over, its clock standing still
    meanwhile."""

    def __init__(self, log: Log, label: str, subject: Path, inputs, index: np.ndarray, minutes: float):
        before = [row for row in log.rows() if (row["label"], row["solver"]) == (label, "reference")]
        self.clock = log.path.with_name(f"{label}.seconds")
        self.spent = float(self.clock.read_text()) if before and self.clock.exists() else 0.0
        self.next = max([5.0] + [SCORED_GROWTH * row["iteration"] for row in before])
        self.log, self.label, self.subject, self.inputs, self.index = log, label, subject, inputs, index
        self.limit, self.began, self.paused = 60.0 * minutes, time.process_time(), 0.0

    @property
    def over(self) -> bool:
        """Whether the minutes are."""
        return self.seconds() >= self.limit

    def seconds(self) -> float:
        return self.spent + time.process_time() - self.began - self.paused

    def observe(self, solver: ReferenceSolver, losses: dict) -> None:
        last = solver.iteration % CHECKPOINT_EVERY == 0 and self.over
        if solver.iteration < self.next and solver.iteration < solver.settings.iterations and not last:
            return
        seconds, stopped = self.seconds(), time.process_time()
        maps = {
            name: solver.parameters[key].detach().cpu().numpy()
            for name, key in (
                ("diffuse_albedo", "albedo"),
                ("specular_intensity", "specular"),
                ("roughness", "roughness"),
            )
        }
        maps["confidence"] = np.ones(maps["roughness"].shape, np.float32)
        mesh = solver.mesh.replace(vertices=solver.vertices().detach().cpu().double().numpy())
        errors = map_errors(self.subject, self.inputs, self.index, mesh, maps)
        row = {
            "label": self.label,
            "solver": "reference",
            "size": "",
            "seconds": seconds,
            "iteration": solver.iteration,
        }
        self.log.add(row | errors)
        self.next = SCORED_GROWTH * solver.iteration
        self.paused += time.process_time() - stopped

    def progress(self, items: Iterable, label: str = "", total: int | None = None) -> Iterable:
        """Ends the iterations when the minutes are over, right after a checkpoint."""
        for i, item in enumerate(items):
            yield item
            if label == "reference iterations" and (i + 1) % CHECKPOINT_EVERY == 0:
                self.clock.write_text(f"{self.seconds():.3f}")
                if self.over:
                    raise _Enough


def solve_reference(options, clip: Clip, changes: dict, log: Log, label: str) -> None:
    """Goes on with the reference solver until it has had its minutes."""
    inputs, index = clip
    settings = settings_of(LIGHTENED | changes)
    checkpoint = log.path.with_name(f"{label}.checkpoint.npz")
    reference = replace(settings.reference, checkpoint=checkpoint, checkpoint_every=CHECKPOINT_EVERY)
    scored = _Scored(log, label, options.subject, inputs, index, options.minutes)
    if scored.over:
        return
    fitted = frames_to_fit(inputs, settings, SurfaceViewer.of(inputs.mesh))
    try:
        solve_by_reference(inputs, settings, reference, fitted, scored.progress, print, scored.observe)
    except _Enough:
        print(f"{scored.seconds():.0f} s so far; more --minutes to go on")


def solve_transfer(options, clip: Clip, changes: dict, log: Log, label: str) -> None:
    """The transfer solver at each size that is not in the log."""
    known = [(row["label"], row["size"]) for row in log.rows()]
    for size in (size for size in options.sizes if (label, size) not in known):
        row = {"label": label, "solver": "transfer", "size": size}
        # What a process does but once, it does for each row: the loops' compilation counts.
        with ProcessPoolExecutor(1, get_context("spawn")) as alone:
            task = alone.submit(_transfer_row, options.subject, clip, TRANSFER_SIZES[size] | changes)
            log.add(row | task.result())


def _transfer_row(subject: Path, clip: Clip, changes: dict) -> dict:
    """Seconds, steps and errors of one solve."""
    inputs, index = clip
    began = time.process_time()
    result = solve_clip(inputs, settings_of(changes), lambda items, label="": items, print)
    found = {"seconds": time.process_time() - began, "iteration": len(result.solution.iterations)}
    return found | map_errors(subject, inputs, index, result.viewer.mesh, result.maps)


def solve_compared(options, clip: Clip, changes: dict, log: Log) -> None:
    """Both solvers with each of the models of other methods; the reference counts no bounces with any."""
    known = open_clip(options.subject, options.run, tracked=False) if options.tracked else clip
    for name, model in COMPARED.items():
        given = known if TRUE_SHAPE in name else clip
        solve_transfer(options, given, changes | model, log, name)
        if "bounce" not in model:
            solve_reference(options, given, changes | model, log, name)


def compared_table(rows: list[dict]) -> str:
    """The last row of each model and solver, as Markdown."""
    lines = ["| model | solver | seconds | steps | dE2000, median | PSNR |", "|---|---|---|---|---|---|"]
    last = {(row["label"], row["solver"], row["size"]): row for row in rows}
    for name, solver, size in sorted(last, key=lambda key: list(COMPARED).index(key[0])):
        row = last[name, solver, size]
        figures = f"{row['seconds']:.0f} | {row['iteration']:.0f} | {_error(row):.2f} | {row['psnr_linear']:.1f} dB"
        lines.append(f"| {name} | {f'{solver}, {size}'.rstrip(', ')} | {figures} |")
    return "\n".join(lines) + "\n"


def chart(log: Log, path: Path) -> None:
    """Error over the logarithm of time, and the ratio of times at the reference's best error."""
    rows = log.rows()
    labels = list(dict.fromkeys(row["label"] for row in rows))
    times = np.unique([row["seconds"] for row in rows])
    curves = {}
    for label in labels:
        own = sorted((row for row in rows if row["label"] == label), key=lambda row: row["seconds"])
        known = np.log10([row["seconds"] for row in own])
        errors = [row["delta_e2000_median"] for row in own]
        curves[label] = np.interp(np.log10(times), known, errors, left=np.nan, right=np.nan)
    save_line_chart(
        path, np.log10(times), curves, x_label="processor seconds (power of ten)", y_label="albedo, median dE2000",
        from_zero=True,
    )
    transfer = [row for row in rows if row["solver"] == "transfer"]
    for label in labels:
        own = [row for row in rows if row["label"] == label and row["solver"] == "reference"]
        if own and transfer:
            _say_ratio(label, own, transfer)


def _say_ratio(label: str, own: list[dict], transfer: list[dict]) -> None:
    """How much sooner the transfer solver is as good as the reference at its best, and how much the reference still
    gained in the second half of its time."""
    best, last = min(own, key=_error), max(row["seconds"] for row in own)
    half = min((row for row in own if row["seconds"] <= 0.5 * last), key=_error, default=best)
    reached = [row for row in transfer if _error(row) <= _error(best)]
    where = f"{label}: best {_error(best):.3f} after {best['seconds']:.0f} s"
    print(f"{label}: {_error(half):.3f} in the first half of {last:.0f} s, {_error(best):.3f} in all of it")
    if not reached:
        print(f"{where}; the transfer solver does not reach that")
        return
    first = min(reached, key=lambda row: row["seconds"])
    ratio = best["seconds"] / first["seconds"]
    found = f"{first['delta_e2000_median']:.3f} after {first['seconds']:.1f} s"
    print(f"{where}; transfer ({first['size']}) {found}: {ratio:.0f} x")


def _error(row: dict) -> float:
    return row["delta_e2000_median"]


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--solve", nargs="+", choices=("reference", "transfer", "compared"), required=True)
    parser.add_argument("--tracked", action="store_true", help="tracked mesh and poses instead of the true ones")
    parser.add_argument("--minutes", type=float, default=5.0, help="of the reference solver, over all calls")
    parser.add_argument("--sizes", nargs="*", default=list(TRANSFER_SIZES), choices=TRANSFER_SIZES)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="parameters of inverse_render")
    options = parser.parse_args(arguments)
    clip = open_clip(options.subject, options.run, options.tracked)
    changes = dict(setting.split("=", 1) for setting in options.set)
    if "compared" in options.solve:
        log = Log(options.out / "compared.csv")
        solve_compared(options, clip, changes, log)
        (options.out / "compared.md").write_text(table := compared_table(log.rows()), encoding="utf-8")
        print(table)
    log = Log(options.out / "accuracy.csv")
    for solver, solve in (("transfer", solve_transfer), ("reference", solve_reference)):
        if solver in options.solve:
            solve(options, clip, changes, log, solver)
    if log.rows():
        chart(log, options.out / "accuracy.svg")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
