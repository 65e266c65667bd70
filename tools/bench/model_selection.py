"""Model selection of models against its fixed candidates: error on held-out frames and CPU seconds, over several clips.

    python -m tools.bench.model_selection RUN [RUN ...] --out TABLE.csv [--set key=value ...] [--candidates auto
    cubemap_16 ...]

RUN: a run's folder whose work/ holds sample_frames and track_landmarks. Light and mesh are solved with model=auto and
with each fixed model, without the outline and the texture pass, which all share. Every fixed model counts twice, with
the tracked mesh and with the refined one. Rows that TABLE.csv holds already are kept, so that an interrupted table goes
on. At the end, for each clip: model selection's error and seconds relative to those of the fixed candidate with the
least error (mean absolute, by which model selection chooses; beside it the root mean square relative to the least one).

CPU seconds of one thread: on a machine that others use too, the clock on the wall says little.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
from shared.inverse.light_and_mesh import solve_light

from shared.appearance.fit import Solution
from shared.geometry.transforms import fibonacci_sphere
from shared.imaging.image_sampling import SurfaceViewer
from shared.inverse.clip_inputs import ClipInputs, read_inputs
from shared.inverse.problem import frames_to_fit
from shared.rendering.lobes import SpecularTransfer
from shared.rendering.specular_transfer import specular_tables
from tools.bench.appearance import settings_of, silent

LEAST = {"visibility": False, "specular": False, "light_model": "harmonics_2"}
CANDIDATES: dict[str, dict] = {
    "auto": {"model": "auto", "light_resolution": 32},
    "least": LEAST,
    "harmonics_2": {"light_model": "harmonics_2"},
    "harmonics_2_matte": {"light_model": "harmonics_2", "specular": False},
    "sun_sky": {"light_model": "sun_sky"},
    "harmonics_4": {"light_model": "harmonics_4"},
    "cubemap_8": {"light_resolution": 8},
    "cubemap_16": {"light_resolution": 16},
    "cubemap_16_matte": {"light_resolution": 16, "specular": False},
    "cubemap_16_no_bounce": {"light_resolution": 16, "bounce": False},
    "cubemap_16_no_visibility": {"light_resolution": 16, "visibility": False},
    "cubemap_32": {"light_resolution": 32},
}
COLUMNS = (
    "clip", "candidate", "mesh", "held_out", "held_out_abs", "cpu_s", "light", "visibility", "specular", "chosen",
)


class Clock:
    """CPU seconds up to the first sampling for the shape, and in all."""

    def __init__(self) -> None:
        self.begun, self.tracked = time.process_time(), None

    def progress(self, items, label: str = ""):
        """A progress that shows nothing and notes when the mesh's turn has come."""
        if label.startswith("shape") and self.tracked is None:
            self.tracked = self.seconds()
        return items

    def seconds(self) -> float:
        """Since it was made."""
        return time.process_time() - self.begun


def compile_loops() -> None:
    """What is compiled at its first call must not count as the first candidate's time."""
    up, directions = np.array([[0.0, 0.0, 1.0]], np.float32), fibonacci_sphere(64)
    table = SpecularTransfer(up, np.ones((1, 64), bool), directions)
    specular_tables(table, up[:, None], 0.5)
    specular_tables(table, up[:, None], np.array([0.5]))


def measure(inputs: ClipInputs, clip: str, candidate: str, given: dict) -> list[dict]:
    """The table's rows of one candidate on one clip: of a fixed one with the tracked mesh and with the refined one."""
    settings, clock = settings_of({**given, **CANDIDATES[candidate]}), Clock()
    viewer = SurfaceViewer.of(inputs.mesh)
    fitted = frames_to_fit(inputs, settings, viewer)
    lit = solve_light(inputs, settings, viewer, fitted, None, clock.progress, print if candidate == "auto" else silent)
    seconds, appearance, shape = clock.seconds(), lit.settings.appearance, lit.shape_record
    facts = {
        "clip": clip,
        "candidate": candidate,
        "light": f"{appearance.light_model} {appearance.resolutions[-1]}",
        "visibility": "bounces" if appearance.bounce and appearance.visibility else appearance.visibility,
        "specular": appearance.specular,
    }
    judged = ~lit.capture.fitted
    if candidate == "auto":
        facts["chosen"] = " > ".join(f"{row['part']} {row['candidate']}" for row in lit.candidates if row["accepted"])
    rows = [{**facts, "mesh": "refined" if shape["refined"] else "tracked", **errors_of(lit.solution, judged),
             "cpu_s": seconds}]
    if lit.tracked is not None:
        rows[0]["mesh"] = "refined"  # or what was tried in vain: that, too, is what this candidate costs
        rows.insert(0, {**facts, "mesh": "tracked", **errors_of(lit.tracked, judged), "cpu_s": clock.tracked})
    return rows


def errors_of(solution: Solution, judged: np.ndarray) -> dict:
    """Root mean square and mean absolute residual on held-out frames, judged [F] bool."""
    return {"held_out": solution.held_out, "held_out_abs": float(solution.frame_errors[judged].mean())}


def compare(rows: Sequence[dict]) -> list[dict]:
    """Per clip: the best fixed candidate, and error and seconds of model selection relative to its."""
    result = []
    for clip in dict.fromkeys(row["clip"] for row in rows):
        own = [row for row in rows if row["clip"] == clip]
        autos, fixed = ([row for row in own if (row["candidate"] == "auto") == is_auto] for is_auto in (True, False))
        if autos and fixed:
            best, auto = min(fixed, key=lambda row: float(row["held_out_abs"])), autos[-1]
            least_square = min(float(row["held_out"]) for row in fixed)
            result.append({
                "clip": clip,
                "best_fixed": f"{best['candidate']}, {best['mesh']}",
                "auto": ", ".join(f"{key} {auto[key]}" for key in ("light", "visibility", "specular", "mesh")),
                "error_ratio": float(auto["held_out_abs"]) / float(best["held_out_abs"]),
                "square_ratio": float(auto["held_out"]) / least_square,
                "time_ratio": float(auto["cpu_s"]) / float(best["cpu_s"]),
            })
    return result


def read_rows(path: Path) -> list[dict]:
    """The table so far."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, rows: Sequence[dict]) -> None:
    """The table, whole."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="the table")
    parser.add_argument("--candidates", nargs="*", default=list(CANDIDATES), choices=CANDIDATES)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="parameters for every candidate")
    options = parser.parse_args(arguments)
    given = dict(setting.split("=", 1) for setting in options.set)
    rows = read_rows(options.out)
    compile_loops()
    for run in options.runs:
        inputs = read_inputs(run / "work" / "sample_frames", run / "work" / "track_landmarks")
        for candidate in options.candidates:
            if any(row["clip"] == run.name and row["candidate"] == candidate for row in rows):
                continue
            rows += measure(inputs, run.name, candidate, given)
            write_rows(options.out, rows)
            for row in [row for row in rows if (row["clip"], row["candidate"]) == (run.name, candidate)]:
                print(run.name, candidate, f"{row['mesh']} {row['held_out_abs']:.5f} {row['cpu_s']:.1f} s", flush=True)
    compared = compare(rows)
    for row in compared:
        print(f"{row['clip']}: error {row['error_ratio']:.3f} (mean squares {row['square_ratio']:.3f}), "
              f"time {row['time_ratio']:.2f} of {row['best_fixed']}; auto took {row['auto']}")
    if compared:
        print(f"median: error {median(row['error_ratio'] for row in compared):.3f}, "
              f"time {median(row['time_ratio'] for row in compared):.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
