"""Runs the pipeline on subjects: only what is not current, each stage in its own process, then says how it went.

Whether a stage has to run is decided by content (tools/cli/plan.py and the stage itself); order and parallelism are the
engine's. That no two runs work on one subject is held by a lock that the kernel releases with its process.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from shared.contract.folders import RunFolder
from shared.contract.manifest import LOG, MANIFEST
from shared.contract.pipeline import Pipeline
from shared.errors import InputError
from tools.cli.cases import InputErrors, Opened, SubjectCase, no_access, one_line
from tools.cli.cluster import keep_slurm_logs
from tools.cli.engine import SCRATCH, EngineSettings, configure, run_engine, scratch_folder
from tools.cli.outcome import Outcome, at_fault, exit_code, outcome_of, write_summary
from tools.cli.overview import load_pictures, page_beside, write_overview
from tools.cli.plan import CURRENT, StagePlan, kept_lines, plan_case
from tools.cli.summary import table_lines
from tools.cli.watch import Track, Watch

_DYING_S = 2.0
_WORKFLOW_LOG = "workflow.log"


def run_cases(opened: Opened, settings: EngineSettings) -> int:
    """Brings every subject up to date, whatever becomes of the others; returns the exit code, see
    tools/cli/outcome.py."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    start, started = time.monotonic(), datetime.now(UTC).isoformat(timespec="seconds")
    faults, crashed = list(opened.faults), []
    with contextlib.ExitStack() as stack:
        planned: list[tuple[SubjectCase, dict[str, StagePlan]]] = []
        for case in opened.cases:
            try:
                planned.append((case, _begin(stack, case, settings)))
            except InputError as error:
                faults.append((case.subject.folder, error))
            except Exception as error:  # of one subject; it must not stop the others
                crashed.append(_crash(case, error))
        if not planned and not crashed:
            raise InputErrors([error for _, error in faults])
        for _, error in faults:
            _say(f"limn: {error}")
        waiting = [case for case, plan in planned if not is_current(plan)]
        for case, plan in planned:
            if is_current(plan):
                _say(f"{case.name}: current, nothing to do: {case.run.root}")
                _say_kept(case, plan)
        ended = _run_waiting(waiting, settings, start) if waiting else {}
        outcomes = [at_fault(folder, error) for folder, error in faults] + crashed
        outcomes += [ended.get(case.name) or _guarded(case, partial(outcome_of, case, settings.pipeline, plan))
                     for case, plan in planned]
    return _finish(outcomes, settings, started, time.monotonic() - start)


def _finish(outcomes: Sequence[Outcome], settings: EngineSettings, started: str, seconds: float) -> int:
    """The table, summary.json and the page beside it; returns the exit code."""
    if len(outcomes) > 1 or any(outcome.flags for outcome in outcomes):
        _say("\n".join(table_lines(outcomes)))
    if settings.summary:
        page = page_beside(settings.summary)
        try:
            write_overview(page, outcomes, settings.pipeline)
            _say(f"overview: {page}")
        finally:
            write_summary(settings.summary, outcomes, started, seconds)
            _say(f"summary: {settings.summary}")
    return exit_code(outcomes)


def _begin(stack: contextlib.ExitStack, case: SubjectCase, settings: EngineSettings) -> dict[str, StagePlan]:
    """Locks the subject, clears what killed runs left, plans; InputError where that cannot be."""
    with contextlib.ExitStack() as own:
        own.enter_context(case.run.locked("run"))
        try:
            clear_all_leftovers(case, settings.pipeline)
            for path in case.run.work.glob(f"{SCRATCH}*"):
                shutil.rmtree(path, ignore_errors=True)
            plan = plan_case(settings.pipeline, case, settings.parameters, renew=settings.renew)
            _renew_stamps(plan)
        except OSError as error:
            raise no_access(case, error) from error
        stack.push(own.pop_all())
    return plan


def clear_all_leftovers(case: SubjectCase, pipeline: Pipeline, keep_logs: bool = True) -> None:
    """The same for the subject's folder and for those of its clips."""
    for run in dict.fromkeys(part.run for part, _ in case.jobs(pipeline)):
        clear_leftovers(run, pipeline, keep_logs)


def clear_leftovers(run: RunFolder, pipeline: Pipeline, keep_logs: bool = True) -> None:
    """Removes temporary folders that killed stages left; the log may be kept as a failed stage's.

    The caller holds the run's lock. A stage that somebody runs by hand at this moment keeps its folder.
    """
    if not run.work.is_dir():
        return
    for name in pipeline.steps:
        with contextlib.suppress(InputError), run.locked(name, _DYING_S):
            for path in run.leftovers(name):
                if keep_logs and (path / LOG).is_file() and not (path / MANIFEST).is_file() and ".tmp-" in path.name:
                    run.keep_failed(path, name)
            run.remove_leftovers(name)


def _renew_stamps(plans: Mapping[str, StagePlan]) -> None:
    """Stamps of current stages are written, all others removed: Snakemake then does just what the plan says."""
    for plan in plans.values():
        if plan.state == CURRENT:
            plan.case.run.write_stamp(plan.name)
        else:
            plan.case.run.stamp(plan.name).unlink(missing_ok=True)


def is_current(plans: Mapping[str, StagePlan]) -> bool:
    """Whether nothing is left to do."""
    return all(plan.state == CURRENT for plan in plans.values())


def _run_waiting(cases: Sequence[SubjectCase], settings: EngineSettings, start: float) -> dict[str, Outcome]:
    """Lets the engine work on the subjects that are not current and says how each ended."""
    with contextlib.ExitStack() as stack:
        scratches = [stack.enter_context(scratch_folder(case.run)) for case in cases]
        tracks = configure(scratches, cases, settings)
        watch, log = Watch([track for own in tracks for track in own]), scratches[0] / _WORKFLOW_LOG
        try:
            interrupted = not run_engine(scratches[0], cases, settings, watch, log, load_pictures)
        finally:
            watch.close()
            if settings.profile:
                keep_slurm_logs(scratches[0])
        for case in cases:
            clear_all_leftovers(case, settings.pipeline, keep_logs=not interrupted)
        if not interrupted and not watch.has_begun:
            for line in log.read_text(encoding="utf-8", errors="replace").splitlines()[-20:]:
                _say(f"| {line}")
        return {case.name: _guarded(case, partial(_conclude, case, own, settings, log, time.monotonic() - start,
                                                  interrupted))
                for case, own in zip(cases, tracks, strict=True)}


def _guarded(case: SubjectCase, judged: Callable[[], Outcome]) -> Outcome:
    """The outcome of one subject, whatever its records do to us on the way: that is its own, and stops no other."""
    try:
        return judged()
    except InputError as error:
        fault = error
    except OSError as error:
        fault = no_access(case, error)
    except Exception as error:
        return _crash(case, error)
    _say(f"limn: {fault}")
    return at_fault(case.subject.folder, fault)


def _crash(case: SubjectCase, error: Exception) -> Outcome:
    """A subject on which we failed: the trace goes to its log, or to stderr where that cannot be written."""
    log, text = case.run.work / _WORKFLOW_LOG, "".join(traceback.format_exception(error))
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "a", encoding="utf-8", errors="replace") as file:
            file.write(text)
    except OSError:
        log = None
        _say(text)
    _say(f"{case.name}: failed: {one_line(error)}" + (f"; its log: {log}" if log else ""))
    return at_fault(case.subject.folder, one_line(error), "failed", str(log or ""))


def _conclude(case: SubjectCase, tracks: Sequence[Track], settings: EngineSettings, log: Path, seconds: float,
              interrupted: bool) -> Outcome:
    """Keeps the engine's log and says how the subject's run ended."""
    plans = plan_case(settings.pipeline, case, settings.parameters, renew=settings.renew)
    kept = case.run.work / _WORKFLOW_LOG
    folders = [(plan.case.run.published(plan.name), plan.case.run.failed(plan.name)) for plan in plans.values()]
    if any(published.exists() or failed.exists() for published, failed in folders):
        with contextlib.suppress(OSError):
            shutil.copyfile(log, kept)
    outcome = outcome_of(case, settings.pipeline, plans, tracks, interrupted, kept)
    left = [name for name, plan in plans.items() if plan.state != CURRENT]
    if not left:
        _say(f"{case.name}: done in {seconds:.1f} s: {_result(case, plans)}")
    elif outcome.state == "interrupted":
        _say(f"{case.name}: interrupted; limn run again goes on with {left[0]}")
    elif outcome.state in ("failed", "input error"):
        later = [name for name in left if name != outcome.stage]
        told = any(track.state == outcome.state for track in tracks)
        _say(f"{case.name}: not done" + f": {outcome.reason}" * (not told)
             + (f"; not run: {', '.join(later)}" if later else ""))
    else:
        _say(f"{case.name}: {outcome.reason}" + (f"; its log: {outcome.log}" if outcome.log else "")
             + "; limn run again goes on there" * (outcome.state == "killed"))
    _say_kept(case, plans)
    return outcome


def _say_kept(case: SubjectCase, plans: Mapping[str, StagePlan]) -> None:
    """Names the results that are kept although other code or packages made them."""
    lines = kept_lines(plans)
    for line in lines:
        _say(f"{case.name}  {line}")
    if lines:
        _say(f"{case.name}: to have {'it' if len(lines) == 1 else 'them'} anew: limn run --renew")


def _result(case: SubjectCase, plans: Mapping[str, StagePlan]) -> Path:
    """The last stage's report where there is one, else its folder; the run's folder where clips have one each."""
    last = list(plans.values())[-1]
    if last.case.clip:
        return case.run.root
    folder = last.case.run.published(last.name)
    report = folder / "report.html"
    return report if report.is_file() else folder


def _say(text: str) -> None:
    with contextlib.suppress(BrokenPipeError):
        print(text, file=sys.stderr, flush=True)


def _interrupt(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt


def default_summary(subjects: Sequence[Path], out: Path | None, given: Path | None,
                    results: Sequence[Path] = ()) -> Path | None:
    """Where summary.json goes: as told, else to --out, else into the one folder of subjects that was given.

    Where a folder has that name or that of the page beside it, or one of the results will, it is called summary-2.json,
    and a line says so. InputError where a folder was told.
    """
    if given is not None:
        if given.is_dir():
            raise InputError("a folder, not a file", where="--summary", got=given, expected="a file's name")
        if given.parent.exists() and not given.parent.is_dir():
            raise InputError("lies in no folder", where="--summary", got=given)
        return given
    if out is None and (len(subjects) != 1 or (subjects[0] / "subject.yaml").exists()):
        return None
    folder = Path(os.path.abspath(subjects[0] if out is None else out))
    names = ["summary.json", *(f"summary-{i}.json" for i in range(2, 2 * len(results) + 3))]
    free = [folder / name for name in names
            if all(path not in results and not path.is_dir() for path in (folder / name, page_beside(folder / name)))]
    if not free:
        raise InputError("no free name for the summary", where=str(folder), hint="name a place with --summary FILE")
    if free[0].name != names[0]:
        _say(f"limn: {folder / names[0]}, or the page beside it, is a folder: the summary goes to {free[0]}")
    return free[0]
