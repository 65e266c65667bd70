"""Where a subject's time goes, stage by stage and phase by phase, beside the least that its data demand.

    python -m tools.bench profile SUBJECT [--preset NAME] [--set STAGE.KEY=VALUE ...] [--run DIR] [--work DIR]
                                  [--document FILE] --out DIR

SUBJECT  a folder with subject.yaml, of one clip.
Does     each stage under a sampling profiler (tools/bench/sampler.py), in a folder of its own; then `limn run` with one
         stage missing and with none missing, for what the workflow itself takes. Measures what this machine can do at
         best (tools/bench/machine_limits.py) and counts what the data demand (tools/bench/budget.py).
         With --run, a folder with work/, stages that --only does not name are copied from there instead.
Writes   OUT/profile.json and .csv, a row per stage and phase; OUT/profile.md, the same as tables with what is next.
Nothing else should run meanwhile: `others` says how many cores something else kept busy.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from shared.contract.declare import folder_of
from shared.contract.manifest import PROVENANCE, read_manifest
from shared.contract.pipeline import REPOSITORY, load_pipeline, split_settings
from shared.contract.subject import load_subject
from shared.errors import InputError
from shared.io.arrays import read_json
from tools.bench.budget import budget, count_run
from tools.bench.machine_limits import MachineLimits, measure_limits
from tools.bench.marked import add_document, write_marked
from tools.bench.phases import OTHER
from tools.bench.runner import Bench, Entry, Table, markdown_table, measured, write_csv

WORKFLOW = "workflow"
LAST = "export_usd"
TOP = 8
REVIEW = 3
"""limn's exit code for a finished subject that a person has to look at."""
SMALL_S = 0.05
"""Phases below this are not candidates for the next thing to do."""


class ProfileBench(Bench):
    """A case per stage, then the workflow. Beside its rows the table holds the machine's limits."""

    name = "profile"
    columns = ("case", "phase", "wall_s", "cpu_s", "peak_mb", "others")

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("subject", type=Path)
        parser.add_argument("--preset", default="standard", help="a preset of pipeline.yaml (standard)")
        parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE", help="a parameter")
        parser.add_argument("--run", type=Path, metavar="DIR", help="a finished run of the subject: it holds work/")
        parser.add_argument("--work", type=Path, metavar="DIR", help="for the stages' folders (OUT/work)")
        add_document(parser)

    def __init__(self, options: argparse.Namespace):
        super().__init__(options)
        self.pipeline, self.subject = load_pipeline(None), load_subject(options.subject)
        if self.subject.clips:
            raise InputError("profiles subjects of one clip", where=str(options.subject),
                             got=f"{len(self.subject.clips)} clips")  # fmt: skip
        self.given = split_settings(options.set, self.pipeline.stages)
        self.work = (options.work or options.out / "work").absolute()
        self.root = self.work / self.subject.name

    def facts(self) -> dict[str, Any]:
        return {"subject": self.subject.name, "preset": self.options.preset, "settings": sorted(self.options.set)}

    def cases(self) -> dict[str, str]:
        return {name: name for name in (*self.pipeline.stages, WORKFLOW)}

    def measure(self, case: str, entry: Entry) -> None:
        self.work.mkdir(parents=True, exist_ok=True)
        if "limits" not in entry.table.beside:
            entry.table.beside["limits"] = asdict(measure_limits(self.work))
        if self.options.run and not self.root.exists():
            self._copy_run()
        if case == WORKFLOW:
            return entry.add(*self._workflow())
        self._need(self.pipeline.steps[case].needs)
        entry.add(*self._stage(case))

    def _copy_run(self) -> None:
        if not (self.options.run / "work").is_dir():
            raise InputError("no finished run", where="--run", got=self.options.run, expected="a folder with work/")
        for name in ("work", "export"):
            if (self.options.run / name).is_dir():
                shutil.copytree(self.options.run / name, self.root / name)

    def _need(self, stages: Sequence[str]) -> None:
        for name in stages:
            if read_manifest(self.root / folder_of(name)) is None:
                raise InputError("has not run", where=str(self.root), got=name, hint="leave --only out, or give --run")

    def _settings(self, stage: str) -> list[str]:
        return [f"--set={stage}.{key}={value}" for key, value in self.given.get(stage, {}).items()]

    def _stage(self, name: str) -> list[dict]:
        """Rows of a stage's phases, and of the whole."""
        report = self.work / f"{name}.json"
        command = [sys.executable, "-m", "tools.bench.sampler", str(report), str(self.pipeline.root)]
        command += [self.pipeline.package, name, "--subject", str(self.subject.folder), "--out", str(self.work)]
        command += ["--preset", self.options.preset, "--force", *self._settings(name)]
        cost = measured(command, self.work / f"{name}.log")
        found = read_json(report)
        peak = read_json(self.root / folder_of(name) / PROVENANCE)["peak_memory_mb"]
        rows = [{"phase": phase, "wall_s": own["wall_s"], "cpu_s": own["cpu_s"], "peak_mb": own["peak_mb"],
                 "others": cost["others"], "functions": dict(_top(own["functions"]))}
                for phase, own in sorted(found["phases"].items(), key=lambda pair: -pair[1]["wall_s"])]  # fmt: skip
        whole = {"phase": "", "wall_s": cost["wall_s"], "cpu_s": cost["cpu_s"], "peak_mb": peak,
                 "others": cost["others"], "samples": found["samples"]}  # fmt: skip
        return [whole, *rows]

    def _workflow(self) -> list[dict]:
        """Rows of `limn run` less its one missing stage, and of a finished subject."""
        self._need(list(self.pipeline.stages))
        shutil.rmtree(self.root / folder_of(LAST))
        command = [str(self.subject.folder), "--out", str(self.work)]
        command += ["--preset", self.options.preset, *(text for name in self.given for text in self._settings(name))]
        wall, cpu = limn_run(command)
        stage = read_json(self.root / folder_of(LAST) / PROVENANCE)
        started = {"phase": "workflow's start", "wall_s": wall - stage["wall_s"], "cpu_s": cpu - stage["cpu_s"],
                   "what": f"limn run, {LAST} missing, less that stage's own work"}  # fmt: skip
        wall, cpu = limn_run(command)
        finished = {"phase": "finished subject", "wall_s": wall, "cpu_s": cpu, "what": "limn run, nothing missing"}
        return [started, finished]

    def say(self, row: Mapping) -> list[str]:
        if row["phase"] and row["case"] != WORKFLOW:
            return []
        return [f"{row['case']} {row['phase']}: {row['wall_s']:.1f} s, {row['cpu_s']:.1f} processor seconds"]

    def shown(self, table: Table) -> list[dict]:
        """Rows with the least that the data demand, where the whole run is there to be counted."""
        least = self._budget(table)
        rows = []
        for row in table.rows:
            known = least.get(row["case"], {}).get(row["phase"])
            extra = {} if known is None else {"least_s": known[0], "counted": known[1]}
            rows.append({name: value for name, value in row.items() if name != "functions"} | extra)
        return rows

    def _budget(self, table: Table) -> dict[str, dict[str, tuple[float, str]]]:
        stages = self.pipeline.stages
        if "limits" not in table.beside or any(read_manifest(self.root / folder_of(name)) is None for name in stages):
            return {}
        limits = MachineLimits(**table.beside["limits"])
        counted = budget(count_run(self.root, clip_bytes(self.subject.folder)))
        return {stage: {phase: (least.seconds(limits), least.why) for phase, least in own.items()}
                for stage, own in counted.items()}  # fmt: skip

    def write(self, table: Table) -> None:
        table.save()
        write_csv(table.path.with_suffix(".csv"), self.shown(table))
        table.path.with_suffix(".md").write_text(self.page(table), encoding="utf-8")

    def page(self, table: Table) -> str:
        return profile_page(self.shown(table), table)

    def conclude(self, table: Table) -> int:
        if table.rows:
            print(next_thing(self.shown(table)))
            if self.options.document:
                write_marked(self.options.document, "profile", self.page(table))
        return 0


def clip_bytes(folder: Path) -> int:
    """Bytes of all that lies in a subject's folder beside truth and results: the clip, or its numbered pictures."""
    own = (path for path in folder.iterdir() if path.name not in ("gt", "work", "export"))
    return sum(file.stat().st_size for path in own for file in ([path] if path.is_file() else path.rglob("*"))
               if file.is_file())  # fmt: skip


def _top(functions: Mapping[str, float]) -> list[tuple[str, float]]:
    return sorted(functions.items(), key=lambda pair: -pair[1])[:TOP]


def limn_run(arguments: Sequence[str]) -> tuple[float, float]:
    """Wall and processor seconds of a call of limn. InputError with its last words where it fails."""
    command = [sys.executable, "-m", "tools.limn", "run", *arguments]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    answer = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if answer.returncode not in (0, REVIEW):
        words = (answer.stderr or answer.stdout).strip().splitlines() or ["no message"]
        raise InputError("failed", where="limn run", got=words[-1], hint=f"exit code {answer.returncode}")
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


# ---------------------------------------------------------------------- the page


def above_least(row: Mapping) -> float:
    """Wall seconds above what the data demand; all of them where nothing was counted."""
    return row["wall_s"] - row.get("least_s", 0.0)


def next_thing(rows: Sequence[Mapping]) -> str:
    """The phase with most seconds above its least, and the one with the largest ratio, in words."""
    phases = [row for row in rows if row["phase"] and row["phase"] != "finished subject" and row["wall_s"] >= SMALL_S]
    if not phases:
        return "Nothing takes noticeable time."
    most = max(phases, key=above_least)
    text = (f"Next: {most['phase']} of {most['case']}, {above_least(most):.2f} s above its least "
            f"({most['wall_s']:.2f} s, of which the data demand {most.get('least_s', 0.0):.3f} s).")  # fmt: skip
    counted = [row for row in phases if row.get("least_s")]
    if counted:
        far = max(counted, key=lambda row: row["wall_s"] / row["least_s"])
        text += (f" Furthest by ratio among those that could be counted: {far['phase']} of {far['case']}, "
                 f"{far['wall_s'] / far['least_s']:.0f} times.")  # fmt: skip
    return text


def profile_page(rows: Sequence[Mapping], table: Table) -> str:
    """A table of the machine, one per stage, functions of what no phase knows, and the next thing to do."""
    facts, limits = table.facts, table.beside["limits"]
    parts = [f"{facts['subject']}, preset {facts['preset']}; {' '.join(facts['settings']) or 'no other settings'}.\n",
             f"This machine at best: {limits['cores']} cores, {limits['gflops']:.0f} GFLOP/s, "
             f"{limits['memory_gb_s']:.1f} GB/s of memory, {limits['rays_per_core_s'] / 1e6:.1f} million rays a second "
             f"and core, disk {limits['disk_write_mb_s']:.0f} MB/s written and {limits['disk_read_mb_s']:.0f} read.\n",
             next_thing(rows) + "\n"]  # fmt: skip
    for case in dict.fromkeys(row["case"] for row in rows):
        own = [row for row in rows if row["case"] == case and row["phase"]]
        whole = [row for row in rows if row["case"] == case and not row["phase"]]
        head = "; ".join(f"{row['wall_s']:.1f} s, {row['cpu_s']:.1f} processor seconds, peak {row['peak_mb']:.0f} MB, "
                         f"others {row['others']:.2f} cores" for row in whole)  # fmt: skip
        parts.append(f"**{case}**" + (f": {head}" if head else "") + "\n")
        parts.append(markdown_table([_line(row) for row in own], COLUMNS))
    parts += [f"`{OTHER}` of {row['case']}: " + ", ".join(f"{name} {seconds:.2f} s" for name, seconds in
              row["functions"].items()) + "\n" for row in table.rows if row["phase"] == OTHER]  # fmt: skip
    return "\n".join(parts)


COLUMNS = ("phase", "seconds", "processor seconds", "peak, MB", "least, s", "times", "what was counted")


def _line(row: Mapping) -> dict:
    least = row.get("least_s")
    return {"phase": row["phase"], "seconds": round(row["wall_s"], 2), "processor seconds": round(row["cpu_s"], 2),
            "peak, MB": round(row["peak_mb"]) if row.get("peak_mb") else None, "least, s": least,
            "times": row["wall_s"] / least if least else None,
            "what was counted": row.get("counted", row.get("what"))}  # fmt: skip
