"""Where Limn fails, and whether it says so: synthetic subjects with truth, each with a dial for one severity.

    python -m tools.stress WORK [--dials cap_lamp,glasses] [--minutes 6] [--docs docs]
    python -m tools.stress WORK --table [--docs docs]

Makes each dial's subjects (stress_dials), runs Limn on them with small settings (stress_run), scores the results
against the truth and passes the verdict by a stated rule (stress_judge): right, degraded and said so, or wrong and
silent. Writes WORK/rows/, one file per case, and from them DOCS/stress.csv, stress.md and stress.svg; --table does
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
from tools.stress_dials import DIALS, Dial, StressCase
from tools.stress_judge import FAILED, SILENT, judge
from tools.stress_table import write_tables

VERSION = 1
"""Raise it when subjects are made, run or scored in another way."""


def code_version() -> str:
    """The versions of the stages that make a result, and this test's own: rows of another one are made again."""
    stages = (REPOSITORY / "stages" / f"{name}.py" for name in ("sample_frames", "track_landmarks", "inverse_render"))
    return ".".join(str(version) for version in (VERSION, *(read_declaration(path).version for path in stages)))


def cases_of(dials: list[Dial]) -> list[tuple[str, StressCase]]:
    """(name, case), the unspoilt one first, then every dial's most severe, last the mildest ones."""
    most = max(len(dial.severities) for dial in dials)
    cases = [("unspoilt", StressCase())]
    for step in range(1, most + 1):
        cases += [(f"{dial.name}_{dial.severities[-step]:g}", dial.make(dial.severities[-step]))
                  for dial in dials if step <= len(dial.severities)]
    return cases


def do_case(name: str, case: StressCase, work: Path, version: str) -> None:
    """Makes the subject, runs Limn, keeps the row."""
    from tools.stress_run import run_case
    from tools.stress_subject import make_subject

    began = time.monotonic()
    subject = make_subject(case, work / "subjects" / f"{name}_{case.digest}", work / "takes")
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


def run_dials(dials: list[Dial], work: Path, minutes: float, keep_old: bool) -> bool:
    """Runs what has no current row; False when time ran out before all was done."""
    version, began = code_version(), time.monotonic()
    (work / "rows").mkdir(parents=True, exist_ok=True)
    for name, case in cases_of(dials):
        row = known_row(work, case)
        if row and (keep_old or row["code"] == version):
            continue
        if time.monotonic() - began > 60 * minutes:
            return False
        do_case(name, case, work, version)
    return True


def verdicts(work: Path) -> list[dict]:
    """A row for each dial and severity that has been run, with its verdict."""
    zero = known_row(work, StressCase())
    if zero is None or zero["exit"]:
        raise InputError("the unspoilt case has no result", where=str(work), mend="run without --table first")
    rows = []
    for dial in DIALS:
        found = [(0.0, zero)] + [(s, row) for s in dial.severities if (row := known_row(work, dial.make(s)))]
        rows += [{"dial": dial, "severity": severity, **row, "verdict": judge(dial.says, row, zero)}
                 for severity, row in found if len(found) > 1]
    return rows


def missing_cases(work: Path) -> list[str]:
    """Dials with the severities that have not been run, in words."""
    left = ((dial, [f"{s:g}" for s in dial.severities if known_row(work, dial.make(s)) is None]) for dial in DIALS)
    return [f"{dial.what} ({', '.join(severities)})" for dial, severities in left if severities]


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="folder for takes, subjects, runs and rows")
    parser.add_argument("--dials", default="", help=f"only these, by commas, of {', '.join(d.name for d in DIALS)}")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no case later than this")
    parser.add_argument("--keep-old", action="store_true", help="rows of other versions stand; the table marks them")
    parser.add_argument("--table", action="store_true", help="run nothing, write the tables from what there is")
    parser.add_argument("--docs", type=Path, help="where the tables go (default: WORK)")
    options = parser.parse_args(arguments)
    try:
        dials = chosen_dials(options.dials)
        complete = options.table or run_dials(dials, options.work.resolve(), options.minutes, options.keep_old)
        rows = verdicts(options.work)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if rows:
        write_tables(rows, missing_cases(options.work), options.docs or options.work, code_version())
    bad = [f"{row['dial'].name} {row['severity']:g}" for row in rows if row["verdict"].word in (SILENT, FAILED)]
    print(f"{len(rows)} rows; wrong and silent, or failed: {', '.join(bad) or 'none'}"
          + "; not complete: call again to go on" * (not complete))
    return 1 if bad else 0


def chosen_dials(names: str) -> list[Dial]:
    """The named dials in their order; InputError for an unknown name."""
    known = {dial.name: dial for dial in DIALS}
    for name in filter(None, names.split(",")):
        if name not in known:
            raise InputError("no such dial", where="--dials", got=name, expected=", ".join(known))
    return [dial for dial in DIALS if not names or dial.name in names.split(",")]


if __name__ == "__main__":
    raise SystemExit(main())
