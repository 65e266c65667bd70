"""What one call of a stage asks for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from shared.contract.declare import Stage
from shared.contract.folders import RunFolder
from shared.contract.pipeline import REPOSITORY
from shared.contract.subject import Subject


@dataclass(frozen=True)
class Request:
    """What one call of a stage asks for, checked. roots: where the code lies whose changes are noticed."""

    stage: Stage
    subject: Subject
    run: RunFolder
    parameters: dict[str, object]
    threads: int
    force: bool
    verify: bool
    events: Path | None
    disk_mb: float | None = None
    renew: bool = False
    roots: tuple[Path, ...] = (REPOSITORY,)
