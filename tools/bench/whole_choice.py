"""What the choice of a model costs and gives over whole runs, beside the full model and fixed ones.

    python -m tools.bench whole_choice SUBJECT [SUBJECT ...] --runs DIR --out DIR [--candidates auto full ...]

DIR/<name of SUBJECT>/work holds the stages up to init_albedo, as these leave them with `--out DIR`. inverse_render and
export_usd follow for each candidate, in a process and on a core of its own, as many at a time as there are cores, and
then tools.score where the subject has gt/. OUT/whole_choice.md has a line per clip: what was chosen, processor time
of inverse_render and held-out error relative to the full model's, the error relative to the best fixed candidate's,
and full's and auto's scores.

held_out: residual of the held-out frames after the texture pass. orientation: how much of the albedo follows that of
the surface.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import reduce
from operator import getitem
from pathlib import Path
from queue import SimpleQueue
from statistics import median

from shared.contract.declare import folder_of
from shared.contract.manifest import PROVENANCE
from shared.errors import InputError
from shared.inverse.solve import in_words
from shared.io.arrays import read_json
from tools.bench.clips import SettingsBench
from tools.bench.runner import Entry, Table, markdown_table, measured
from tools.scoring.score import score

FULL = {"model": "full"}
CANDIDATES: dict[str, dict[str, object]] = {
    "auto": {},
    "full": FULL,
    "cubemap_8": {**FULL, "light_resolution": 8},
    "harmonics_4": {**FULL, "light_model": "harmonics_4"},
}
TRACKED = ("sample_frames", "track_landmarks", "init_albedo")
SOLVED = ("inverse_render", "export_usd")
SCORES = {
    "albedo_de": ("albedo", "aligned", "delta_e2000_median"),
    "albedo_one_gain_de": ("albedo", "aligned_one_gain", "delta_e2000_median"),
    "albedo_raw_de": ("albedo", "raw", "delta_e2000_median"),
    "surface_mm": ("geometry_mm", "median"),
    "lobe25": ("envmap", "lobe25_rel_rmse"),
    "rerender_db": ("rerender", "psnr"),
}
"""{column: where tools.score has it}"""


def prepared(tracked: Path, root: Path) -> Path:
    """A new run's folder with a copy of what was tracked. InputError where a stage has not run."""
    for stage in TRACKED:
        if not (tracked / folder_of(stage) / PROVENANCE).is_file():
            raise InputError("a stage has not run", where=str(tracked / folder_of(stage)),
                             expected="a run's folder with a tracked clip")
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(tracked / "work", root / "work",
                    ignore=shutil.ignore_patterns("inverse_render", "inverse_render.stamp", "export_usd.stamp"))
    return root


def row_of(subject: Path, root: Path) -> dict[str, object]:
    """What a run chose, took and gives; scores where the subject has the truth."""
    solved = root / folder_of("inverse_render")
    record, took = read_json(solved / "solve.json"), read_json(solved / PROVENANCE)
    row = {
        "chosen": in_words(record),
        "open": ", ".join(f"{one['part']} {one['candidate']}" for one in record.get("model_selection", ())
                          if one["open"] and one["accepted"]),
        "held_out": min(record["residuals"]["texture_held_out"].values()),
        "orientation": record["diagnostics"]["albedo_by_orientation"],
        "cpu_s": took["cpu_s"],
        "peak_mb": took["peak_memory_mb"],
    }
    if not (subject / "gt").is_dir():
        return row
    found = score(subject, root / folder_of("export_usd"))
    return row | {name: reduce(getitem, path, found) for name, path in SCORES.items()}


def compare(rows: Sequence[Mapping]) -> list[dict]:
    """Of each clip that auto and full were run on: auto beside full and the best fixed candidate."""
    result = []
    for clip in dict.fromkeys(row["case"] for row in rows):
        own = {row["candidate"]: row for row in rows if row["case"] == clip}
        if not {"auto", "full"} <= own.keys():
            continue
        auto, full = own["auto"], own["full"]
        fixed = {name: row["held_out"] for name, row in own.items() if name != "auto"}
        best = min(fixed, key=fixed.get)
        both = {name: f"{full[name]:.3g} · {auto[name]:.3g}" for name in ("orientation", *SCORES) if name in auto}
        result.append({
            "clip": clip,
            "chosen": auto["chosen"],
            "time": auto["cpu_s"] / full["cpu_s"],
            "error": auto["held_out"] / full["held_out"],
            "of_best": auto["held_out"] / fixed[best],
            "best": best,
            **both,
        })
    return result


class WholeChoiceBench(SettingsBench):
    """Each candidate's whole run on each subject."""

    name = "whole_choice"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        super().add_arguments(parser)
        parser.add_argument("subjects", nargs="*", type=Path, help="subjects' folders")
        parser.add_argument("--runs", type=Path, required=True, help="folder of the runs with tracked clips")
        parser.add_argument("--candidates", nargs="+", choices=CANDIDATES, default=["auto", "full"])

    def cases(self) -> dict[str, Path]:
        return {subject.resolve().name: subject.resolve() for subject in self.options.subjects}

    def done(self, name: str, case: Path, repeat: int, table: Table) -> bool:
        return not self._missing(table.of(name, repeat))

    def _missing(self, rows: Sequence[Mapping]) -> list[str]:
        found = {row["candidate"] for row in rows}
        return [name for name in self.options.candidates if name not in found]

    def measure(self, case: Path, entry: Entry) -> None:
        cores = SimpleQueue()
        for core in sorted(os.sched_getaffinity(0)):
            cores.put(core)
        with ThreadPoolExecutor(cores.qsize()) as pool:
            waiting = {name: pool.submit(self._run, case, name, cores) for name in self._missing(entry.known)}
        for name, root in waiting.items():
            entry.add({"candidate": name, **row_of(case, root.result())})

    def _run(self, subject: Path, candidate: str, cores: SimpleQueue) -> Path:
        """A candidate's run up to its export, on a core of its own -> the run's folder."""
        parent, core = (self.options.out / candidate).resolve(), cores.get()
        try:
            os.sched_setaffinity(0, {core})  # of this thread, and of the processes that it starts
            root = prepared(self.options.runs / subject.name, parent / subject.name)
            given = {**self.given, **CANDIDATES[candidate]}
            for stage in SOLVED:
                settings = [f"--set={name}={value}" for name, value in given.items() if stage == "inverse_render"]
                command = [sys.executable, "-m", f"stages.{stage}", "--subject", str(subject), "--out", str(parent)]
                measured([*command, *settings], parent / f"{subject.name}_{stage}.log")
            return root
        finally:
            cores.put(core)

    def page(self, table: Table) -> str:
        compared = compare(table.rows)
        columns = list(dict.fromkeys(name for row in compared for name in row))
        return super().page(table) + ("\n" + markdown_table(compared, columns) if compared else "")

    def conclude(self, table: Table) -> int:
        compared = compare(table.rows)
        for row in compared:
            print(f"{row['clip']}: time {row['time']:.2f}, error {row['error']:.3f} of full's, {row['of_best']:.3f} of "
                  f"{row['best']}'s; {row['chosen']}")
        for name in ("time", "error", "of_best"):
            values = [row[name] for row in compared]
            if values:
                print(f"{name}: median {median(values):.3f}, worst {max(values):.3f}")
        return 0
