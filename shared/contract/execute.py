"""Does a stage's work in a temporary folder, checks it, describes it and publishes it."""

from __future__ import annotations

import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from shared.contract.currency import input_hashes, work_to_do
from shared.contract.declare import EXPORT
from shared.contract.disk import check_space, disk_fault
from shared.contract.hashing import HashMemory
from shared.contract.job import Job
from shared.contract.manifest import LOG, MANIFEST, PROVENANCE, Work, output_entries, volatile_entries, write_record
from shared.contract.progress import Reporter
from shared.contract.provenance import Meter, environment
from shared.contract.request import Request
from shared.contract.source import loaded_code, loaded_sources
from shared.contract.sums import write_sums
from shared.errors import InputError, LimnError

_LAST_LINES = 20


def execute(request: Request, run: Callable[[Job], None], check: Callable[[Job], None] | None) -> int:
    """0 when the folder is published; 1 when the stage failed, its log is kept then. InputError leaves nothing.

    All that the stage will read is read once before, so that a bit that flipped on the disk is noticed.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    name, folders = request.stage.name, request.run
    memory = HashMemory(folders.memory, verify=True)
    try:
        work = work_to_do(request.stage, request.subject, folders, request.parameters, memory)
    except InputError:
        memory.save()  # so that the next plan knows of the damage, too
        raise
    check_space(folders.work, request.disk_mb)
    temporary = folders.temporary(name)
    reporter = Reporter(name, None, request.events)
    try:
        reporter = Reporter(name, temporary / LOG, request.events)
        reporter.event("started")
        seconds = _do(request, work, run, check, temporary, reporter, memory)
    except InputError:
        reporter.close()
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    except KeyboardInterrupt:
        reporter.close()
        shutil.rmtree(temporary, ignore_errors=True)
        sys.stderr.write(f"{name}: interrupted\n")
        return 1
    except Exception as error:
        if (fault := disk_fault(error, folders.work)) is not None:
            reporter.close()
            shutil.rmtree(temporary, ignore_errors=True)
            raise fault from error
        return _failed(request, temporary, reporter, error)
    reporter.event("done", seconds=seconds)
    if not request.events:
        sys.stderr.write(f"{name}: done in {seconds:.1f} s: {folders.published(name)}\n")
    return 0


def _do(request: Request, work: Work, run: Callable[[Job], None], check: Callable[[Job], None] | None,
        temporary: Path, reporter: Reporter, memory: HashMemory) -> float:
    """Runs, checks, publishes; returns the wall seconds."""
    stage, folders = request.stage, request.run
    inputs = folders.inputs(stage, [clip.name for clip in request.subject.clips])
    job = Job(stage, request.subject, request.parameters, temporary, inputs, reporter, request.threads)
    meter = Meter()
    try:
        run(job)
        if check:
            check(job)
    finally:
        cost = meter.stop()
    after = input_hashes(stage, request.subject, folders, request.parameters, HashMemory(folders.memory))
    if after != work.inputs:
        raise LimnError(f"{stage.name}: an input changed while the stage ran; run it again")
    entries = output_entries(stage, temporary)
    write_record(temporary / MANIFEST, {**work.content(), "key": work.key, "outputs": entries})
    size = sum(path.stat().st_size for path in temporary.rglob("*") if path.is_file())
    volatile = volatile_entries(temporary, entries)
    provenance = {**cost, **environment(), "code": loaded_code(request.roots), "sources": loaded_sources(request.roots),
                  "threads": request.threads, "warnings": reporter.warnings, "bytes": size, "volatile": volatile}
    write_record(temporary / PROVENANCE, provenance)
    reporter.write_log(f"done in {cost['wall_s']} s, peak memory {cost['peak_memory_mb']} MB")
    reporter.close()
    if stage.folder == EXPORT:
        write_sums(temporary)
    folders.publish(temporary, stage.name)
    published = folders.published(stage.name)
    for name, entry in {**entries, **volatile}.items():
        memory.learn(published / name, entry["sha256"])
    memory.save()
    folders.write_stamp(stage.name)
    return cost["wall_s"]


def _failed(request: Request, temporary: Path, reporter: Reporter, error: Exception) -> int:
    """Keeps the log with the trace and says where it is."""
    name = request.stage.name
    reporter.write_trace()
    reporter.close()
    log = request.run.keep_failed(temporary, name)
    message = " ".join(str(error).split()) or "no message"
    if not isinstance(error, LimnError):
        message = f"{type(error).__name__}: {message}"
    last = log.read_text(encoding="utf-8").splitlines()[-_LAST_LINES:] if log.is_file() else []
    reporter.event("failed", message=message, log=str(log), last=last)
    sys.stderr.write("\n".join([*last, f"{name}: failed: {message}", f"{name}: the whole log: {log}"]) + "\n")
    return 1


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
