"""The published solver and the transfer solver on one subject from the same start: albedo error over processor time.

    python -m tools.bench published SUBJECT RUN --out DIR [--tracked] [--reference-minutes 5] [--only reference small]
    python -m tools.bench compared SUBJECT RUN --out DIR [--tracked] [--reference-minutes 2] [--only reference small]

SUBJECT: a folder with gt/; RUN: a run's folder whose work/ holds sample_frames and track_landmarks. True mesh and poses
unless --tracked. Rows: the median dE2000 of the albedo on the face skin after one gain per channel, its PSNR, and
processor seconds of the solver alone.
published: the reference solver, lightened unless --set says otherwise, stops after --reference-minutes; called again,
it goes on from its checkpoint. The transfer solver is run at several sizes. Then DIR/accuracy.svg shows both, and it is
said how much sooner the transfer solver reaches the reference's best error.
compared: both solvers with the models of other methods, --reference-minutes for each of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from shared.compute.run_context import RunContext
from shared.contract.pipeline import load_pipeline
from shared.geometry.mesh import Mesh
from shared.imaging.image_sampling import SurfaceViewer
from shared.inverse.clip_inputs import ClipInputs
from shared.inverse.problem import frames_to_fit
from shared.inverse.published_clip import solve_by_reference
from shared.inverse.solve import solve_clip
from shared.published.solver import ReferenceSolver
from tools.bench.chart.cases import LIGHTENED
from tools.bench.clips import ClipBench, open_clip, settings_of
from tools.bench.drawing import line_chart
from tools.bench.runner import Clock, Entry, Table, markdown_table
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


@dataclass(frozen=True)
class SolverCase:
    """label: what its rows are called. size: of the transfer solver; "": the reference solver. model: parameters that
    differ. true_shape: true mesh and poses, even where those of the other cases are tracked."""

    label: str
    size: str = ""
    model: Mapping[str, Any] = field(default_factory=dict)
    true_shape: bool = False

    @property
    def solver(self) -> str:
        """Which one."""
        return "transfer" if self.size else "reference"


PUBLISHED_CASES = {f"transfer, {size}": SolverCase("transfer", size) for size in TRANSFER_SIZES} | {
    "reference": SolverCase("reference")
}
COMPARED_CASES = {
    f"{label}; {f'transfer, {size}' if size else 'reference'}": SolverCase(label, size, model, TRUE_SHAPE in label)
    for label, model in COMPARED.items() for size in (*TRANSFER_SIZES, "") if size or "bounce" not in model
}
"""The reference counts no bounces with any model."""


class _Enough(Exception):
    """The minutes are over; the checkpoint stands."""


class _Scored:
    """Scores the reference's maps at growing distances and when the minutes are over, its clock standing still
    meanwhile."""

    def __init__(
        self, score: Callable[[Mesh, dict], dict], add: Callable[[dict], None], before: Sequence[dict], file: Path,
        minutes: float,
    ):  # fmt: skip
        self.score, self.add, self.file, self.limit, self.clock = score, add, file, 60.0 * minutes, Clock()
        self.spent = float(file.read_text()) if before and file.exists() else 0.0
        self.next = max([5.0] + [SCORED_GROWTH * row["iteration"] for row in before])

    @property
    def over(self) -> bool:
        """Whether the minutes are."""
        return self.seconds() >= self.limit

    def seconds(self) -> float:
        return self.spent + self.clock.cpu_s

    def observe(self, solver: ReferenceSolver, losses: dict) -> None:
        last = solver.iteration % CHECKPOINT_EVERY == 0 and self.over
        if solver.iteration < self.next and solver.iteration < solver.settings.iterations and not last:
            return
        seconds = self.seconds()
        with self.clock:
            keys = {"diffuse_albedo": "albedo", "specular_intensity": "specular", "roughness": "roughness"}
            maps = {name: solver.parameters[key].detach().cpu().numpy() for name, key in keys.items()}
            maps["confidence"] = np.ones(maps["roughness"].shape, np.float32)
            mesh = solver.mesh.replace(vertices=solver.vertices().detach().cpu().double().numpy())
            self.add({"seconds": seconds, "iteration": solver.iteration} | self.score(mesh, maps))
        self.next = SCORED_GROWTH * solver.iteration

    def progress(self, items: Iterable, label: str) -> Iterable:
        """Ends the iterations when the minutes are over, right after a checkpoint."""
        for i, item in enumerate(items):
            yield item
            if label == "reference iterations" and (i + 1) % CHECKPOINT_EVERY == 0:
                self.file.write_text(f"{self.seconds():.3f}")
                if self.over:
                    raise _Enough


def _transfer_row(subject: Path, run: Path, tracked: bool, changes: dict) -> dict:
    """Seconds, steps and errors of one solve."""
    inputs, clock = open_clip(subject, run, tracked), Clock()
    result = solve_clip(inputs.views, inputs.surface, settings_of({"model": "full"} | changes), RunContext(note=print))
    found = {"seconds": clock.cpu_s, "iteration": len(result.solution.iterations)}
    return found | map_errors(subject, inputs, inputs.frame_index, result.texels.mesh, result.texels.maps)


class PublishedBench(ClipBench):
    """Both solvers, and how much sooner the transfer solver is as good."""

    name, columns = "accuracy", FIELDS

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        super().add_arguments(parser)
        parser.add_argument("--reference-minutes", type=float, default=5.0,
                            help="of the reference solver in each case, over all calls (5)")

    def cases(self) -> dict[str, SolverCase]:
        return PUBLISHED_CASES

    def done(self, name: str, case: SolverCase, repeat: int, table: Table) -> bool:
        # The reference goes on for as long as it has minutes left.
        return bool(case.size) and super().done(name, case, repeat, table)

    def measure(self, case: SolverCase, entry: Entry) -> None:
        subject, run, tracked = self.options.subject, self.options.run, self.tracked and not case.true_shape
        words = {"label": case.label, "solver": case.solver, "size": case.size}

        def add_row(row: dict) -> None:
            entry.add({key: value for key, value in (words | row).items() if key in FIELDS})

        changes = self.given | dict(case.model)
        if case.size:
            # What a process does but once, it does for each row: the loops' compilation counts.
            with ProcessPoolExecutor(1, get_context("spawn")) as alone:
                task = alone.submit(_transfer_row, subject, run, tracked, TRANSFER_SIZES[case.size] | changes)
                add_row(task.result())
        else:
            label, clip = f"{self.name}_{case.label}_{entry.repeat}", open_clip(subject, run, tracked)
            self._solve_reference(label, clip, changes, add_row, entry.known)

    def _solve_reference(
        self, label: str, inputs: ClipInputs, changes: dict, add: Callable[[dict], None], before: Sequence[dict]
    ) -> None:
        """Goes on with the reference solver until it has had its minutes."""
        settings = settings_of(LIGHTENED | changes)
        checkpoint = self.options.out / f"{label}.checkpoint.npz"
        reference = replace(settings.reference, checkpoint=checkpoint, checkpoint_every=CHECKPOINT_EVERY)

        def score(mesh: Mesh, maps: dict) -> dict:
            return map_errors(self.options.subject, inputs, inputs.frame_index, mesh, maps)

        scored = _Scored(score, add, before, self.options.out / f"{label}.seconds", self.options.reference_minutes)
        if scored.over:
            return
        fitted = frames_to_fit(inputs.views, inputs.surface, settings, SurfaceViewer.of(inputs.surface.mesh))
        views, context = inputs.views.with_fitted(fitted), RunContext(scored.progress, print)
        try:
            solve_by_reference(views, inputs.surface, settings, reference, context, scored.observe)
        except _Enough:
            print(f"{scored.seconds():.0f} s so far; more --reference-minutes to go on")

    def conclude(self, table: Table) -> int:
        if table.rows:
            points = {label: [(row["seconds"], _error(row)) for row in sorted(table.rows, key=_seconds)
                              if row["label"] == label] for label in dict.fromkeys(row["label"] for row in table.rows)}
            picture = line_chart(points, "processor seconds", "albedo, median dE2000", logarithmic=True)
            (self.options.out / "accuracy.svg").write_text(picture, encoding="utf-8")
        for found in head_start(table.rows):
            print(f"{found['label']}: {found['half_error']:.3f} in the first half of {found['last_s']:.0f} s, best "
                  f"{found['best_error']:.3f} after {found['best_s']:.0f} s; the transfer solver "
                  + (f"({found['size']}) {found['error']:.3f} after {found['seconds']:.1f} s: {found['ratio']:.0f} x"
                     if "ratio" in found else "does not reach that"))
        return 0


class ComparedBench(PublishedBench):
    """Both solvers with the models of other methods."""

    name = "compared"

    def cases(self) -> dict[str, SolverCase]:
        return COMPARED_CASES

    def page(self, table: Table) -> str:
        """The last row of each model and solver."""
        return markdown_table(last_rows(table.rows))

    def conclude(self, table: Table) -> int:
        print(self.page(table))
        return 0


def last_rows(rows: Sequence[dict]) -> list[dict]:
    """The last row of each model and solver, in the models' order."""
    last = {(row["label"], row["solver"], row["size"]): row for row in rows}
    order = sorted(last, key=lambda key: list(COMPARED).index(key[0]))
    return [{"case": key[0], "solver": f"{key[1]}, {key[2]}".rstrip(", "),
             **{name: last[key][name] for name in ("seconds", "iteration", "delta_e2000_median", "psnr_linear")}}
            for key in order]


def head_start(rows: Sequence[dict]) -> list[dict]:
    """How much sooner the transfer solver is as good as the reference at its best (seconds, ratio; missing where it
    never is), and how much the reference still gained in the second half of its time."""
    transfer = sorted((row for row in rows if row["solver"] == "transfer"), key=_seconds)
    result = []
    for label in dict.fromkeys(row["label"] for row in rows if row["solver"] == "reference") if transfer else ():
        own = [row for row in rows if (row["label"], row["solver"]) == (label, "reference")]
        best, last = min(own, key=_error), max(map(_seconds, own))
        half = min((row for row in own if _seconds(row) <= 0.5 * last), key=_error, default=best)
        found = {"label": label, "best_error": _error(best), "best_s": _seconds(best), "half_error": _error(half),
                 "last_s": last}
        first = next((row for row in transfer if _error(row) <= _error(best)), None)
        if first:
            found |= {"size": first["size"], "error": _error(first), "seconds": _seconds(first),
                      "ratio": _seconds(best) / _seconds(first)}
        result.append(found)
    return result


def _error(row: dict) -> float:
    return row["delta_e2000_median"]


def _seconds(row: dict) -> float:
    return row["seconds"]
