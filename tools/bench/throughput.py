"""Many subjects: throughput on one core and on two, and what would limit it on sixteen.

    python -m tools.bench throughput SUBJECT --out DIR [--subjects 20] [--memory MB] [--cores 16] [--document FILE]

Does     with each preset (draft, standard): `limn run` of one copy of SUBJECT on two cores, which gives the stages'
         serial shares; then of so many copies on one core and on two. Then simulates the schedule
         (tools/bench/schedule.py) for the same cases, and for --cores with --memory.
Writes   OUT/throughput.json and .csv, a row per case and stage; OUT/throughput.md: measured seconds beside simulated
         ones, and what limits each case.
Nothing else should run meanwhile. Two cores are needed.
"""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from shared.contract.declare import folder_of
from shared.contract.manifest import PROVENANCE, read_manifest
from shared.contract.needs import WorkSize, amount, measured_scale
from shared.contract.pipeline import load_pipeline
from shared.contract.subject import load_subject
from shared.errors import InputError
from shared.io.arrays import read_json
from tools.bench.marked import add_document, write_marked
from tools.bench.profile import limn_run
from tools.bench.runner import Bench, Entry, Table, markdown_table
from tools.bench.schedule import MeasuredStage, serial_share, simulate

PRESETS = ("draft", "standard")
WHOLE = ""
"""In the place of a stage's name: the row of the whole call."""


class ThroughputBench(Bench):
    """A case per preset, number of subjects and cores."""

    name = "throughput"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("subject", type=Path)
        parser.add_argument("--subjects", type=int, default=20)
        parser.add_argument("--cores", type=int, default=16, help="of the simulated machine (16)")
        parser.add_argument("--memory", type=float, default=64000.0, metavar="MB", help="of the simulated machine")
        parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE", help="a parameter")
        add_document(parser)

    def __init__(self, options: argparse.Namespace):
        super().__init__(options)
        self.pipeline, self.subject = load_pipeline(None), load_subject(options.subject)
        if self.subject.clips:
            raise InputError("needs a subject of one clip", where=str(options.subject))
        self.allowed = os.sched_getaffinity(0)
        if len(self.allowed) < 2:
            raise InputError("too few cores", where="this machine", got=len(self.allowed), expected="at least 2")

    def facts(self) -> dict[str, Any]:
        return {"subject": self.subject.name, "settings": sorted(self.options.set)}

    def cases(self) -> dict[str, tuple[str, int, int]]:
        sizes = ((1, 2), (self.options.subjects, 1), (self.options.subjects, 2))
        return {f"{preset}, {count} on {cores}": (preset, count, cores) for preset in PRESETS for count, cores in sizes}

    def measure(self, case: tuple[str, int, int], entry: Entry) -> None:
        preset, count, cores = case
        work = self.options.out.absolute() / "work"
        shutil.rmtree(work, ignore_errors=True)
        ignored = shutil.ignore_patterns("gt", "work", "export")
        names = [f"s{number:03d}" for number in range(count)]
        for name in names:
            shutil.copytree(self.subject.folder, work / "batch" / name, ignore=ignored)
        os.sched_setaffinity(0, sorted(self.allowed)[:cores])
        try:
            wall, cpu = limn_run([str(work / "batch"), "--out", str(work / "out"), "--cores", str(cores),
                                  "--preset", preset, *(f"--set={text}" for text in self.options.set)])  # fmt: skip
        finally:
            os.sched_setaffinity(0, self.allowed)
        common = {"preset": preset, "subjects": count, "cores": cores}
        rows = [common | {"stage": WHOLE, "wall_s": wall, "cpu_s": cpu}]
        for stage in self.pipeline.stages:
            costs = [read_json(work / "out" / name / folder_of(stage) / PROVENANCE) for name in names]
            rows.append(common | {"stage": stage, "booked_mb": self._booked(stage, work / "out" / names[0]),
                                  "wall_s": median(cost["wall_s"] for cost in costs),
                                  "cpu_s": median(cost["cpu_s"] for cost in costs),
                                  "peak_mb": max(cost["peak_memory_mb"] for cost in costs)})  # fmt: skip
        entry.add(*rows)
        shutil.rmtree(work)

    def _booked(self, stage: str, run: Path) -> float:
        """MB that the workflow books for it."""
        size = read_manifest(run / folder_of("inverse_render"))["parameters"]["map_size"]
        return amount(self.pipeline.steps[stage].resources, "mem_mb", measured_scale(run, WorkSize(map_px=size))) or 0.0

    def page(self, table: Table) -> str:
        lines = [line for preset in PRESETS
                 for line in compared(table.rows, preset, self.options.cores, self.options.memory)]  # fmt: skip
        return markdown_table(lines) if lines else "Not measured yet.\n"

    def conclude(self, table: Table) -> int:
        if table.rows and self.options.document:
            write_marked(self.options.document, "throughput", self.page(table))
        return 0


def around_stages(rows: Sequence[Mapping]) -> tuple[float, float]:
    """Processor seconds beside the stages' own work, on one thread: of the workflow once, and of each job (its process,
    its place in the workflow), from calls of one subject and of many. With one subject alone all counts once."""
    own = {(row["subjects"], row["cores"]): 0.0 for row in rows}
    for row in rows:
        sign = 1.0 if row["stage"] == WHOLE else -row["subjects"]
        own[row["subjects"], row["cores"]] += sign * row["cpu_s"]
    single = next(seconds for (subjects, _), seconds in own.items() if subjects == 1)
    many = [(subjects, seconds) for (subjects, cores), seconds in own.items() if subjects > 1 and cores == 1]
    if not many:
        return max(0.0, single), 0.0
    jobs = len({row["stage"] for row in rows} - {WHOLE})
    subjects, seconds = many[0]
    each = min(max(0.0, (seconds - single) / (subjects - 1)), max(0.0, single))
    return max(0.0, single - each), each / jobs


def compared(rows: Sequence[Mapping], preset: str, cores: int, memory_mb: float) -> list[dict]:
    """A line per measured case of the preset and one for the simulated machine; none before the case of one subject."""
    own = [row for row in rows if row["preset"] == preset]
    alone = {row["stage"]: row for row in own if row["subjects"] == 1}
    if not alone:
        return []
    start_s, job_s = around_stages(own)
    stages = []
    for name, row in alone.items():
        if name != WHOLE:
            serial = serial_share(row["wall_s"], row["cpu_s"], row["cores"]) * row["cpu_s"] + job_s
            cpu = row["cpu_s"] + job_s
            stages.append(MeasuredStage(name, cpu, serial / cpu, row["booked_mb"]))
    measured = {(row["subjects"], row["cores"]): row["wall_s"] for row in own if row["stage"] == WHOLE}
    most = max(subjects for subjects, _ in measured)
    lines = []
    for subjects, count in [*measured, (most, cores)]:
        done = simulate(stages, subjects, count, memory_mb, start_s)
        lines.append({
            "case": f"{preset}, {subjects} subjects on {count} cores", "measured, s": measured.get((subjects, count)),
            "simulated, s": done.seconds, "s per subject": done.seconds / subjects, "cores busy": done.busy,
            "booked, MB": done.peak_mb, "limited by": done.limited_by,
        })  # fmt: skip
    return lines
