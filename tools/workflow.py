"""Runs the pipeline on subjects with Snakemake: only what is not current, each stage in its own process.

Snakemake decides order and parallelism; whether a stage has to run is decided by content (tools/plan.py and the stage
itself). Each call gets a scratch folder for Snakemake's state, so nothing stale can lock the next one; that no two runs
work on one subject is held by a lock that the kernel releases with its process.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from shared.contract.folders import RunFolder
from shared.contract.manifest import LOG, PROVENANCE, read_record, write_record
from shared.contract.pipeline import REPOSITORY, Pipeline
from shared.errors import InputError
from tools.cases import Case
from tools.plan import CURRENT, StagePlan, plan_case
from tools.watch import Track, Watch

_POLL_S, _DYING_S = 0.2, 2.0
_SET_PARENT_DEATH_SIGNAL = 1
_WORKFLOW_LOG = "workflow.log"


@dataclass(frozen=True)
class Settings:
    """How to run. parameters: {stage: {parameter: value}}. arguments: what hands them to each stage's command line."""

    pipeline: Pipeline
    parameters: Mapping[str, Mapping[str, object]]
    arguments: Mapping[str, Sequence[str]]
    out: Path | None
    cores: int
    profile: str | None = None


def run_cases(cases: Sequence[Case], settings: Settings) -> int:
    """Brings every subject up to date; returns the exit code (2 where only input was at fault)."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    with contextlib.ExitStack() as stack:
        for case in cases:
            stack.enter_context(case.run.locked("run"))
        plans = []
        for case in cases:
            clear_leftovers(case.run, settings.pipeline)
            for path in case.run.work.glob(".workflow-*"):
                shutil.rmtree(path, ignore_errors=True)
            plans.append(plan_case(settings.pipeline, case, settings.parameters))
            _renew_stamps(case.run, plans[-1])
        waiting = [case for case, plan in zip(cases, plans, strict=True) if not _is_current(plan)]
        for case in cases:
            if case not in waiting:
                _say(f"{case.name}: current, nothing to do: {case.run.root}")
        return _run_waiting(waiting, settings) if waiting else 0


def clear_leftovers(run: RunFolder, pipeline: Pipeline, keep_logs: bool = True) -> None:
    """Removes temporary folders that killed stages left; the log may be kept as a failed stage's.

    The caller holds the run's lock. A stage that somebody runs by hand at this moment keeps its folder.
    """
    if not run.work.is_dir():
        return
    for name in pipeline.steps:
        with contextlib.suppress(InputError), run.locked(name, _DYING_S):
            for path in run.leftovers(name):
                if keep_logs and (path / LOG).is_file() and ".tmp-" in path.name:
                    run.keep_failed(path, name)
            run.remove_leftovers(name)


def _renew_stamps(run: RunFolder, plans: Mapping[str, StagePlan]) -> None:
    """Stamps of current stages are written, all others removed: Snakemake then does just what the plan says."""
    for plan in plans.values():
        if plan.state == CURRENT:
            run.write_stamp(plan.name)
        else:
            run.stamp(plan.name).unlink(missing_ok=True)


def _is_current(plans: Mapping[str, StagePlan]) -> bool:
    return all(plan.state == CURRENT for plan in plans.values())


def _run_waiting(cases: Sequence[Case], settings: Settings) -> int:
    """Calls Snakemake for the subjects that are not current and says how each ended."""
    start = time.monotonic()
    with _scratch(cases[0].run) as scratch:
        tracks = _prepare(scratch, cases, settings)
        watch = Watch([track for tracks_of_case in tracks for track in tracks_of_case])
        try:
            interrupted = not _follow(_snakemake(scratch, settings), scratch / _WORKFLOW_LOG, watch)
        finally:
            watch.close()
        if interrupted:
            for case in cases:
                clear_leftovers(case.run, settings.pipeline, keep_logs=False)
        codes = [_conclude(case, own, settings, scratch / _WORKFLOW_LOG, time.monotonic() - start, interrupted)
                 for case, own in zip(cases, tracks, strict=True)]
    return 1 if 1 in codes else max(codes)


@contextlib.contextmanager
def _scratch(run: RunFolder) -> Iterator[Path]:
    """A folder for Snakemake's state and the stages' events, removed in the end."""
    path = run.work / f".workflow-{os.getpid()}"
    (path / "events").mkdir(parents=True)
    (path / "runs").mkdir()
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _prepare(scratch: Path, cases: Sequence[Case], settings: Settings) -> list[list[Track]]:
    """Writes Snakemake's configuration; returns the event files of each subject's stages."""
    pipeline, runs, tracks = settings.pipeline, {}, []
    for i, case in enumerate(cases):
        (scratch / "runs" / str(i)).symlink_to(case.run.root, target_is_directory=True)
        events = {name: scratch / "events" / f"{i}-{name}.jsonl" for name in pipeline.steps}
        runs[str(i)] = {name: _command(name, case, settings, path) for name, path in events.items()}
        tracks.append([Track(case.name, name, path) for name, path in events.items()])
    stages = {name: {"needs": list(step.needs), "threads": min(step.threads or settings.cores, settings.cores),
                     "resources": dict(step.resources)} for name, step in pipeline.steps.items()}
    write_record(scratch / "config.json", {"runs": runs, "stages": stages})
    return tracks


def _command(name: str, case: Case, settings: Settings, events: Path) -> str:
    """The shell command of one stage."""
    pipeline = settings.pipeline
    command = [sys.executable, "-m", "shared.contract.launch", str(pipeline.root), pipeline.package, name,
               "--subject", str(case.subject.folder), "--pipeline", str(pipeline.path), "--events", str(events)]
    if settings.out:
        command += ["--out", os.path.abspath(settings.out)]
    return shlex.join([*command, *settings.arguments[name]])


def _snakemake(scratch: Path, settings: Settings) -> subprocess.Popen:
    """Snakemake, started in a process group of its own that dies with this process."""
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(Path(__file__).with_name("Snakefile")),
               "--directory", str(scratch), "--configfile", str(scratch / "config.json"),
               "--cores", str(settings.cores), "--keep-going", "--nolock", "--rerun-incomplete",
               "--rerun-triggers", "mtime", "--nocolor"]
    if settings.profile:
        command += ["--profile", settings.profile]
    search = [str(REPOSITORY), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, search))}
    with open(scratch / _WORKFLOW_LOG, "wb") as log:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                                env=environment, cwd=scratch, start_new_session=True, preexec_fn=_die_with_parent)


def _die_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)


def _follow(process: subprocess.Popen, log: Path, watch: Watch) -> bool:
    """Shows events until Snakemake ends; False where the user interrupted it."""
    try:
        while process.poll() is None:
            watch.poll()
            time.sleep(_POLL_S)
        watch.poll()
        return True
    except KeyboardInterrupt:
        return False
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _conclude(case: Case, tracks: Sequence[Track], settings: Settings, log: Path, seconds: float,
              interrupted: bool) -> int:
    """Says how the subject's run ended, keeps Snakemake's log; returns the subject's exit code."""
    failed = [track for track in tracks if track.state in ("failed", "input error")]
    plans = plan_case(settings.pipeline, case, settings.parameters)
    published = any(case.run.published(name).exists() or case.run.failed(name).exists() for name in plans)
    if published:
        shutil.copyfile(log, case.run.work / _WORKFLOW_LOG)
    if _is_current(plans):
        _say(f"{case.name}: done in {seconds:.1f} s: {_result(case)}")
        return 0
    left = [name for name, plan in plans.items() if plan.state != CURRENT]
    if interrupted:
        _say(f"{case.name}: interrupted; limn run again goes on with {left[0]}")
        return 1
    if failed:
        later = [name for name in left if name not in {track.stage for track in failed}]
        _say(f"{case.name}: not done" + (f"; not run: {', '.join(later)}" if later else ""))
        return 1 if any(track.state == "failed" for track in failed) else 2
    _conclude_silent(case, tracks, settings.pipeline, log, published)
    return 1


def _conclude_silent(case: Case, tracks: Sequence[Track], pipeline: Pipeline, log: Path, published: bool) -> None:
    """For a stage that ended without a word (killed, out of memory) or a Snakemake that could not start."""
    running = [track.stage for track in tracks if track.state == "running"]
    if not running:
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines()[-15:]:
            _say(f"| {line}")
        _say(f"{case.name}: the workflow engine failed" + (f"; its log: {case.run.work / _WORKFLOW_LOG}" * published))
        return
    clear_leftovers(case.run, pipeline)
    for name in running:
        _say(f"{case.name}: {name} was killed without a message (out of memory?); its log: "
             f"{case.run.failed(name) / LOG}; limn run again goes on there")


def _result(case: Case) -> Path:
    """The report where there is one, else the export folder, else the run's folder."""
    export = case.run.root / "export"
    report = export / "report.html"
    return report if report.is_file() else export if export.is_dir() else case.run.root


def seconds_of(run: RunFolder, name: str) -> float | None:
    """Wall seconds that the published stage took."""
    provenance = read_record(run.published(name) / PROVENANCE)
    return provenance.get("wall_s") if provenance else None


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _interrupt(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt
