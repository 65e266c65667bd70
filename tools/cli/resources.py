"""What the jobs of a run book: memory and minutes by the work's real size, and what this machine has to give."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

from shared.contract.limits import EXPECTED_MB, EXPECTED_MINUTES
from shared.contract.needs import WorkSize, amount, measured_scale

KINDS = ("mem_mb", "runtime")
KEPT_FREE = 0.1
_CGROUP = Path("/sys/fs/cgroup")


def requested(needs: Mapping[str, Mapping[str, float]], kind: str, scale: Mapping[str, float], run: Path, attempt: int,
              limit: int | None = None, overhead: int = 0) -> int:
    """Megabytes or minutes of one job. run: the folder that holds work/. attempt: 1, 2 ..: as many times the amount.

    limit: no more than that, since a job that asks for more than there is would wait for ever. overhead: added once.
    """
    needed = attempt * amount(needs, kind, measured_scale(run, WorkSize(**scale))) + overhead
    return needed if limit is None else min(needed, limit)


def expected(resources: object) -> str:
    """What a job has requested, as assignments of a shell; its limits follow, see shared/contract/limits.py."""
    names = {"mem_mb": EXPECTED_MB, "runtime": EXPECTED_MINUTES}
    requested_of = {kind: getattr(resources, kind, None) for kind in names}
    return " ".join(f"{names[kind]}={value}" for kind, value in requested_of.items() if isinstance(value, int))


def memory_to_give() -> int:
    """MB that the jobs may take together: what is available now, within the control group's limit, less a tenth."""
    import psutil

    available = psutil.virtual_memory().available
    with contextlib.suppress(OSError, ValueError):
        limit = int((_CGROUP / "memory.max").read_text())
        available = min(available, limit - int((_CGROUP / "memory.current").read_text()))
    return max(1, int(available * (1 - KEPT_FREE) / 2**20))
