"""Speed against accuracy: presets, ablations, the published solver and a peer on one subject whose truth is known.

    python -m tools.bench.chart SUBJECT [--cases quick|all] [--base PRESET] [--only WORD ...] [--repeats N] [--minutes
    M]
                          [--cost NAME] [--work DIR] [--out DIR] [--peer-python PYTHON]

SUBJECT  a folder with gt/ (default: the demo subject, rendered if need be).
Does     each case from the clip to the maps, every stage in a process of its own and never two at once; presets to the
         export. First all cases once, then all again: what disturbs the machine disturbs all alike. Stages that cases
         have in common are measured once per repeat.
Writes   OUT/chart.json and chart.csv, a row per case and repeat: seconds and processor seconds of each stage, peak
         memory, all scores of tools.score; OUT/chart.svg and chart.html: accuracy over seconds with the Pareto front.
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
import time
from pathlib import Path

from shared.contract.hashing import HashMemory, hash_value
from shared.contract.manifest import source_inputs
from shared.contract.pipeline import REPOSITORY, load_pipeline
from shared.contract.subject import Subject, load_subject
from shared.errors import InputError
from shared.io.arrays import read_json
from tools.bench.chart.cases import GROUPS, PEER, SETS, ChartCase, all_cases, chosen_cases
from tools.bench.chart.page import tradeoff_page
from tools.bench.chart.rows import COSTS, Rows, pareto_front, row_costs, row_name, summarise
from tools.bench.chart.runs import Runs, Solved, fingerprints
from tools.bench.chart.scores import CODE, scores_of
from tools.bench.chart.svg import tradeoff_svg
from tools.demo import SUBJECT as DEMO

MEASURE = "albedo.aligned.delta_e2000_median"
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


class ChartRun:
    """The measuring of one subject's cases, and its files in out."""

    def __init__(self, options: argparse.Namespace):
        self.pipeline, self.subject = load_pipeline(None), open_subject(options.subject)
        self.work, self.out = options.work / self.subject.name, options.out
        for folder in (self.work, self.out):
            folder.mkdir(parents=True, exist_ok=True)
        key = subject_key(self.subject, self.pipeline, self.work)
        self.rows = Rows.open(self.out / "chart.json", self.subject.name, key)
        self.threads = len(os.sched_getaffinity(0))
        self.base = options.base or BASES[options.cases]
        self.peer_python = options.peer_python or sys.executable
        self.has_peer = bool(options.peer_python) or importlib.util.find_spec("mitsuba") is not None
        clip = read_json(self.subject.folder / "capture.json")
        self.all = all_cases(self.pipeline, self.base, options.cases, clip)
        self.cases = chosen_cases(self.all, options.only) if options.only else self.all
        self.failed: list[str] = []

    def measure(self, repeats: int, minutes: float | None) -> None:
        """All cases, then all again; a case that fails is named and passed over."""
        began = time.monotonic()
        if self.rows.dropped:
            print(f"{self.rows.dropped} rows of other code or another subject are measured anew")
        for repeat in range(repeats):
            runs = Runs(
                self.work / f"repeat{repeat}", self.subject, self.rows.subject_key, self.pipeline, self.peer_python
            )
            for case in self.cases:
                if case.group == PEER and not self.has_peer:
                    print(f"{case.name}: left out, mitsuba is not installed (pip install mitsuba, or --peer-python)")
                elif not self.rows.has(case, repeat, self.threads):
                    if minutes is not None and time.monotonic() - began > 60.0 * minutes:
                        print("the minutes are over; call again to go on")
                        return
                    self._measure_case(runs, case, repeat)
            if all(self.rows.has(case, repeat, self.threads) for case in self.all):
                shutil.rmtree(runs.work, ignore_errors=True)

    def _measure_case(self, runs: Runs, case: ChartCase, repeat: int) -> None:
        try:
            results = runs.solve(case)
        except InputError as error:
            print(f"{case.name}: {error}", file=sys.stderr, flush=True)
            self.failed.append(case.name)
            return
        for solved in results:
            self._add(case, repeat, solved)
        runs.discard_solved()

    def _add(self, case: ChartCase, repeat: int, solved: Solved) -> None:
        """Scores a result, unless one with the same content is scored already, and writes its row."""
        scores = self.rows.scores_of(solved.digest) or scores_of(self.subject.folder, solved.folder)
        code = {**solved.code, **fingerprints(CODE)}
        solved = Solved(solved.folder, solved.digest, solved.costs, code, solved.at)
        row = self.rows.add(case, repeat, self.threads, solved, scores)
        self.rows.save()
        costs = row_costs(row)
        print(f"{row['case']} ({repeat + 1}): {costs['seconds']:.1f} s, {costs['peak_mb']:.0f} MB, "
              f"dE2000 {scores.get(MEASURE, float('nan')):.3f}", flush=True)  # fmt: skip

    def draw(self, cost: str) -> None:
        """chart.svg and chart.html of the rows there are, and the front in words."""
        points = summarise(self.rows.rows)
        if not points:
            return
        groups = {name: text.format(base=self.base) for name, text in GROUPS.items()}
        (self.out / "chart.svg").write_text(tradeoff_svg(points, MEASURE, TITLE, groups, cost), encoding="utf-8")
        page = tradeoff_page(points, MEASURE, self.subject.name, groups, cost)
        (self.out / "chart.html").write_text(page, encoding="utf-8")
        print("Pareto front: " + ", ".join(pareto_front(points, MEASURE, cost)))
        print(f"{self.out / 'chart.html'}")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    found = argparse.ArgumentParser(
        prog="python -m tools.bench.chart", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("subject", type=Path, nargs="?", default=DEMO)
    found.add_argument("--cases", choices=SETS, default="quick")
    found.add_argument("--base", help="the preset that ablations change (quick: draft, all: standard)")
    found.add_argument("--only", nargs="*", metavar="WORD", help="cases of these names, or whose name holds a word")
    found.add_argument("--repeats", type=int, default=1, help="of all cases (1)")
    found.add_argument("--minutes", type=float, help="no case begins later")
    found.add_argument("--work", type=Path, default=REPOSITORY / "build" / "chart_work", help="for unfinished runs")
    found.add_argument("--out", type=Path, default=REPOSITORY / "build" / "chart", help="for the table and the chart")
    found.add_argument("--peer-python", help="a Python that has mitsuba (default: this one, where it has)")
    found.add_argument("--cost", choices=COSTS, default="seconds", help="what the chart is drawn over")
    found.add_argument("--list", action="store_true", help="name the cases and what is measured of them, and end")
    return found


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0; 1 where a case failed; 2 when the input is at fault."""
    options = parser().parse_args(arguments)
    try:
        chart = ChartRun(options)
        if options.list:
            for case in chart.cases:
                done = sum(chart.rows.has(case, repeat, chart.threads) for repeat in range(options.repeats))
                names = ", ".join(row_name(case, at) for at in case.seconds or (None,))
                print(f"{names}: {done} of {options.repeats}; {case.preset} {' '.join(case.settings)}")
            return 0
        chart.measure(options.repeats, options.minutes)
        chart.draw(options.cost)
    except InputError as error:
        print(f"chart: {error}", file=sys.stderr)
        return 2
    if chart.failed:
        print(f"failed: {', '.join(dict.fromkeys(chart.failed))}", file=sys.stderr)
    return 1 if chart.failed else 0
