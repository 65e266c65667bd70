"""Memory and minutes of a stage, held by a process that watches it: on one machine, too, no stage takes all there is.

The workflow says what pipeline.yaml expects of a stage (LIMN_EXPECTED_MB, LIMN_EXPECTED_MINUTES); the limits are some
times that, since a clip may be odd without being hostile. LIMN_LIMITS is a factor on both, 0 lifts them.

Resident memory of the stage and its children is what counts. A limit of the kernel's on address space (RLIMIT_AS) would
count what libraries reserve and never touch. And a process of its own watches, since decoders hold the interpreter's
lock while they take memory: a thread would not get to run.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from shared.contract.folders import RunFolder
from shared.contract.progress import Reporter
from shared.errors import InputError

if TYPE_CHECKING:
    import psutil

FACTOR = "LIMN_LIMITS"
EXPECTED_MB, EXPECTED_MINUTES = "LIMN_EXPECTED_MB", "LIMN_EXPECTED_MINUTES"
MEMORY_MARGIN, MINUTES_MARGIN = 4.0, 10.0
LEAST_MB = 3000.0
"""Decoders hold a dozen pictures of the source, whose size nobody knows before: 8K takes a gigabyte in eight bits."""
_LOOK_S, _FAMILY_S = 0.1, 2.0


@dataclass(frozen=True)
class Limits:
    """What a stage may take; None: no limit. memory in MB."""

    memory_mb: float | None = None
    minutes: float | None = None

    @classmethod
    def from_environment(cls) -> Limits:
        """As the workflow and the user say. InputError where the user's factor is none."""
        text = os.environ.get(FACTOR, "1")
        try:
            factor = float(text)
        except ValueError:
            factor = -1.0
        if not 0 <= factor < 1e6:
            raise InputError("not a factor on the limits of memory and minutes", where=FACTOR, got=text,
                             expected="a number, 1 as a rule; 0 lifts them")
        memory, minutes = (_number(os.environ.get(name)) for name in (EXPECTED_MB, EXPECTED_MINUTES))
        most = memory and max(MEMORY_MARGIN * memory, LEAST_MB)
        return cls(_times(most, factor), _times(minutes, MINUTES_MARGIN * factor))

    def __bool__(self) -> bool:
        return self.memory_mb is not None or self.minutes is not None

    def fault(self, memory_mb: float, minutes: float) -> str:
        """What is wrong and how to raise the limit; "" as long as all is well. memory_mb, minutes: what it took so
        far."""
        raise_it = f"{FACTOR}=2 doubles the limits, 0 lifts them; for good: resources in pipeline.yaml"
        if self.memory_mb is not None and memory_mb > self.memory_mb:
            return f"ended, since it took more memory than its limit of {self.memory_mb:.0f} MB; {raise_it}"
        if self.minutes is not None and minutes > self.minutes:
            return f"ended, since it took longer than its limit of {self.minutes:.3g} minutes; {raise_it}"
        return ""


def _times(expected: float | None, factor: float) -> float | None:
    return expected * factor if expected and factor else None


def _number(text: str | None) -> float | None:
    with contextlib.suppress(TypeError, ValueError):
        return float(text)
    return None


def hold_to_limits(name: str, run: RunFolder, events: Path | None) -> None:
    """From now on a process watches this one and ends it where it takes more than the environment allows.

    The watcher is no child of this process, whose memory and waiting it would be part of, and ends with it.
    """
    limits, stage = Limits.from_environment(), os.getpid()
    if not limits:
        return
    try:
        handle = os.pidfd_open(stage)
        between = os.fork()
    except (AttributeError, OSError) as error:  # no Linux, or a container that forbids it
        sys.stderr.write(f"{name}: not held to its limits of memory and minutes: {error}\n")
        return
    if between == 0:
        if os.fork() == 0:
            try:
                _watch(stage, handle, limits, name, run, events)
            except Exception:
                traceback.print_exc()
        os._exit(0)
    os.close(handle)
    os.waitpid(between, 0)


def _watch(stage: int, handle: int, limits: Limits, name: str, run: RunFolder, events: Path | None) -> None:
    """Until the stage ends, by itself or here."""
    import psutil

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    start = looked = time.monotonic()
    process, children = psutil.Process(stage), []
    while not select.select([handle], [], [], _LOOK_S)[0]:
        now = time.monotonic()
        with contextlib.suppress(psutil.Error):
            if now - looked > _FAMILY_S:
                looked, children = now, process.children(recursive=True)
            fault = limits.fault(sum(map(_resident_mb, (process, *children))), (now - start) / 60)
            if fault:
                _end(process, handle, fault, name, run, events)
                return


def _end(process: psutil.Process, handle: int, fault: str, name: str, run: RunFolder, events: Path | None) -> None:
    """Stops the stage, keeps its log as that of a failed one, tells the workflow, kills it and its children."""
    import psutil

    signal.pidfd_send_signal(handle, signal.SIGSTOP)
    try:
        log = run.keep_failed(run.temporary_of(name, process.pid), name)
        with open(log, "a", encoding="utf-8") as file:
            file.write(f"{fault}\n")
        Reporter(name, None, events).event("failed", message=fault, log=str(log), last=[])
        sys.stderr.write(f"{name}: {fault}\n{name}: the whole log: {log}\n")
        sys.stderr.flush()
    finally:
        with contextlib.suppress(psutil.Error):
            for child in process.children(recursive=True):
                child.kill()
        signal.pidfd_send_signal(handle, signal.SIGKILL)


def _resident_mb(process: psutil.Process) -> float:
    import psutil

    try:
        return process.memory_info().rss / 2**20
    except psutil.Error:  # it has just ended
        return 0.0
