"""Quality gates: whether a finished subject is good enough to be handed on unseen, and the picture that shows why not.

pipeline.yaml sets the thresholds. A subject that misses one is finished all the same, and flagged `review`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

from shared.contract.folders import RunFolder
from shared.contract.manifest import outputs_digest, read_manifest, read_record, write_record
from shared.contract.pipeline import Pipeline
from shared.contract.wording import unknown_name
from tools.cli.measures import MEASURES
from tools.cli.records import PICTURE, is_line, number_of

RECORD = "quality.json"


@dataclass(frozen=True)
class Flag:
    """A gate that was missed."""

    gate: str
    value: float
    limit: str

    def __str__(self) -> str:
        return f"{self.gate} {self.value:.3g} (expected {self.limit})"


def check_gates(pipeline: Pipeline) -> None:
    """InputError for a gate that nobody can measure."""
    for name in pipeline.gates:
        if name not in MEASURES:
            raise unknown_name("gate", name, MEASURES, f"{pipeline.path}: gates")


def judge(run: RunFolder, pipeline: Pipeline) -> list[Flag]:
    """The gates that a finished result misses; the verdict is kept beside the result, a picture where it is bad."""
    if not pipeline.gates:
        return []
    asked = {name: asdict(gate) for name, gate in pipeline.gates.items()}
    results = {name: outputs_digest(manifest) for name in pipeline.steps
               if (manifest := read_manifest(run.published(name))) is not None}
    before = read_record(run.work / RECORD)
    if before and before.get("gates") == asked and before.get("results") == results:
        if (flags := _flags_of(before)) is not None:
            return flags
    values = {name: MEASURES[name](run) for name in pipeline.gates}
    flags = [Flag(name, value, pipeline.gates[name].limit) for name, value in values.items()
             if value is not None and not pipeline.gates[name].holds(value)]
    if flags:
        from tools.cli.review_picture import write_review

        write_review(run, [flag.gate for flag in flags], [str(flag) for flag in flags])
    else:
        (run.work / PICTURE).unlink(missing_ok=True)
    write_record(run.work / RECORD, {"gates": asked, "results": results, "values": values,
                                     "flags": [asdict(flag) for flag in flags]})
    return flags


def read_flags(run: RunFolder) -> list[Flag]:
    """The gates that were missed when the result was last judged; none where the record is absent or damaged."""
    return _flags_of(read_record(run.work / RECORD)) or []


def _flags_of(record: object) -> list[Flag] | None:
    """The record's flags; None where it does not hold any that could have been written."""
    flags = record.get("flags") if isinstance(record, dict) else None
    if not isinstance(flags, list):
        return None
    for flag in flags:
        if not isinstance(flag, dict) or flag.keys() != {"gate", "value", "limit"}:
            return None
        if number_of(flag, "value") is None or not (is_line(flag["gate"]) and is_line(flag["limit"])):
            return None
    return [Flag(**flag) for flag in flags]


