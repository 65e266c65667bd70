"""Model selection against its fixed candidates: error on held-out frames and CPU seconds, over several clips.

    python -m tools.bench model_selection RUN [RUN ...] --out DIR [--set key=value ...] [--only auto cubemap_16 ...]

RUN: a run's folder whose work/ holds sample_frames and track_landmarks. Light and mesh are solved with model=auto and
with each fixed model, without the outline and the texture pass, which all share. Every fixed model counts twice, with
the tracked mesh and with a refined one. At the end, for each clip: model selection's error and seconds relative to
those of the fixed candidate with the least error (mean absolute, by which model selection chooses), on the frames that
were held out from all of them: the choice may have taken fewer frames.

CPU seconds of one thread: on a machine that others use too, the clock on the wall says little.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np

from shared.compute.run_context import RunContext
from shared.geometry.transforms import fibonacci_sphere
from shared.imaging.frame_index import spread_frames
from shared.imaging.views import Views
from shared.inverse.clip_inputs import ClipInputs, read_inputs
from shared.inverse.problem import InverseSettings, some_views
from shared.inverse.solve import describe_light, solve_clip
from shared.rendering.lobes import SpecularTransfer
from shared.rendering.specular_transfer import specular_tables
from tools.bench.clips import SettingsBench, settings_of
from tools.bench.runner import Clock, Entry, Table

FULL = {"model": "full"}
LEAST = {**FULL, "visibility": False, "specular": False, "light_model": "harmonics_2"}
CANDIDATES: dict[str, dict] = {
    "auto": {"model": "auto", "light_resolution": 32},
    "least": LEAST,
    "harmonics_2": {**FULL, "light_model": "harmonics_2"},
    "harmonics_2_matte": {**FULL, "light_model": "harmonics_2", "specular": False},
    "sun_sky": {**FULL, "light_model": "sun_sky"},
    "harmonics_4": {**FULL, "light_model": "harmonics_4"},
    "cubemap_8": {**FULL, "light_resolution": 8},
    "cubemap_16": {**FULL, "light_resolution": 16},
    "cubemap_16_matte": {**FULL, "light_resolution": 16, "specular": False},
    "cubemap_16_no_bounce": {**FULL, "light_resolution": 16, "bounce": False},
    "cubemap_16_no_visibility": {**FULL, "light_resolution": 16, "visibility": False},
    "cubemap_32": {**FULL, "light_resolution": 32},
}
SMALLEST = {"map_size": 64, "normal_map": False, "local_roughness": False}
"""Model selection ends before the maps; they are as small as they can be."""
COLUMNS = ("clip", "candidate", "mesh", "held_out", "held_out_abs", "cpu_s", "light", "chosen")


def compile_loops() -> None:
    """What is compiled at its first call must not count as the first candidate's time."""
    up, directions = np.array([[0.0, 0.0, 1.0]], np.float32), fibonacci_sphere(64)
    table = SpecularTransfer(up, np.ones((1, 64), bool), directions)
    specular_tables(table, up[:, None], 0.5)
    specular_tables(table, up[:, None], np.array([0.5]))


def measure(inputs: ClipInputs, candidate: str, refine: bool, given: dict) -> dict:
    """Of one candidate on one clip: what was chosen, errors on held-out frames, CPU seconds up to the texture pass.

    held_out, held_out_abs: root mean square and mean absolute residual; held_out_frames: the latter of each frame.
    """
    settings = settings_of({**given, **SMALLEST, **CANDIDATES[candidate], "shape": refine})
    if settings.shape is not None:
        settings = replace(settings, shape=replace(settings.shape, contour=None))
    clock, marks = Clock(), {}

    def progress(items, label: str):
        """Notes when the texture's turn has come."""
        marks.setdefault(label, clock.cpu_s)
        return items

    context = RunContext(progress, print if candidate == "auto" else lambda text: None)
    result = solve_clip(inputs.views, inputs.surface, settings, context)
    held_out = held_out_errors(result.views, result.solution.frame_errors, settings)
    accepted = [row for row in result.record["model_selection"] if row["accepted"]]
    return {
        "mesh": "refined" if refine else "tracked",
        "held_out": result.solution.held_out,
        "held_out_abs": float(np.mean(list(held_out.values()))),
        "held_out_frames": held_out,
        "cpu_s": marks["tracing the surface"],
        "light": describe_light(result.solution.state),
        "chosen": " > ".join(f"{row['part']} {row['candidate']}" for row in accepted),
    }


def held_out_errors(views: Views, frame_errors: np.ndarray, settings: InverseSettings) -> dict[str, float]:
    """Of the frames that light was solved from and judged by, which model selection may have thinned, the number of
    each among the clip's views, in words, and its error; frame_errors [F] of all that it was solved from."""
    numbers = spread_frames(len(views), len(frame_errors), views.light_index)
    fitted = some_views(views, settings, len(frame_errors)).fitted
    return {str(number): float(error) for number, error in zip(numbers[~fitted], frame_errors[~fitted], strict=True)}


def mean_error(row: dict, frames: Iterable[str]) -> float:
    """Of a candidate's row, over some of the frames that judged it."""
    return float(np.mean([row["held_out_frames"][frame] for frame in frames]))


def compare(rows: Sequence[dict]) -> list[dict]:
    """Per clip: the best fixed candidate, and error and seconds of model selection relative to its, on the frames that
    all of them were judged by."""
    result = []
    for clip in dict.fromkeys(row["clip"] for row in rows):
        own = [row for row in rows if row["clip"] == clip]
        autos, fixed = ([row for row in own if (row["candidate"] == "auto") == is_auto] for is_auto in (True, False))
        if autos and fixed:
            auto = autos[-1]
            common = set(auto["held_out_frames"]).intersection(*(row["held_out_frames"] for row in fixed))
            if not common:
                print(f"{clip}: no frame was held out from all candidates, so that they are not compared")
                continue
            best = min(fixed, key=lambda row: mean_error(row, common))
            result.append({
                "clip": clip,
                "best_fixed": f"{best['candidate']}, {best['mesh']}",
                "auto": ", ".join(f"{key} {auto[key]}" for key in ("light", "chosen")),
                "error_ratio": mean_error(auto, common) / mean_error(best, common),
                "time_ratio": auto["cpu_s"] / best["cpu_s"],
            })
    return result


class ModelSelectionBench(SettingsBench):
    """Every candidate on every clip."""

    name, columns = "model_selection", COLUMNS

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        super().add_arguments(parser)
        parser.add_argument("runs", nargs="*", type=Path, help="runs' folders, with work/")

    def cases(self) -> dict[str, tuple[Path, str, bool]]:
        return {f"{run.resolve().name}: {candidate}, {'refined' if refine else 'tracked'}": (run, candidate, refine)
                for run in self.options.runs for candidate in CANDIDATES for refine in (False, True)
                if refine or candidate != "auto"}

    def measure(self, case: tuple[Path, str, bool], entry: Entry) -> None:
        run, candidate, refine = case
        compile_loops()
        inputs = read_inputs(run / "work" / "sample_frames", run / "work" / "track_landmarks")
        measured = measure(inputs, candidate, refine, self.given)
        entry.add({"clip": run.resolve().name, "candidate": candidate, **measured})

    def conclude(self, table: Table) -> int:
        compared = compare(table.rows)
        for row in compared:
            print(f"{row['clip']}: error {row['error_ratio']:.3f}, time {row['time_ratio']:.2f} of "
                  f"{row['best_fixed']}; auto took {row['auto']}")
        if compared:
            print(f"median: error {median(row['error_ratio'] for row in compared):.3f}, "
                  f"time {median(row['time_ratio'] for row in compared):.2f}")
        return 0
