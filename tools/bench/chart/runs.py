"""Runs the cases of tools/bench/chart/command.py and measures each stage from outside its process.

Cases that agree in their first stages share them: a run is a path in a tree of folders, one per stage and parameters,
WORK/repeat<n>/<key>/<subject>/work/. A stage that is cut off is done again, one that is done is kept as long as its
code is the same.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from shared.contract.declare import folder_of
from shared.contract.hashing import hash_file, hash_value
from shared.contract.manifest import PROVENANCE, outputs_digest, read_manifest
from shared.contract.pipeline import REPOSITORY, Pipeline, split_settings
from shared.contract.source import fingerprint
from shared.contract.subject import Subject
from shared.errors import InputError
from shared.io.arrays import read_json, write_json
from tools.bench.chart.cases import ChartCase

MEASURED, COST = "measured.json", "cost.json"
SHOWN = 12
"""Characters of a fingerprint that are kept."""
_TRACKED, _SOLVED, _EXPORTED = "track_landmarks", "inverse_render", "export_usd"
PEER_CODE = ("tools/bench/peers/inverse.py", "tools/bench/peers/mitsuba.py")


@dataclass(frozen=True)
class ProcessCost:
    """wall_s, cpu_s and peak_mb of one process and its children; others: cores that other work kept busy meanwhile."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    others: float


@dataclass(frozen=True)
class Solved:
    """One result: the folder that holds maps, mesh and poses; digest of its content; {stage: Cost}; code: {file:
    fingerprint} of what made it; at: for a peer, the seconds after which it was looked at."""

    folder: Path
    digest: str
    costs: Mapping[str, ProcessCost]
    code: Mapping[str, str]
    at: float | None = None


def current_code(code: Mapping[str, str]) -> bool:
    """Whether these files have the fingerprints that they had then."""
    return all((REPOSITORY / name).is_file() and _fingerprint(name) == was for name, was in code.items())


_known: dict[str, str] = {}


def _fingerprint(name: str) -> str:
    if name not in _known:
        _known[name] = fingerprint(REPOSITORY / name)[:SHOWN]
    return _known[name]


def fingerprints(names: Sequence[str]) -> dict[str, str]:
    """{file of the repository: fingerprint as it is now}."""
    return {name: _fingerprint(name) for name in names}


class Runs:
    """One repeat's tree of runs below work. subject_key: of the subject's content."""

    def __init__(self, work: Path, subject: Subject, subject_key: str, pipeline: Pipeline, peer_python: str):
        self.work, self.subject, self.pipeline, self.peer_python = work, subject, pipeline, peer_python
        self.subject_key = subject_key

    def solve(self, case: ChartCase) -> list[Solved]:
        """The case's results: one, or a peer's at each of its seconds. InputError where a stage fails."""
        parameters = self._parameters(case)
        names = list(self.pipeline.stages)
        last = _TRACKED if case.seconds else _EXPORTED if case.whole else _SOLVED
        key, costs, code, node = self.subject_key, {}, {}, None
        for name in names[: names.index(last) + 1]:
            key = hash_value([key, name, parameters[name], len(os.sched_getaffinity(0))])[:16]
            node = self._stage(name, case, key, node, code)
            record = read_json(node / MEASURED)
            costs[name], code = ProcessCost(**record["cost"]), record["code"]
        if case.seconds:
            return self._peer(case, key, node, costs, code)
        root = node / self.subject.name
        folder = root / folder_of(_SOLVED)
        return [Solved(folder, outputs_digest(read_manifest(folder)), costs, code)]

    def _parameters(self, case: ChartCase) -> dict[str, dict[str, object]]:
        given = split_settings(case.settings, self.pipeline.stages)
        stages = self.pipeline.stages
        return {name: self.pipeline.parameters(stage, case.preset, given.get(name, {})) for name, stage in
                stages.items()}  # fmt: skip

    def _stage(self, name: str, case: ChartCase, key: str, parent: Path | None, code: Mapping[str, str]) -> Path:
        """The node of a stage, done now unless it is there; code: of the stages before it."""
        node = self.work / key
        if (node / MEASURED).is_file():
            if current_code(read_json(node / MEASURED)["code"]):
                return node
        shutil.rmtree(node, ignore_errors=True)
        if parent is not None:
            # Links on the file system share the content; a stage never writes into another's folder.
            shutil.copytree(parent / self.subject.name, node / self.subject.name, copy_function=os.link)
        given = split_settings(case.settings, self.pipeline.stages).get(name, {})
        arguments = ["--subject", str(self.subject.folder), "--out", str(node), "--preset", case.preset]
        arguments += ["--pipeline", str(self.pipeline.path)]
        arguments += [f"--set={setting}={value}" for setting, value in given.items()]
        home = [str(self.pipeline.root), self.pipeline.package]
        launcher = [sys.executable, "-m", "shared.contract.launch", *home, name]
        cost = measured([*launcher, *arguments], self.work / f"{key}.log")
        root = node / self.subject.name
        folder = root / folder_of(name)
        provenance = read_json(folder / PROVENANCE)
        code = {**code, **{file: digest[:SHOWN] for file, digest in provenance["code"].items()}}
        cost["peak_mb"] = provenance["peak_memory_mb"]
        write_json(node / MEASURED, {"stage": name, "cost": cost, "code": code})
        return node

    def _peer(self, case: ChartCase, key: str, tracked: Path, costs: dict, code: dict) -> list[Solved]:
        """The peer's process on the tracked run; it measures itself at each of its seconds."""
        node = self.work / hash_value([key, case.name, case.seconds, self.peer_python])[:16]
        own = code | fingerprints(PEER_CODE)
        places = {at: node / f"{at:g}" for at in case.seconds}
        done = (node / MEASURED).is_file() and current_code(read_json(node / MEASURED)["code"])
        if not done:
            shutil.rmtree(node, ignore_errors=True)
            seconds = [f"{at:g}" for at in case.seconds]
            command = [self.peer_python, "-m", "tools.bench.peers.inverse", str(self.subject.folder),
                       str(tracked / self.subject.name), str(node), "--at", *seconds]  # fmt: skip
            cost = measured(command, self.work / f"{node.name}.log")
            write_json(node / MEASURED, {"stage": case.name, "cost": cost, "code": own})
        others = read_json(node / MEASURED)["cost"]["others"]
        found = []
        for at, folder in places.items():
            cost = costs | {case.name: ProcessCost(**read_json(folder / COST), others=others)}
            digest = hash_value([hash_file(path) for path in sorted(folder.rglob("*.*")) if path.name != COST])
            found.append(Solved(folder, digest, cost, own, at))
        return found

    def discard_solved(self) -> None:
        """Removes what is large and serves one case only; earlier stages stay for the cases to come."""
        for record in self.work.glob(f"*/{MEASURED}"):
            if read_json(record)["stage"] not in ("sample_frames", _TRACKED, "init_albedo"):
                shutil.rmtree(record.parent)


def measured(command: Sequence[str], log: Path) -> dict[str, float]:
    """Runs a command to its end -> wall_s, cpu_s and others of its Cost; its memory only the process itself can tell
    from that of its parent. InputError with its last words where it fails."""
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
    if process.returncode:
        words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["no message"]
        ended = f"exit code {process.returncode}; its log: {log}"
        raise InputError("failed", where=" ".join(command[:6]), got=words[-1], hint=ended)
    others = max(0.0, (_busy_seconds() - busy - cpu) / wall)
    return {"wall_s": round(wall, 3), "cpu_s": round(cpu, 3), "others": round(others, 2)}


def _busy_seconds() -> float:
    """Processor seconds that all cores of this machine have worked since it started."""
    times = psutil.cpu_times()
    return sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0)
