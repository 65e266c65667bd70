"""Where Limn fails, and whether it says so: synthetic subjects with truth, each with one perturbation of growing
severity.

    python -m tools.bench.stress WORK [--perturbations cap_lamp,glasses] [--minutes 6] [--docs docs]
    python -m tools.bench.stress WORK --table [--docs docs]

Makes each perturbation's subjects (perturbations), runs Limn on them with small settings (run), scores the
results against the truth and passes the verdict by a stated rule (verdict): right, degraded and said so, or wrong
and silent. Writes WORK/rows/, one file per case, and from them DOCS/stress.csv, stress.md and stress.svg; --table does
only that. A case that has a row of the same versions is not run again, so that a test that was stopped goes on;
--minutes: no case begins later. Exit code 1 when a case is wrong and silent or failed.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from shared.contract.pipeline import REPOSITORY, load_pipeline
from shared.contract.source import read_declaration
from shared.errors import InputError
from shared.io.arrays import read_json, write_json
from tools.bench.stress.perturbations import PERTURBATIONS, Perturbation, StressCase
from tools.bench.stress.table import write_tables
from tools.bench.stress.verdict import FAILED, SILENT, judge

VERSION = 1
"""Raise it when subjects are made, run or scored in another way."""


def code_version() -> str:
    """The versions of the stages that make a result, and this test's own: rows of another one are made again."""
    stages = (REPOSITORY / "stages" / f"{name}.py" for name in ("sample_frames", "track_landmarks", "inverse_render"))
    return ".".join(str(version) for version in (VERSION, *(read_declaration(path).version for path in stages)))


def cases_of(perturbations: list[Perturbation]) -> list[tuple[str, StressCase]]:
    """(name, case), the unchanged one first, then every perturbation's most severe, last the mildest ones."""
    most = max(len(perturbation.severities) for perturbation in perturbations)
    cases = [("unspoilt", StressCase())]
    for step in range(1, most + 1):
        cases += [(f"{perturbation.name}_{perturbation.severities[-step]:g}",
                   perturbation.make(perturbation.severities[-step]))
                  for perturbation in perturbations if step <= len(perturbation.severities)]
    return cases


def do_case(name: str, case: StressCase, work: Path, version: str) -> None:
    """Makes the subject, runs Limn, keeps the row."""
    from tools.bench.stress.run import run_case
    from tools.bench.stress.subject import make_subject

    began = time.monotonic()
    subject = make_subject(case, work / "subjects" / f"{name}_{case.digest}", work / "scenes")
    made = time.monotonic() - began
    row = run_case(subject, work / "runs", load_pipeline(None))
    write_json(row_file(work, case), {"name": name, "code": version, "making_s": made, **row})
    state = f"exit {row['exit']} {row['message']}" if row["exit"] else f"albedo {row['scores']['albedo']:.2f} dE"
    print(f"{name}: {state}; {made:.0f} + {row['seconds']:.0f} s; {len(row['warnings'])} warnings", flush=True)


def row_file(work: Path, case: StressCase) -> Path:
    """Where the row of a case lies."""
    return work / "rows" / f"{case.digest}.json"


def known_row(work: Path, case: StressCase) -> dict | None:
    """A case's row, of whatever code."""
    path = row_file(work, case)
    return read_json(path) if path.exists() else None


def run_perturbations(perturbations: list[Perturbation], work: Path, minutes: float, keep_old: bool) -> bool:
    """Runs what has no current row; False when time ran out before all was done."""
    version, began = code_version(), time.monotonic()
    (work / "rows").mkdir(parents=True, exist_ok=True)
    for name, case in cases_of(perturbations):
        row = known_row(work, case)
        if row and (keep_old or row["code"] == version):
            continue
        if time.monotonic() - began > 60 * minutes:
            return False
        do_case(name, case, work, version)
    return True


def verdicts(work: Path) -> list[dict]:
    """A row for each perturbation and severity that has been run, with its verdict."""
    zero = known_row(work, StressCase())
    if zero is None or zero["exit"]:
        raise InputError("the unchanged case has no result", where=str(work), hint="run without --table first")
    rows = []
    for perturbation in PERTURBATIONS:
        known = ((severity, known_row(work, perturbation.make(severity))) for severity in perturbation.severities)
        found = [(0.0, zero)] + [(severity, row) for severity, row in known if row]
        rows += [{"perturbation": perturbation, "severity": severity, **row,
                  "verdict": judge(perturbation.says, row, zero)} for severity, row in found if len(found) > 1]
    return rows


def missing_cases(work: Path) -> list[str]:
    """Perturbations with the severities that have not been run, in words."""
    missing = []
    for perturbation in PERTURBATIONS:
        left = [f"{s:g}" for s in perturbation.severities if known_row(work, perturbation.make(s)) is None]
        if left:
            missing.append(f"{perturbation.what} ({', '.join(left)})")
    return missing


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.stress", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path, help="folder for scenes, subjects, runs and rows")
    names = ", ".join(perturbation.name for perturbation in PERTURBATIONS)
    parser.add_argument("--perturbations", default="", help=f"only these, by commas, of {names}")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no case later than this")
    parser.add_argument("--keep-old", action="store_true", help="rows of other versions stand; the table marks them")
    parser.add_argument("--table", action="store_true", help="run nothing, write the tables from what there is")
    parser.add_argument("--docs", type=Path, help="where the tables go (default: WORK)")
    options = parser.parse_args(arguments)
    try:
        perturbations = chosen_perturbations(options.perturbations)
        complete = options.table or run_perturbations(
            perturbations, options.work.resolve(), options.minutes, options.keep_old
        )
        rows = verdicts(options.work)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if rows:
        write_tables(rows, missing_cases(options.work), options.docs or options.work, code_version())
    bad = [f"{row['perturbation'].name} {row['severity']:g}" for row in rows if row["verdict"].word in (SILENT, FAILED)]
    print(f"{len(rows)} rows; wrong and silent, or failed: {', '.join(bad) or 'none'}"
          + "; not complete: call again to go on" * (not complete))
    return 1 if bad else 0


def chosen_perturbations(names: str) -> list[Perturbation]:
    """The named perturbations in their order; InputError for an unknown name."""
    known = {perturbation.name: perturbation for perturbation in PERTURBATIONS}
    for name in filter(None, names.split(",")):
        if name not in known:
            raise InputError("no such perturbation", where="--perturbations", got=name, expected=", ".join(known))
    return [perturbation for perturbation in PERTURBATIONS if not names or perturbation.name in names.split(",")]
