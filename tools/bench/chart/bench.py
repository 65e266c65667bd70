"""Speed against accuracy: presets, ablations, the published solver and a peer on one subject whose truth is known.

    python -m tools.bench.chart [SUBJECT] [--cases quick|all] [--base PRESET] [--only WORD ...] [--repeats N]
                                [--minutes M] [--score NAME] [--cost NAME] [--work DIR] [--out DIR]
                                [--peer-python PYTHON]

SUBJECT  a folder with gt/ (default: the demo subject, rendered if need be).
Does     each case from the clip to the maps, every stage in a process of its own and never two at once; presets to the
         export. First all cases once, then all again: what disturbs the machine disturbs all alike. Stages that cases
         have in common are measured once per repeat.
Writes   OUT/chart.json and chart.csv, a row per case and repeat: seconds and processor seconds of each stage, peak
         memory, all scores of tools.score; OUT/chart.md, what each case costs and reaches; OUT/chart.svg: accuracy
         over seconds with the Pareto front, or any other score over any cost (--table --score NAME --cost NAME).
Resumes  rows of the same code, subject, parameters and threads are kept, and finished stages in WORK, too. Cut it off
         at any time, or let it end by itself with --minutes (no case begins later).
Cases    quick: draft and standard, ablations of draft, the published solver cut short, Mitsuba for two minutes: 15
         minutes for the demo subject on two cores. all: fine as well, ablations of standard, longer runs of the others.
         Mitsuba 3 is optional (pip install mitsuba; it also needs LLVM, see docs/accuracy.md).
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import sys
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from shared.contract.hashing import HashMemory, hash_value
from shared.contract.manifest import source_inputs
from shared.contract.pipeline import REPOSITORY, load_pipeline
from shared.contract.subject import Subject, load_subject
from shared.errors import InputError
from shared.io.arrays import read_json
from tools.bench.chart.cases import GROUPS, PEER, SETS, ChartCase, all_cases
from tools.bench.chart.rows import (
    COSTS,
    chart_row,
    code_digest,
    csv_row,
    pareto_front,
    row_costs,
    row_names,
    summarise,
)
from tools.bench.chart.runs import Runs, current_code, fingerprints
from tools.bench.chart.scores import CODE, scores_of
from tools.bench.chart.tradeoff import tradeoff_picture
from tools.bench.runner import Bench, Entry, Table, markdown_table
from tools.demo import SUBJECT as DEMO

SCHEMA = 1
SCORE = "albedo.aligned.delta_e2000_median"
TITLE = "albedo, median dE2000 (gains removed)"
BASES = {"quick": "draft", "all": "standard"}


def open_subject(folder: Path) -> Subject:
    """The subject; the demo subject is rendered where it is missing. InputError without ground truth."""
    if folder == DEMO and not (folder / "subject.yaml").exists():
        from tools.synthesis.subject import main as synthesize

        print("Rendering the demo subject ...", flush=True)
        if synthesize([str(folder), "--preset", "demo"]):
            raise InputError("could not be rendered", where=str(folder))
    subject = load_subject(folder)
    if not (folder / "gt").is_dir():
        raise InputError("no ground truth", where=str(folder), expected="a gt/ folder", hint="see tools/synthesize.py")
    return subject


def subject_key(subject: Subject, pipeline, work: Path) -> str:
    """SHA-256 of the clip, of its settings and of the true albedo and mesh."""
    memory = HashMemory(work / ".hashes.json")
    inputs = source_inputs(pipeline.stages["sample_frames"], subject, memory)
    truth = {name: memory.hash(subject.folder / "gt" / name) for name in ("albedo.exr", "mesh.obj", "poses.npz")}
    memory.save()
    return hash_value(inputs | truth)


class ChartBench(Bench):
    """Every case on one subject. Beside its rows the table holds `code`, {digest: {file: fingerprint}} of what made
    them."""

    name, out = "chart", REPOSITORY / "build" / "chart"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("subject", type=Path, nargs="?", default=DEMO)
        parser.add_argument("--cases", choices=SETS, default="quick")
        parser.add_argument("--base", help="the preset that ablations change (quick: draft, all: standard)")
        work = REPOSITORY / "build" / "chart_work"
        parser.add_argument("--work", type=Path, default=work, help="for unfinished runs")
        parser.add_argument("--peer-python", help="a Python that has mitsuba (default: this one, where it has)")
        parser.add_argument("--score", default=SCORE, metavar="NAME", help=f"what the chart shows ({SCORE})")
        parser.add_argument("--cost", choices=COSTS, default="seconds", help="what the chart is drawn over")

    def __init__(self, options: argparse.Namespace):
        super().__init__(options)
        self.pipeline, self.subject = load_pipeline(None), open_subject(options.subject)
        self.work = options.work / self.subject.name
        self.work.mkdir(parents=True, exist_ok=True)
        self.key = subject_key(self.subject, self.pipeline, self.work)
        self.threads = len(os.sched_getaffinity(0))
        self.base = options.base or BASES[options.cases]

    @cached_property
    def has_peer(self) -> bool:
        """Whether there is a Python with Mitsuba."""
        return bool(self.options.peer_python) or importlib.util.find_spec("mitsuba") is not None

    def facts(self) -> dict[str, Any]:
        return {"schema": SCHEMA, "subject": self.subject.name, "subject_key": self.key}

    def refresh(self, table: Table) -> None:
        code = table.beside.get("code", {})
        table.beside["code"] = {digest: files for digest, files in code.items() if current_code(files)}
        kept = [row for row in table.rows if row["code"] in table.beside["code"]]
        table.dropped += len(table.rows) - len(kept)
        table.rows = kept

    @cached_property
    def _cases(self) -> dict[str, ChartCase]:
        clip = read_json(self.subject.folder / "capture.json")
        return {case.name: case for case in all_cases(self.pipeline, self.base, self.options.cases, clip)}

    def cases(self) -> dict[str, ChartCase]:
        return self._cases

    def done(self, name: str, case: ChartCase, repeat: int, table: Table) -> bool:
        settings = [case.preset, *case.settings]
        return all(any(row["settings"] == settings and row["threads"] == self.threads for row in table.of(own, repeat))
                   for own in row_names(case))

    def measure(self, case: ChartCase, entry: Entry) -> None:
        if case.group == PEER and not self.has_peer:
            print(f"{case.name}: left out, mitsuba is not installed (pip install mitsuba, or --peer-python)")
            return
        folder, table = self.work / f"repeat{entry.repeat}", entry.table
        runs = Runs(folder, self.subject, self.key, self.pipeline, self.options.peer_python or sys.executable)
        for solved in runs.solve(case):
            known = (row["scores"] for row in table.rows if row["result"] == solved.digest)
            scores = next(known, None) or scores_of(self.subject.folder, solved.folder)
            code = {**solved.code, **fingerprints(CODE)}
            row = chart_row(case, self.threads, solved, code, scores)
            table.beside["code"][code_digest(code)] = dict(sorted(code.items()))
            table.drop(row["case"], entry.repeat)
            entry.add(row)
        runs.discard_solved()
        if all(self.done(name, own, entry.repeat, table) for name, own in self._cases.items()):
            shutil.rmtree(runs.work, ignore_errors=True)

    def say(self, row: Mapping) -> list[str]:
        costs = row_costs(row)
        return [f"{row['case']} ({row['repeat'] + 1}): {costs['seconds']:.1f} s, {costs['peak_mb']:.0f} MB, "
                f"dE2000 {row['scores'].get(SCORE, float('nan')):.3f}"]

    def shown(self, table: Table) -> list[dict]:
        return [csv_row(row) for row in table.rows]

    def page(self, table: Table) -> str:
        """A line per case."""
        return markdown_table([
            {"case": point["name"], "repeats": point["repeats"], **{name: point.get(name) for name in COSTS},
             SCORE: point["scores"].get(SCORE)} for point in summarise(table.rows)
        ])  # fmt: skip

    def conclude(self, table: Table) -> int:
        """chart.svg of the rows there are, and the front in words."""
        if not table.rows:
            return 0
        points, out = summarise(table.rows), self.options.out
        score, cost = self.options.score, self.options.cost
        groups = {name: words.format(base=self.base) for name, words in GROUPS.items()}
        known = sorted({name for point in points for name in point["scores"]})
        if score not in known:
            raise InputError("no such score", where="--score", got=score, expected=", ".join(known))
        title = TITLE if score == SCORE else score
        (out / "chart.svg").write_text(tradeoff_picture(points, score, title, groups, cost), encoding="utf-8")
        print("Pareto front: " + ", ".join(pareto_front(points, score, cost)))
        print(f"{out / 'chart.svg'}")
        return 0
