"""What became of a subject, as a record: for the table at the end of a run, summary.json and the exit code."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from shared.contract.disk import FULL_BELOW_BYTES, free_bytes, replacing
from shared.contract.manifest import LOG, write_record
from shared.contract.pipeline import Pipeline
from shared.errors import InputError
from tools.cli.cases import SubjectCase
from tools.cli.gates import PICTURE, Flag, judge
from tools.cli.plan import CURRENT, StagePlan, kept_lines
from tools.cli.records import read_cost
from tools.cli.watch import Track

SCHEMA = 1
EXIT_CODES = {"done": 0, "review": 3, "input error": 2}
"""Of a subject's states; all others are 1. A run ends with 1 where there is one, else 2, else 3, else 0."""


@dataclass(frozen=True)
class Outcome:
    """One subject. state: done, review (finished, but a quality gate is missed), input error, failed, killed,
    interrupted or not run. stage: where it stopped, or the last one. minutes, memory_mb, bytes: of its finished stages,
    as they were measured when they ran. kept: results that other code or packages made than those of today.
    """

    subject: str
    folder: str
    state: str
    stage: str = ""
    reason: str = ""
    log: str = ""
    minutes: float = 0.0
    memory_mb: float = 0.0
    bytes: int = 0
    flags: tuple[Flag, ...] = ()
    picture: str = ""
    results: str = ""
    warnings: tuple[str, ...] = field(default=(), repr=False)
    kept: tuple[str, ...] = field(default=(), repr=False)


def exit_code(outcomes: Sequence[Outcome]) -> int:
    """0: all well. 1: a stage failed or was killed. 2: input at fault. 3: finished, but some need a look."""
    codes = {EXIT_CODES.get(outcome.state, 1) for outcome in outcomes}
    return next((code for code in (1, 2, 3) if code in codes), 0)


def at_fault(folder: Path, error: InputError | str, state: str = "input error", log: str = "") -> Outcome:
    """A subject that could not be started, or on which Limn itself failed."""
    name = os.fsencode(Path(os.path.abspath(folder)).name).decode(errors="replace")
    return Outcome(name, str(folder), state, reason=str(error), log=log)


def outcome_of(case: SubjectCase, pipeline: Pipeline, plans: Mapping[str, StagePlan], tracks: Sequence[Track] = (),
               interrupted: bool = False, engine_log: Path | None = None) -> Outcome:
    """What the plan after the run and the events of its stages say."""
    costs = costs_of(case, pipeline)
    facts = {"subject": case.name, "folder": str(case.subject.folder), "results": str(case.run.root), **costs,
             "kept": tuple(kept_lines(plans))}
    left = [name for name, plan in plans.items() if plan.state != CURRENT]
    if not left:
        flags = tuple(judge(case.run, pipeline)) if pipeline.wanted == set(pipeline.steps) else ()
        picture = str(case.run.work / PICTURE) if flags else ""
        return Outcome(state="review" if flags else "done", stage=list(plans)[-1], flags=flags, picture=picture,
                       reason="; ".join(map(str, flags)), **facts)
    by_state = {track.state: track for track in reversed(tracks)}
    if interrupted:
        return Outcome(state="interrupted", stage=left[0], reason="interrupted", **facts)
    for state in ("failed", "input error"):
        if track := by_state.get(state):
            return Outcome(state=state, stage=track.stage, reason=track.message, log=track.log, **facts)
    if track := by_state.get("running"):
        log = plans[track.stage].case.run.failed(plans[track.stage].name) / LOG
        return Outcome(state="killed", stage=track.stage, log=str(log) if log.is_file() else "",
                       reason=f"{track.stage} was killed without a message (out of memory?)", **facts)
    if free_bytes(case.run.work) < FULL_BELOW_BYTES:
        reason = f"no space left on the disk: {case.run.work}"
        return Outcome(state="input error", stage=left[0], reason=reason, **facts)
    return Outcome(state="not run", stage=left[0], reason="the workflow engine failed",
                   log=str(engine_log) if engine_log and engine_log.is_file() else "", **facts)


def costs_of(case: SubjectCase, pipeline: Pipeline) -> dict[str, object]:
    """Minutes in all, highest memory, bytes and warnings of the published stages."""
    costs = [read_cost(part.run.published(name)) for part, name in case.jobs(pipeline)]
    return {"minutes": round(sum(cost.wall_s or 0.0 for cost in costs) / 60, 2),
            "memory_mb": max((cost.peak_memory_mb or 0.0 for cost in costs), default=0.0),
            "bytes": sum(int(cost.bytes or 0) for cost in costs),
            "warnings": tuple(text for cost in costs for text in cost.warnings)}


def write_summary(path: Path, outcomes: Sequence[Outcome], started: str, seconds: float) -> None:
    """summary.json: whole, or as it was before."""
    record = {"schema": SCHEMA, "started": started, "seconds": round(seconds, 1), "exit_code": exit_code(outcomes),
              "subjects": [asdict(outcome) for outcome in outcomes]}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            write_record(temporary, record)
    except OSError as error:
        raise InputError("the summary cannot be written", where=str(path), got=error.strerror,
                         hint="name another place with --summary FILE") from error
