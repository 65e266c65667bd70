"""Which stages a run would do, and why: from manifests alone, without starting anything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from shared.contract.declare import Stage
from shared.contract.hashing import HashMemory
from shared.contract.manifest import (
    PROVENANCE,
    damage,
    file_inputs,
    make_work,
    outputs_digest,
    read_manifest,
    read_record,
    source_inputs,
)
from shared.contract.pipeline import REPOSITORY, Pipeline
from shared.contract.source import fingerprint
from tools.cases import Case

CURRENT, RUNS, WAITS = "current", "will run", "may run"
_SHOWN_FILES = 3


@dataclass(frozen=True)
class StagePlan:
    """state: CURRENT; RUNS; WAITS, which means that it depends on what earlier stages will write. case: whose stage."""

    name: str
    state: str
    reasons: tuple[str, ...] = ()
    digest: str | None = field(default=None, repr=False)
    case: Case | None = field(default=None, repr=False)


def plan_case(pipeline: Pipeline, case: Case, parameters: Mapping[str, Mapping[str, object]],
              verify: bool = False, drift: bool = False) -> dict[str, StagePlan]:
    """{label of the stage: plan} in the pipeline's order. verify: read every published file again; drift: remark where
    the code is another one than that which ran, for people: it takes a second to find out."""
    memory = HashMemory(case.run.memory, verify)
    plans: dict[str, StagePlan] = {}
    for part, name in case.jobs(pipeline):
        plan = _plan_stage(pipeline.stages[name], part, parameters[name], plans, memory)
        if drift and plan.state == CURRENT:
            plan = replace(plan, reasons=_drift(part, name))
        plans[part.label(name)] = replace(plan, case=part)
    memory.save()
    return plans


def _plan_stage(stage: Stage, case: Case, parameters: Mapping[str, object], plans: Mapping[str, StagePlan],
                memory: HashMemory) -> StagePlan:
    folder = case.run.published(stage.name)
    manifest = read_manifest(folder)
    if manifest is None:
        reason = "its manifest is missing or damaged" if folder.is_dir() else "never ran"
        return StagePlan(stage.name, RUNS, (reason,))
    inputs = source_inputs(stage, case.subject, memory) | file_inputs(stage, parameters, memory)
    needed = {name: case.label(name) for name in case.inputs(stage)}
    inputs |= {name: plans[label].digest for name, label in needed.items()}
    reasons = make_work(stage, parameters, inputs).reasons(manifest) or damage(folder, manifest, memory)
    if reasons:
        return StagePlan(stage.name, RUNS, tuple(reasons))
    waiting = [label for label in needed.values() if plans[label].state != CURRENT]
    if waiting:
        return StagePlan(stage.name, WAITS, (f"if the outputs of {', '.join(waiting)} change",))
    return StagePlan(stage.name, CURRENT, (), outputs_digest(manifest))


def _drift(case: Case, stage: str) -> tuple[str, ...]:
    """A remark where code has changed since the stage ran although its version has not."""
    provenance = read_record(case.run.published(stage) / PROVENANCE) or {}
    recorded = provenance.get("code", {})
    changed = [name for name, was in recorded.items()
               if not (REPOSITORY / name).is_file() or _fingerprint(name) != was]
    if not changed:
        return ()
    more = len(changed) - _SHOWN_FILES
    shown = ", ".join(changed[:_SHOWN_FILES]) + (f" and {more} more" if more > 0 else "")
    return (f"code changed since, its version did not: {shown}",)


_fingerprints: dict[str, str] = {}


def _fingerprint(name: str) -> str:
    if name not in _fingerprints:
        try:
            _fingerprints[name] = fingerprint(REPOSITORY / name)
        except SyntaxError:
            _fingerprints[name] = ""
    return _fingerprints[name]


def plan_lines(case: Case, plans: Mapping[str, StagePlan]) -> list[str]:
    """The plan for people."""
    width = max(map(len, plans))
    lines = [f"{case.name}: {case.run.root}"]
    for label, plan in plans.items():
        lines.append(f"  {label:{width}}  {plan.state:8}  {'; '.join(plan.reasons)}".rstrip())
    return lines
