"""The command line of one stage: `python -m stages.<name> --subject DIR [--out DIR] [--set key=value ...]`.

Exit code 0: done or current. 2: the input is at fault, one line says how, nothing is written. 1: ours is the fault.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from shared.contract.currency import reasons_to_run, work_to_do
from shared.contract.declare import Parameter, Stage
from shared.contract.disk import disk_fault
from shared.contract.drift import drift
from shared.contract.execute import execute
from shared.contract.folders import RunFolder
from shared.contract.hashing import HashMemory
from shared.contract.interpreter import set_threads, settle
from shared.contract.job import Job
from shared.contract.manifest import read_manifest
from shared.contract.needs import amount, measured_scale, scale_of
from shared.contract.pipeline import Pipeline, load_pipeline, split_settings
from shared.contract.progress import Reporter
from shared.contract.request import Request
from shared.contract.subject import Subject, load_subject
from shared.errors import InputError

_LOCK_WAIT_S = 10.0


def main(stage: Stage, run: Callable[[Job], None], check: Callable[[Job], None] | None = None,
         argv: Sequence[str] | None = None) -> int:
    """Runs the stage unless its result is current; returns the exit code.

    argv: None for the command line of this process, which may then start anew, see interpreter.py.
    """
    events = None
    try:
        request = parse_request(stage, argv)
        events = request.events
        if argv is None:
            settle(request.threads)
        with request.run.locked(stage.name, _LOCK_WAIT_S):
            request.run.remove_leftovers(stage.name)
            if answer_current(request):
                return 0
            set_threads(request.threads)
            return execute(request, run, check)
    except OSError as error:
        fault = disk_fault(error, Path.cwd()) if error.filename is None else disk_fault(error, Path(error.filename))
        if fault is None:
            raise
        report_input_error(stage.name, fault, events)
        return 2
    except InputError as error:
        report_input_error(stage.name, error, events)
        return 2


def report_input_error(name: str, error: InputError, events: Path | None) -> None:
    """The one line that says what is wrong with the input."""
    Reporter(name, None, events).event("input_error", message=str(error))
    sys.stderr.write(f"{name}: {error}\n")


def answer_current(request: Request) -> bool:
    """True when the published result is the one asked for; its stamp is written then."""
    if request.force:
        return False
    memory = HashMemory(request.run.memory, request.verify)
    work = work_to_do(request.stage, request.subject, request.run, request.parameters, memory)
    if reasons_to_run(work, request.run, memory):
        return False
    by_hand = not request.events
    remarks = drift(request.run.published(request.stage.name), request.roots) if request.renew or by_hand else []
    if request.renew and remarks:
        return False
    memory.save()
    request.run.write_stamp(request.stage.name)
    reporter = Reporter(request.stage.name, None, request.events)
    reporter.event("current")
    reporter.note(f"current: {request.run.published(request.stage.name)}")
    for remark in remarks:
        reporter.note(f"kept although {remark}; to have it anew: --renew")
    return True


class OneLineParser(argparse.ArgumentParser):
    """A parser whose complaint is an InputError of one line instead of the usage."""

    def error(self, message: str) -> None:
        """argparse's hook for a bad command line. InputError always."""
        raise InputError(message, hint=f"see {self.prog} --help")


def make_parser(stage: Stage) -> argparse.ArgumentParser:
    """The stage's command line, with its parameters in the help text."""
    parser = OneLineParser(prog=f"python -m stages.{stage.name}", description=stage.help,
                           epilog=_parameter_lines("", stage.common), formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--subject", type=Path, required=True, metavar="DIR", help="folder with subject.yaml")
    parser.add_argument("--clip", metavar="NAME", help="which clip, where subject.yaml names several")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write to DIR/<subject>/, not to the subject's folder")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a parameter; may be repeated")
    parser.add_argument("--preset", help="preset of pipeline.yaml (its default_preset)")
    parser.add_argument("--pipeline", type=Path, metavar="FILE", help="another pipeline.yaml")
    parser.add_argument("--threads", type=int, metavar="N", help="cores to use (all)")
    parser.add_argument("--force", action="store_true", help="run even if the result is current")
    parser.add_argument("--renew", action="store_true", help="run, too, if other code or packages made the result")
    parser.add_argument("--verify", action="store_true", help="read every file again to see whether it is current")
    parser.add_argument("--events", type=Path, help=argparse.SUPPRESS)
    for group in stage.groups:
        parser.add_argument(f"--help-{group.name}", action="version", help=f"list the parameters {group.case}",
                            version=_parameter_lines(f" {group.case}", group.parameters))
    return parser


def _parameter_lines(case: str, parameters: Sequence[Parameter]) -> str:
    lines = [f"  {p.name:24} {p.help} Default {p.default}; {p.expected}." for p in parameters]
    return "\n".join([f"parameters{case}:", *lines])


def parse_request(stage: Stage, argv: Sequence[str] | None) -> Request:
    """Command line -> Request; InputError for whatever is wrong with it, the subject or pipeline.yaml."""
    args = make_parser(stage).parse_args(argv)
    subject = load_subject(args.subject)
    prefix = f"{stage.name}."
    settings = [text if text.startswith(prefix) else prefix + text for text in args.set]
    given = split_settings(settings, [stage.name]).get(stage.name, {})
    pipeline = load_pipeline(args.pipeline)
    parameters = pipeline.parameters(stage, args.preset, given)
    threads = len(os.sched_getaffinity(0)) if args.threads is None else args.threads
    if threads < 1:
        raise InputError("number of threads not allowed", where="--threads", got=threads, expected=">= 1")
    run = RunFolder.of(subject.folder, subject.name, args.out)
    if subject.clips or args.clip is not None:
        subject, run = _part(stage, subject, run, args.clip, bool(stage.joins) or stage.name in pipeline.joint)
    disk_mb = _disk_needed(pipeline, stage, args.preset, parameters, run)
    return Request(stage, subject, run, parameters, threads, args.force, args.verify, args.events, disk_mb, args.renew,
                   pipeline.code_roots)


def _part(stage: Stage, subject: Subject, run: RunFolder, clip: str | None, joint: bool) -> tuple[Subject, RunFolder]:
    """What of a subject with several clips the stage works on: all of it, or the one clip that is named."""
    if joint:
        if clip is not None:
            raise InputError("works on all clips together", where=f"{stage.name} --clip", hint="leave --clip out")
        return subject, run
    if clip is None:
        raise InputError("works on one clip at a time", where=stage.name, got=f"{len(subject.clips)} clips",
                         hint=f"add --clip NAME, one of {', '.join(clip.name for clip in subject.clips)}")
    return subject.clip(clip, "--clip"), run.of_clip(clip)


def _disk_needed(pipeline: Pipeline, stage: Stage, preset: str | None, own: Mapping[str, object],
                 run: RunFolder) -> float | None:
    """MB that the stage is expected to write, with a tenth on top; None where pipeline.yaml does not say.

    own: the stage's parameters as they are set. Of another stage those count with which it ran, as far as they are
    allowed ones; else the preset's.
    """
    step = pipeline.steps.get(stage.name)
    if step is None or "disk_mb" not in step.resources:
        return None
    parameters = {name: own if name == stage.name else _used(pipeline, other, preset, run)
                  for name, other in pipeline.stages.items()}
    expected = scale_of(pipeline.sizes, pipeline.stages, parameters, str(pipeline.path))
    return 1.1 * amount(step.resources, "disk_mb", measured_scale(run.root, expected))


def _used(pipeline: Pipeline, stage: Stage, preset: str | None, run: RunFolder) -> Mapping[str, object]:
    """The parameters with which a stage ran, as its manifest says."""
    ran = (read_manifest(run.published(stage.name)) or {}).get("parameters")
    ran = ran if isinstance(ran, dict) else {}
    try:
        return pipeline.parameters(stage, preset, {p.name: ran[p.name] for p in stage.parameters if p.name in ran})
    except InputError:  # those of another version, or a damaged record
        return pipeline.parameters(stage, preset, {})
