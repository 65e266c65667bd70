"""Runs the cases of tools/bench/chart/bench.py and measures each stage from outside its process.

Cases that agree in their first stages share them: a run is a path in a tree of folders, one per stage and parameters,
WORK/repeat<n>/<key>/<subject>/work/. A stage that is cut off is done again, one that is done is kept as long as its
code is the same.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from shared.contract.declare import folder_of
from shared.contract.hashing import hash_file, hash_value
from shared.contract.manifest import PROVENANCE, outputs_digest, read_manifest
from shared.contract.pipeline import REPOSITORY, Pipeline, split_settings
from shared.contract.source import fingerprint
from shared.contract.subject import Subject
from shared.io.arrays import read_json, write_json
from tools.bench.chart.cases import ChartCase
from tools.bench.runner import measured

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
