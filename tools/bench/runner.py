"""The runner of all benches: cases one by one, a table that grows row by row, nothing measured twice.

A bench says what it measures (Bench): its arguments, its cases as data, and the function that measures one case. The
runner does the rest: it chooses cases, leaves out those whose rows the table holds, ends when the minutes are over,
passes over a case that fails, and writes OUT/<name>.json, .csv and .md after every case.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from shared.contract.pipeline import REPOSITORY
from shared.errors import InputError
from shared.io.arrays import read_json, write_json

# ---------------------------------------------------------------------- the table


@dataclass
class Table:
    """Rows {"case", "repeat", ...} in a JSON file. facts: what else decides them, as JSON; beside: what is kept with
    them; dropped: how many rows of the file were of other facts."""

    path: Path
    facts: Mapping[str, Any] = field(default_factory=dict)
    rows: list[dict] = field(default_factory=list)
    beside: dict[str, Any] = field(default_factory=dict)
    dropped: int = 0

    @classmethod
    def open(cls, path: Path, facts: Mapping[str, Any]) -> Table:
        """What the file holds of these facts. Where it holds others, it is kept as <name>.old.json."""
        facts = json.loads(json.dumps(facts))
        content = read_json(path) if path.is_file() else {"rows": []}
        rows = content.pop("rows")
        if rows and {name: content.get(name) for name in facts} != facts:
            path.replace(path.with_suffix(".old.json"))
            return cls(path, facts, dropped=len(rows))
        return cls(path, facts, rows, {name: value for name, value in content.items() if name not in facts})

    def of(self, case: str, repeat: int = 0) -> list[dict]:
        """The rows of a case."""
        return [row for row in self.rows if (row["case"], row["repeat"]) == (case, repeat)]

    def drop(self, case: str, repeat: int) -> None:
        """Removes the rows of a case."""
        self.rows = [row for row in self.rows if (row["case"], row["repeat"]) != (case, repeat)]

    def save(self) -> None:
        """Writes the JSON file, whole or not at all."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = self.path.with_name(f"{self.path.name}.partial")
        write_json(unfinished, {**self.facts, "rows": self.rows, **self.beside})
        unfinished.replace(self.path)


def columns_of(rows: Iterable[Mapping]) -> list[str]:
    """All names in the order in which they first appear, the case before all."""
    return list(dict.fromkeys(["case", *(name for row in rows for name in row)]))


def write_csv(path: Path, rows: Sequence[Mapping], columns: Sequence[str] = ()) -> None:
    """The rows with every digit."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns or columns_of(rows), extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def markdown_table(rows: Sequence[Mapping], columns: Sequence[str] = ()) -> str:
    """The rows with four digits."""
    columns = columns or columns_of(rows)
    cells = [[shown_value(row.get(name, "")) for name in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in (columns, ["---"] * len(columns), *cells)) + "\n"


def shown_value(value: object) -> str:
    """Numbers with four digits, None as nothing."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value).replace("|", "/")


def plain(value: Any) -> Any:
    """As JSON holds it: numbers of numpy become Python's, those that are not finite None."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Mapping):
        return {name: plain(own) for name, own in value.items()}
    if isinstance(value, list | tuple):
        return [plain(own) for own in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


# ---------------------------------------------------------------------- clocks


class Clock:
    """wall_s and cpu_s since it was made, without what happened while it stood still."""

    def __init__(self) -> None:
        self._began, self._stopped = self._now(), None

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), time.process_time()

    def _passed(self, k: int) -> float:
        return (self._stopped or self._now())[k] - self._began[k]

    @property
    def wall_s(self) -> float:
        """Seconds on the wall."""
        return self._passed(0)

    @property
    def cpu_s(self) -> float:
        """Seconds of this process on the processor: they grow alike on a busy machine and on an idle one."""
        return self._passed(1)

    def __enter__(self) -> None:
        self._stopped = self._now()

    def __exit__(self, *error: object) -> None:
        paused = (now - then for now, then in zip(self._now(), self._stopped, strict=True))
        self._began = tuple(began + pause for began, pause in zip(self._began, paused, strict=True))
        self._stopped = None


def measured(command: Sequence[str], log: Path, well: Sequence[int] = (0,)) -> dict[str, float]:
    """Runs a command to its end -> its wall_s and cpu_s, and `others`, the cores that other work kept busy meanwhile.
    Its memory only the process itself can tell from that of its parent. InputError with its last words if its exit code
    is none of `well`."""
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"PYTHONHASHSEED": "0", "LIMN_PARENT": str(os.getpid())}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(REPOSITORY), os.environ.get("PYTHONPATH", "")]))
    busy, began = _busy_seconds(), time.perf_counter()
    with open(log, "wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, env=environment, cwd=REPOSITORY)
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            process.wait()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    wall, cpu = time.perf_counter() - began, usage.ru_utime + usage.ru_stime
    if process.returncode not in well:
        words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["no message"]
        ended = f"exit code {process.returncode}; its log: {log}"
        raise InputError("failed", where=" ".join(command[:6]), got=words[-1], hint=ended)
    others = max(0.0, (_busy_seconds() - busy - cpu) / wall)
    return {"wall_s": round(wall, 3), "cpu_s": round(cpu, 3), "others": round(others, 2)}


def _busy_seconds() -> float:
    """Processor seconds that all cores of this machine have worked since it started."""
    times = psutil.cpu_times()
    return sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0)


# ---------------------------------------------------------------------- benches

@dataclass(frozen=True)
class Entry:
    """The place of one case in its bench's table."""

    bench: Bench
    table: Table
    name: str
    repeat: int

    @property
    def known(self) -> list[dict]:
        """Its rows so far."""
        return self.table.of(self.name, self.repeat)

    def add(self, *rows: Mapping) -> None:
        """Adds rows and writes the table; those of one call are kept or lost as one."""
        new = [plain({"case": self.name, "repeat": self.repeat, **row}) for row in rows]
        self.table.rows += new
        self.bench.write(self.table)
        for row in new:
            if words := self.bench.say(row):
                print("  ".join(words), flush=True)


class Bench:
    """One measurement. A subclass gives `name` (of its files), `cases` and `measure`, and what else differs.

    columns: of the table, by default all that rows have. default: names of the cases that are measured unless --only
    names others; (): all of them. out: where --out points by default; None: it has to be given.
    """

    name = ""
    columns: Sequence[str] = ()
    default: Sequence[str] = ()
    out: Path | None = None

    def __init__(self, options: argparse.Namespace):
        self.options = options

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """Its own arguments."""

    def facts(self) -> dict[str, Any]:
        """What decides all rows, beside the case: rows of other facts are not kept."""
        return {}

    def refresh(self, table: Table) -> None:
        """Drops rows that hold no longer."""

    def cases(self) -> Mapping[str, Any]:
        """{name: what `measure` needs to know}, in the order of measuring."""
        raise NotImplementedError

    def chosen(self, words: Sequence[str]) -> dict[str, Any]:
        """The cases that a word names, or else those whose name holds it; InputError where a word fits none."""
        cases, found = self.cases(), {}
        for word in words:
            fitting = [word] if word in cases else [name for name in cases if word in name]
            if not fitting:
                raise InputError("no such case", where="--only", got=word, expected=", ".join(cases))
            found |= {name: cases[name] for name in fitting}
        return found

    def done(self, name: str, case: Any, repeat: int, table: Table) -> bool:
        """Whether the table holds what there is to know of a case."""
        return bool(table.of(name, repeat))

    def measure(self, case: Any, entry: Entry) -> None:
        """Measures one case and adds its rows to the entry. InputError where it cannot be."""
        raise NotImplementedError

    def say(self, row: Mapping) -> list[str]:
        """What is printed of a new row."""
        return [shown_value(row[name]) for name in self.columns or row if name in row]

    def shown(self, table: Table) -> Sequence[Mapping]:
        """The rows of the .csv and .md files."""
        return table.rows

    def page(self, table: Table) -> str:
        """The .md file."""
        return markdown_table(self.shown(table), self.columns)

    def write(self, table: Table) -> None:
        """OUT/<name>.json, .csv and .md."""
        table.save()
        write_csv(table.path.with_suffix(".csv"), self.shown(table), self.columns)
        table.path.with_suffix(".md").write_text(self.page(table), encoding="utf-8")

    def conclude(self, table: Table) -> int:
        """Draws and says what follows from all rows -> exit code."""
        return 0


def _parser(bench: type[Bench], words: str, command: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m {command}", description=words, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    bench.add_arguments(parser)
    parser.add_argument("--out", type=Path, default=bench.out, required=bench.out is None,
                        help="folder for the table and what comes with it")
    parser.add_argument("--only", nargs="+", metavar="WORD", help="cases of these names, or whose name holds a word")
    parser.add_argument("--repeats", type=int, default=1, help="of all cases (1)")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="no case begins later")
    parser.add_argument("--list", action="store_true", help="name the cases and what is measured of them, and end")
    parser.add_argument("--table", action="store_true", help="measure nothing, write the table of what there is")
    return parser


def run(bench_type: type[Bench], command: str, arguments: Sequence[str] | None = None) -> int:
    """The command line of a bench -> exit code: 1 where a case failed or the bench says so, 2 when the input is at
    fault."""
    words = sys.modules[bench_type.__module__].__doc__ or ""
    options = _parser(bench_type, words, command).parse_args(arguments)
    try:
        bench = bench_type(options)
        wanted = options.only or bench.default
        cases = bench.chosen(wanted) if wanted else dict(bench.cases())
        table = Table.open(options.out / f"{bench.name}.json", bench.facts())
        bench.refresh(table)
        if options.list:
            for name, case in cases.items():
                done = sum(bench.done(name, case, repeat, table) for repeat in range(options.repeats))
                print(f"{name}: {done} of {options.repeats}")
            return 0
        failed = [] if options.table else _measure_all(bench, cases, table, options.repeats, options.minutes)
        if table.rows:
            bench.write(table)
        code = bench.conclude(table)
    except InputError as error:
        print(f"{bench_type.name}: {error}", file=sys.stderr)
        return 2
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else code


def _measure_all(bench: Bench, cases: Mapping[str, Any], table: Table, repeats: int, minutes: float) -> list[str]:
    """All cases, then all again: what disturbs the machine disturbs all alike -> names of those that failed."""
    clock, failed = Clock(), []
    if table.dropped:
        print(f"{table.dropped} rows of something else are measured anew")
    for repeat in range(repeats):
        for name, case in cases.items():
            if bench.done(name, case, repeat, table):
                continue
            if clock.wall_s > 60.0 * minutes:
                print("the minutes are over; call again to go on")
                return failed
            try:
                bench.measure(case, Entry(bench, table, name, repeat))
            except InputError as error:
                print(f"{name}: {error}", file=sys.stderr, flush=True)
                failed += [name] * (name not in failed)
    return failed
