"""Records of earlier runs, read back: what is not of its kind counts as not recorded, since the folder that they lie in
may come from anybody, or from a disk that failed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from shared.contract.manifest import PROVENANCE, read_record

PICTURE = "review.png"
"""The picture that shows why a result is flagged; beside the records."""
_LARGEST = 1e15


@dataclass(frozen=True)
class RecordedCost:
    """What a published stage took, as its provenance.json says; None where it does not say."""

    wall_s: float | None = None
    peak_memory_mb: float | None = None
    bytes: float | None = None
    started: str | None = None
    warnings: tuple[str, ...] = ()


def read_cost(folder: Path) -> RecordedCost:
    """The cost of the stage that is published in the folder."""
    record = read_record(folder / PROVENANCE) or {}
    started, warnings = record.get("started"), record.get("warnings")
    return RecordedCost(*(amount_of(record, name) for name in ("wall_s", "peak_memory_mb", "bytes")),
                        started if is_line(started) else None,
                        tuple(filter(is_line, warnings)) if isinstance(warnings, list) else ())


def amount_of(record: object, name: str) -> float | None:
    """The record's finite number of that name that is not negative; None where there is none."""
    value = number_of(record, name)
    return value if value is not None and 0 <= value <= _LARGEST else None


def number_of(record: object, name: str) -> float | None:
    """The record's finite number of that name; None where there is none."""
    value = record.get(name) if isinstance(record, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return value if abs(value) <= _LARGEST and math.isfinite(value) else None


def is_line(value: object) -> bool:
    """Whether it is text that a terminal can show."""
    return isinstance(value, str) and value.isprintable()
