"""The published solver and the transfer solver on one subject from the same start: albedo error over processor time.

    python -m tools.bench_reference SUBJECT RUN OUT --solve reference [--minutes 5] [--set key=value ...]
    python -m tools.bench_reference SUBJECT RUN OUT --solve transfer [--set key=value ...]
    python -m tools.bench_reference SUBJECT RUN OUT --solve compared [--sizes small] [--set key=value ...]
    python -m tools.bench_reference SUBJECT RUN OUT --chart

SUBJECT: a folder with gt/; RUN: a run's folder whose work/ holds sample_frames and track_landmarks. True mesh and poses
unless --tracked. --solve adds rows to OUT/accuracy.csv: the median dE2000 of the albedo on the face skin after one gain
per channel, its PSNR, and processor seconds of the solver alone. The reference solver stops after --minutes and goes on
from its checkpoint when called again with the same settings and --label; the transfer solver is run at several sizes;
"compared" runs it with the models of other methods.
--chart writes OUT/accuracy.svg and says how much sooner the transfer solver reaches the reference's last error.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from shared.gather import SurfaceViewer
from shared.solve.inverse import solve_clip
from shared.solve.inverse_problem import frames_to_fit
from shared.solve.reference import ReferenceSolver
from shared.solve.reference_clip import solve_by_reference
from tools.appearance_errors import map_errors
from tools.bench_appearance import open_clip, settings_of
from tools.svg_file import save_line_chart

FIELDS = ("label", "solver", "size", "seconds", "iteration", "delta_e2000_median", "delta_e2000_p90", "psnr_linear")
FIXED_SHAPE = {"shape": False, "local_roughness": False}
TRANSFER_SIZES: dict[str, dict] = {
    "tiny": {
        "points": 200, "directions": 128, "bounce_nodes": 50, "light_resolution": 4, "light_frames": 6,
        "light_steps": 2, "map_size": 64, "search_roughness": False, **FIXED_SHAPE,
    },
    "least": {
        "points": 300, "directions": 192, "bounce_nodes": 100, "light_resolution": 8, "light_frames": 10,
        "light_steps": 4, "map_size": 128, "search_roughness": False, **FIXED_SHAPE,
    },
    "small": {
        "points": 800, "directions": 384, "bounce_nodes": 250, "light_resolution": 8, "light_frames": 16,
        "light_steps": 8, "map_size": 256, **FIXED_SHAPE,
    },
    "draft": {
        "points": 2000, "directions": 512, "bounce_nodes": 600, "light_resolution": 8, "map_size": 512, **FIXED_SHAPE,
    },
    "fixed": FIXED_SHAPE,
    "standard": {},
}  # fmt: skip
"""From a few seconds to the defaults; all but the last leave the mesh as it is."""
COMPARED: dict[str, dict] = {
    "full model": {},
    "no bounce": {"bounce": False},
    "no visibility": {"visibility": False},
    "matte": {"specular": False},
    "sun and sky": {"light_model": "sun_sky"},
    "lamp at the camera": {"light_model": "camera"},
    "three frames": {"fit_frames": 3},
}
"""The models that other methods use, as settings."""
SCORED_GROWTH = 1.35
"""The reference is scored after 5 iterations and then whenever they have grown by this factor."""


class _Enough(Exception):
    """The minutes are over; the checkpoint stands."""


class Log:
    """Rows of OUT/accuracy.csv."""

    def __init__(self, path: Path):
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text(",".join(FIELDS) + "\n", encoding="utf-8")

    def add(self, row: dict) -> None:
        with open(self.path, "a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, FIELDS, extrasaction="ignore").writerow(row)
        print(" ".join(f"{row[k]:.3f}" if isinstance(row[k], float) else str(row[k]) for k in FIELDS), flush=True)

    def rows(self) -> list[dict]:
        with open(self.path, encoding="utf-8") as file:
            found = list(csv.DictReader(file))
        numbers = FIELDS[3:]
        return [row | {name: float(row[name]) for name in numbers} for row in found]


class _Scored:
    """Scores the reference's maps at growing distances, its clock standing still meanwhile."""

    def __init__(self, log: Log, label: str, subject: Path, inputs, index: np.ndarray, minutes: float):
        before = [row for row in log.rows() if row["label"] == label]
        self.clock = log.path.with_name(f"{label}.seconds")
        self.spent = float(self.clock.read_text()) if before and self.clock.exists() else 0.0
        self.next = max([5.0] + [SCORED_GROWTH * row["iteration"] for row in before])
        self.log, self.label, self.subject, self.inputs, self.index = log, label, subject, inputs, index
        self.limit, self.began, self.paused = 60.0 * minutes, time.process_time(), 0.0

    def seconds(self) -> float:
        return self.spent + time.process_time() - self.began - self.paused

    def observe(self, solver: ReferenceSolver, losses: dict) -> None:
        if solver.iteration < self.next and solver.iteration < solver.settings.iterations:
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
            if label == "reference iterations" and (i + 1) % 10 == 0:
                self.clock.write_text(f"{self.seconds():.3f}")
                if self.seconds() - self.spent > self.limit:
                    raise _Enough


def solve_reference(options, inputs, index: np.ndarray, changes: dict, log: Log) -> None:
    """Goes on with the reference solver for some minutes."""
    settings = settings_of({"solver": "reference", **changes})
    checkpoint = options.out / f"{options.label}.checkpoint.npz"
    reference = replace(settings.reference, checkpoint=checkpoint, checkpoint_every=10)
    fitted = frames_to_fit(
        inputs, settings, SurfaceViewer.of(inputs.mesh)
    )
    scored = _Scored(log, options.label, options.subject, inputs, index, options.minutes)
    try:
        solve_by_reference(inputs, settings, reference, fitted, scored.progress, print, scored.observe)
    except _Enough:
        print(f"{scored.seconds():.0f} s so far; call again to go on")


def solve_transfer(options, inputs, index: np.ndarray, changes: dict, log: Log) -> None:
    """The transfer solver at each size."""
    for size in options.sizes:
        began = time.process_time()
        result = solve_clip(
            inputs, settings_of({**TRANSFER_SIZES[size], **changes}), lambda items, label="": items, print
        )
        row = {"label": options.label, "solver": "transfer", "size": size, "seconds": time.process_time() - began}
        steps = len(result.solution.iterations)
        errors = map_errors(options.subject, inputs, index, result.viewer.mesh, result.maps)
        log.add(row | {"iteration": steps} | errors)


def solve_compared(options, inputs, index: np.ndarray, changes: dict, log: Log) -> None:
    """The transfer solver with each of the models of other methods."""
    for name, model in COMPARED.items():
        options.label = name
        solve_transfer(options, inputs, index, {**changes, **model}, log)


def chart(log: Log, path: Path) -> None:
    """Error over the logarithm of time, and the ratio of times at the reference's best error."""
    rows = [row for row in log.rows() if row["label"] not in COMPARED]
    labels = list(dict.fromkeys(row["label"] for row in rows))
    times = np.unique([row["seconds"] for row in rows])
    curves = {}
    for label in labels:
        own = sorted((row for row in rows if row["label"] == label), key=lambda row: row["seconds"])
        known = np.log10([row["seconds"] for row in own])
        errors = [row["delta_e2000_median"] for row in own]
        curves[label] = np.interp(np.log10(times), known, errors, left=np.nan, right=np.nan)
    title = {"x_label": "processor seconds (power of ten)", "y_label": "albedo, median dE2000"}
    save_line_chart(path, np.log10(times), curves, **title, from_zero=True)
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
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--solve", choices=("reference", "transfer", "compared"))
    what.add_argument("--chart", action="store_true")
    parser.add_argument("--label", help="name of the curve (default: the solver)")
    parser.add_argument("--tracked", action="store_true", help="tracked mesh and poses instead of the true ones")
    parser.add_argument("--minutes", type=float, default=5.0, help="of the reference solver in this call")
    parser.add_argument("--sizes", nargs="*", default=list(TRANSFER_SIZES), choices=TRANSFER_SIZES)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="parameters of inverse_render")
    options = parser.parse_args(arguments)
    options.label = options.label or options.solve
    log = Log(options.out / "accuracy.csv")
    if options.chart:
        chart(log, options.out / "accuracy.svg")
        return 0
    inputs, index = open_clip(options.subject, options.run, options.tracked)
    changes = dict(setting.split("=", 1) for setting in options.set)
    solve = {"reference": solve_reference, "transfer": solve_transfer, "compared": solve_compared}[options.solve]
    solve(options, inputs, index, changes, log)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
