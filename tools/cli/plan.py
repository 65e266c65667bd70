"""Which stages a run would do, and why: from manifests alone, without starting anything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from shared.contract.declare import Stage
from shared.contract.drift import drift
from shared.contract.hashing import HashMemory
from shared.contract.manifest import damage, make_work, outputs_digest, own_inputs, read_manifest
from shared.contract.pipeline import Pipeline
from tools.cli.cases import SubjectCase

CURRENT, RUNS, WAITS = "current", "will run", "may run"


@dataclass(frozen=True)
class StagePlan:
    """state: CURRENT; RUNS; WAITS, which means that it depends on what earlier stages will write. reasons: of a current
    stage what has changed of the code and the packages that made it. case: whose stage."""

    name: str
    state: str
    reasons: tuple[str, ...] = ()
    digest: str | None = field(default=None, repr=False)
    case: SubjectCase | None = field(default=None, repr=False)


def plan_case(pipeline: Pipeline, case: SubjectCase, parameters: Mapping[str, Mapping[str, object]],
              verify: bool = False, renew: bool = False) -> dict[str, StagePlan]:
    """{label of the stage: plan} in the pipeline's order. verify: read every published file again. renew: a stage runs,
    too, where other code or packages made its result."""
    memory = HashMemory(case.run.memory, verify)
    plans: dict[str, StagePlan] = {}
    for part, name in case.jobs(pipeline):
        plan = _plan_stage(pipeline.stages[name], part, parameters[name], plans, memory)
        if plan.state == CURRENT or renew and plan.state == WAITS:
            plan = _with_drift(plan, drift(part.run.published(name), pipeline.code_roots), renew)
        plans[part.label(name)] = replace(plan, case=part)
    memory.save()
    return plans


def _plan_stage(stage: Stage, case: SubjectCase, parameters: Mapping[str, object], plans: Mapping[str, StagePlan],
                memory: HashMemory) -> StagePlan:
    folder = case.run.published(stage.name)
    manifest = read_manifest(folder)
    if manifest is None:
        reason = "its manifest is missing or damaged" if folder.is_dir() else "never ran"
        return StagePlan(stage.name, RUNS, (reason,))
    inputs = own_inputs(stage, case.subject, parameters, memory)
    needed = {name: case.label(name) for name in case.inputs(stage)}
    inputs |= {name: plans[label].digest for name, label in needed.items()}
    reasons = make_work(stage, parameters, inputs).reasons(manifest) or damage(folder, manifest, memory)
    if reasons:
        return StagePlan(stage.name, RUNS, tuple(reasons))
    waiting = [label for label in needed.values() if plans[label].state != CURRENT]
    if waiting:
        return StagePlan(stage.name, WAITS, (f"if the outputs of {', '.join(waiting)} change",))
    return StagePlan(stage.name, CURRENT, (), outputs_digest(manifest))


def _with_drift(plan: StagePlan, remarks: Sequence[str], renew: bool) -> StagePlan:
    """The plan of a stage whose result other code or packages made: kept, or to be done again."""
    if not remarks:
        return plan
    return replace(plan, state=RUNS, reasons=tuple(remarks), digest=None) if renew else replace(
        plan, reasons=tuple(f"kept although {remark}" for remark in remarks))


def kept_lines(plans: Mapping[str, StagePlan]) -> list[str]:
    """One line for each current stage that other code or packages made."""
    return [f"{label}: {reason}" for label, plan in plans.items() if plan.state == CURRENT for reason in plan.reasons]


def plan_lines(case: SubjectCase, plans: Mapping[str, StagePlan]) -> list[str]:
    """The plan for people."""
    width = max(map(len, plans))
    lines = [f"{case.name}: {case.run.root}"]
    for label, plan in plans.items():
        lines.append(f"  {label:{width}}  {plan.state:8}  {'; '.join(plan.reasons)}".rstrip())
    return lines
