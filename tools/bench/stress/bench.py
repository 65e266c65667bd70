"""Where Limn fails, and whether it says so: synthetic subjects with truth, each with one perturbation of growing
severity.

    python -m tools.bench.stress [--work WORK] [--out DIR] [--only cap_lamp glasses ...] [--minutes 6] [--keep-old]
    python -m tools.bench.stress --table

Makes each perturbation's subjects (perturbations), runs Limn on them with small settings (run), scores the
results against the truth and passes the verdict by a stated rule (verdict): right, degraded and said so, or wrong
and silent. Writes OUT/stress.json, a row per case, and from it stress.csv, stress.md and stress.svg; --table does
only that. A case that has a row of the same versions is not run again, so that a test that was stopped goes on;
--minutes: no case begins later. Exit code 1 when a case is wrong and silent or failed.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

from shared.contract.pipeline import REPOSITORY, load_pipeline
from shared.contract.source import read_declaration
from shared.errors import InputError
from tools.bench.runner import Bench, Clock, Entry, Table, shown_value
from tools.bench.stress.perturbations import PERTURBATIONS, Perturbation, StressCase
from tools.bench.stress.report import page, shown_row, stress_picture
from tools.bench.stress.run import run_case
from tools.bench.stress.subject import make_subject
from tools.bench.stress.verdict import FAILED, SILENT, judge

VERSION = 1
"""Raise it when subjects are made, run or scored in another way."""
UNCHANGED = "unspoilt"
"""The case at severity 0 of every perturbation."""


def cases_of(perturbations: Sequence[Perturbation]) -> dict[str, StressCase]:
    """{name: case}, the unchanged one first, then every perturbation's most severe, last the mildest ones."""
    most = max(len(perturbation.severities) for perturbation in perturbations)
    return {UNCHANGED: StressCase()} | {
        f"{perturbation.name}_{perturbation.severities[-step]:g}": perturbation.make(perturbation.severities[-step])
        for step in range(1, most + 1) for perturbation in perturbations if step <= len(perturbation.severities)
    }


def verdicts(rows: Sequence[Mapping], perturbations: Sequence[Perturbation]) -> list[dict]:
    """A row for each perturbation and severity that has been run, with its verdict; none without a result of the
    unchanged case."""
    known, found = {row["digest"]: row for row in rows}, []
    zero = known.get(StressCase().digest)
    if zero is None or zero["exit"]:
        return []
    for perturbation in perturbations:
        own = [(severity, known.get(perturbation.make(severity).digest)) for severity in perturbation.severities]
        run = [(0.0, zero)] + [(severity, row) for severity, row in own if row]
        found += [{"perturbation": perturbation, "severity": severity, **row,
                   "verdict": judge(perturbation.says, row, zero)} for severity, row in run if len(run) > 1]
    return found


def missing_cases(rows: Sequence[Mapping], perturbations: Sequence[Perturbation]) -> list[str]:
    """Perturbations with the severities that have not been run, in words."""
    known, missing = {row["digest"] for row in rows}, []
    for perturbation in perturbations:
        left = [f"{s:g}" for s in perturbation.severities if perturbation.make(s).digest not in known]
        if left:
            missing.append(f"{perturbation.what} ({', '.join(left)})")
    return missing


class StressBench(Bench):
    """Every perturbation at every severity."""

    name, out, perturbations = "stress", REPOSITORY / "build" / "stress", PERTURBATIONS

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--work", type=Path, default=cls.out, help="for scenes, subjects and runs")
        parser.add_argument("--keep-old", action="store_true", help="rows of other versions stand, and are marked")

    @cached_property
    def code(self) -> str:
        """The versions of the stages that make a result, and this test's own: rows of another one are made again."""
        stages = [REPOSITORY / "stages" / f"{name}.py" for name in ("sample_frames", "track_landmarks",
                                                                    "inverse_render")]
        return ".".join(str(version) for version in (VERSION, *(read_declaration(path).version for path in stages)))

    def cases(self) -> dict[str, StressCase]:
        return cases_of(self.perturbations)

    def chosen(self, words: Sequence[str]) -> dict[str, StressCase]:
        return super().chosen([UNCHANGED, *words])

    def done(self, name: str, case: StressCase, repeat: int, table: Table) -> bool:
        return any(row["digest"] == case.digest and (self.options.keep_old or row["code"] == self.code)
                   for row in table.of(name, repeat))

    def measure(self, case: StressCase, entry: Entry) -> None:
        """Makes the subject, runs Limn, keeps the row."""
        clock, work = Clock(), self.options.work.resolve()
        subject = make_subject(case, work / "subjects" / f"{entry.name}_{case.digest}", work / "scenes")
        made = clock.wall_s
        row = run_case(subject, work / "runs", load_pipeline(None))
        entry.table.drop(entry.name, entry.repeat)
        entry.add({"digest": case.digest, "code": self.code, "making_s": made, **row})

    def say(self, row: Mapping) -> list[str]:
        albedo = shown_value(row["scores"].get("albedo"))
        state = f"exit {row['exit']} {row['message']}" if row["exit"] else f"albedo {albedo} dE"
        return [f"{row['case']}: {state}; {row['making_s']:.0f} + {row['seconds']:.0f} s; "
                f"{len(row['warnings'])} warnings"]

    def shown(self, table: Table) -> list[dict]:
        return [shown_row(row) for row in self._verdicts(table)]

    def page(self, table: Table) -> str:
        return page(self._verdicts(table), missing_cases(table.rows, self.perturbations), self.code)

    def _verdicts(self, table: Table) -> list[dict]:
        return verdicts(table.rows, self.perturbations)

    def conclude(self, table: Table) -> int:
        if not any(row["digest"] == StressCase().digest and not row["exit"] for row in table.rows):
            raise InputError("the unchanged case has no result", where=str(table.path), hint="run without --table")
        rows = self._verdicts(table)
        if rows:
            (self.options.out / "stress.svg").write_text(stress_picture(rows), encoding="utf-8")
        wrong = [row for row in rows if row["verdict"].word in (SILENT, FAILED)]
        bad = [f"{row['perturbation'].name} {row['severity']:g}" for row in wrong]
        print(f"{len(rows)} rows; wrong and silent, or failed: {', '.join(bad) or 'none'}")
        return 1 if bad else 0
