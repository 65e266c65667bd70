"""limn: from a video of a head turn to a relightable head.

    limn new CLIP             make a subject folder from a video
    limn validate SUBJECT...  look at the inputs alone
    limn run SUBJECT...       do what is not done yet
    limn plan SUBJECT...      what run would do, and why
    limn status SUBJECT...    what lies where, sizes, times
    limn report SUBJECT...    where the report is
    limn overview SUBJECT...  one page over all of them
    limn clean SUBJECT...     remove intermediate results, keep export/
    limn check EXPORT...      whether results are whole and as other programs want them
    limn turntable EXPORT...  videos of the head and of a light turning, a sheet of the maps
    limn parameters           every stage's parameters

Exit code 0: all well. 1: a stage failed. 2: the input is at fault; then each line on stderr is one fault. 3: finished,
but a quality gate of pipeline.yaml is missed: have a look.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from shared.contract.cli import OneLineParser
from shared.contract.confine import trust
from shared.contract.declare import parameter_table
from shared.contract.pipeline import Pipeline, load_pipeline, split_settings
from shared.contract.subject import MOVES, TRANSFERS
from shared.contract.wording import unknown_name
from shared.errors import InputError, LimnError, refused
from tools.cli.cases import InputErrors, all_parameters, find_subjects, open_cases
from tools.cli.check_export import check_exports, find_exports
from tools.cli.housekeeping import clean, report_path
from tools.cli.plan import plan_case, plan_lines


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code."""
    try:
        args = make_parser().parse_args(argv)
        trust(getattr(args, "trust", []))
        return args.command(args)
    except InputErrors as errors:
        for error in errors.errors:
            print(f"limn: {error}", file=sys.stderr)
        return 2
    except InputError as error:
        print(f"limn: {error}", file=sys.stderr)
        return 2
    except LimnError as error:
        print(f"limn: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("limn: interrupted", file=sys.stderr)
        return 1
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print(f"limn: {refused(error)}", file=sys.stderr)
        return 2


def make_parser() -> argparse.ArgumentParser:
    """The command line of limn."""
    parser = OneLineParser(prog="limn", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _input_command(commands, "validate", validate_command, "look at the inputs alone, in seconds, and write nothing")
    run = _subject_command(commands, "run", run_command, "do what is not done yet")
    plan = _subject_command(commands, "plan", plan_command, "what run would do, and why")
    status = _subject_command(commands, "status", status_command, "what lies where, sizes, times")
    report = _subject_command(commands, "report", report_command, "where the report is")
    overview = _subject_command(commands, "overview", overview_command, "one page over all subjects: pictures, gates, "
                                "warnings, costs")
    removal = _subject_command(commands, "clean", clean_command, "remove intermediate results, keep export/")
    for command in (run, plan, status, report, overview):
        command.add_argument("--preset", help="a preset of pipeline.yaml")
        command.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE", help="a parameter")
    for command in (run, plan):
        command.add_argument("--renew", action="store_true",
                             help="do again what was made by other code or packages than those of today")
        command.add_argument("--until", metavar="STAGE", help="stop after this stage")
    for command in (plan, status):
        command.add_argument("--verify", action="store_true", help="read every published file again")
    run.add_argument("--cores", type=int, metavar="N", help="cores to use (all)")
    run.add_argument("--memory", type=int, metavar="MB", help="memory for all stages together (nine tenths of what is "
                     "available)")
    run.add_argument("--threads", type=int, metavar="N", help="cores of one stage (all; with more subjects, a share)")
    run.add_argument("--profile", metavar="NAME", help="a Snakemake profile, for a cluster: slurm, generic or a folder")
    run.add_argument("--summary", type=Path, metavar="FILE", help="where to write summary.json")
    status.add_argument("--json", action="store_true", help="print it as JSON")
    report.add_argument("--open", action="store_true", help="open it in the browser")
    overview.add_argument("--page", type=Path, metavar="FILE", default=Path("overview.html"),
                          help="where to write it (overview.html)")
    removal.add_argument("--dry-run", action="store_true", help="only say what would go")
    _add_new(commands)
    check = commands.add_parser("check", help="whether results are whole and as other programs want them",
                                description="compares every file with the SHA256SUMS of its export folder, then looks "
                                "into the files: USD, MaterialX, glTF, EXR, maps, mesh and poses")
    check.add_argument("folders", nargs="+", type=Path, metavar="EXPORT",
                       help="an export folder, wherever it lies, or a folder that holds one or several")
    check.add_argument("--hashes", action="store_true", help="compare the files only, do not look into them")
    check.set_defaults(command=check_command)
    _add_turntable(commands)
    table = commands.add_parser("parameters", help="every stage's parameters as a table")
    table.add_argument("stages", nargs="*", metavar="STAGE")
    table.add_argument("--group", metavar="NAME", help="those of a group, which count in one case only")
    table.add_argument("--pipeline", type=Path, metavar="FILE")
    table.set_defaults(command=parameters_command)
    return parser


def _subject_command(commands: argparse._SubParsersAction, name: str, command, text: str) -> argparse.ArgumentParser:
    parser = _input_command(commands, name, command, text)
    parser.add_argument("--out", type=Path, metavar="DIR", help="write to DIR/<subject>/, not to the subject's folder")
    parser.add_argument("--pipeline", type=Path, metavar="FILE", help="another pipeline.yaml")
    return parser


def _input_command(commands: argparse._SubParsersAction, name: str, command, text: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(name, help=text, description=text)
    parser.add_argument("subjects", nargs="*", type=Path, metavar="SUBJECT",
                        help="folder with subject.yaml, or a folder of such")
    parser.add_argument("--list", type=Path, metavar="FILE", help="a file that names one subject a line")
    parser.add_argument("--trust", type=Path, action="append", default=[], metavar="DIR",
                        help="follow symbolic links into DIR, run stages that lie in it")
    parser.set_defaults(command=command)
    return parser


def _add_new(commands: argparse._SubParsersAction) -> None:
    new = commands.add_parser("new", help="make a subject folder from a video", description="make a subject folder")
    new.add_argument("clip", type=Path, metavar="CLIP", help="a video, or an image sequence as frames/%%05d.png")
    new.add_argument("--name", help="name of the folder (the clip's)")
    new.add_argument("--dest", type=Path, default=Path("."), metavar="DIR", help="where to make it (here)")
    new.add_argument("--link", action="store_true", help="link to the clip instead of copying it")
    new.add_argument("--focal-length-mm", type=float, metavar="MM", help="needs --sensor-width-mm")
    new.add_argument("--sensor-width-mm", type=float, metavar="MM", help="36 for 'full frame equivalent' lengths")
    new.add_argument("--focal-length-px", type=float, metavar="PX", help="instead, in pixels of the source frame")
    new.add_argument("--transfer", choices=TRANSFERS, default="srgb", help="how the file encodes light (srgb)")
    new.add_argument("--moves", choices=MOVES, default="head", help="what moves (head)")
    new.set_defaults(command=new_command)


def _add_turntable(commands: argparse._SubParsersAction) -> None:
    text = "videos of the head turning under three lights and of a light turning, and a sheet of the maps"
    turntable = commands.add_parser("turntable", help=text, description=f"{text}; in turntable/ beside export/")
    turntable.add_argument("folders", nargs="+", type=Path, metavar="EXPORT",
                           help="an export folder, wherever it lies, or a folder that holds one or several")
    turntable.add_argument("--size", type=int, default=480, metavar="PX", help="edge of one picture (480)")
    turntable.add_argument("--frames", type=int, default=72, metavar="N", help="of a whole turn (72)")
    turntable.add_argument("--fps", type=int, default=24, metavar="N", help="frames per second (24)")
    turntable.set_defaults(command=turntable_command)


def validate_command(args: argparse.Namespace) -> int:
    """limn validate"""
    from tools.cli.validate import validate

    opened = open_cases(find_subjects(args.subjects, args.list), None)
    codes = {2 for _ in opened.faults}
    for _, error in opened.faults:
        print(f"limn: {error}", file=sys.stderr)
    for found in validate([case.subject for case in opened.cases]):
        if found.error or found.crash:
            codes.add(1 if found.crash else 2)
            print(f"limn: {found.error or found.crash}", file=sys.stderr)
        print("".join(f"{line}\n" for line in found.lines()), end="", flush=True)
    return min(codes, default=0)


def run_command(args: argparse.Namespace) -> int:
    """limn run"""
    from tools.cli.engine import EngineSettings, profile_folder
    from tools.cli.gates import check_gates
    from tools.cli.resources import memory_to_give
    from tools.cli.workflow import default_summary, run_cases

    pipeline = _pipeline_of(args)
    parameters = all_parameters(pipeline, args.preset, args.set)
    check_gates(pipeline)
    profile = profile_folder(args.profile) if args.profile else None
    opened = open_cases(find_subjects(args.subjects, args.list), args.out)
    cores = args.cores
    if cores is None and not args.profile:
        cores = len(os.sched_getaffinity(0))
    for name, value in (("cores", cores), ("memory", args.memory), ("threads", args.threads)):
        if value is not None and value < 1:
            raise InputError(f"{name} not allowed", where=f"--{name}", got=value, expected=">= 1")
    memory_mb = args.memory or (None if args.profile else memory_to_give())
    given = split_settings(args.set, pipeline.stages)
    preset = [f"--preset={args.preset}"] if args.preset else []
    files = {(name, p.name) for name, stage in pipeline.stages.items() for p in stage.parameters if p.file}
    always = preset + ["--renew"] * args.renew
    arguments = {name: always + [f"--set={key}={parameters[name][key] if (name, key) in files else value}"
                                 for key, value in given.get(name, {}).items()]
                 for name in pipeline.stages}
    return run_cases(opened, EngineSettings(
        pipeline, parameters, arguments, args.out, cores, memory_mb, args.threads, profile,
        default_summary(args.subjects, args.out, args.summary, [case.run.root for case in opened.cases]), args.renew))


def plan_command(args: argparse.Namespace) -> int:
    """limn plan"""
    return _for_each_plan(args, lambda case, plans: print("\n".join(plan_lines(case, plans))))


def status_command(args: argparse.Namespace) -> int:
    """limn status"""
    from tools.cli.status import status_lines, status_of

    records = []
    try:
        return _for_each_plan(args, lambda case, plans: records.append(status_of(case, plans)))
    finally:
        lines = [line for record in records for line in status_lines(record)]
        print(json.dumps(records, indent=1) if args.json else "\n".join(lines), end="\n" if records else "")


def report_command(args: argparse.Namespace) -> int:
    """limn report"""
    import webbrowser

    def show(case, plans) -> None:
        path, remarks = report_path(case, plans)
        for remark in remarks:
            print(remark, file=sys.stderr)
        print(path)
        if args.open:
            webbrowser.open(path.as_uri())

    return _for_each_plan(args, show)


def overview_command(args: argparse.Namespace) -> int:
    """limn overview"""
    from tools.cli.outcome import at_fault
    from tools.cli.overview import outcome_now, write_overview

    pipeline = load_pipeline(args.pipeline)
    parameters = all_parameters(pipeline, args.preset, args.set)
    opened = open_cases(find_subjects(args.subjects, args.list), args.out)
    outcomes = []
    for case in opened.cases:
        with opened.attempt(case):
            outcomes.append(outcome_now(case, pipeline, plan_case(pipeline, case, parameters)))
    outcomes += [at_fault(folder, error) for folder, error in opened.faults]
    outcomes += [at_fault(folder, text, "failed") for folder, text in opened.crashes]
    write_overview(args.page, outcomes, pipeline)
    print(args.page)
    return opened.conclude()


def clean_command(args: argparse.Namespace) -> int:
    """limn clean"""
    pipeline = load_pipeline(args.pipeline)
    opened = open_cases(find_subjects(args.subjects, args.list), args.out)
    for case in opened.cases:
        with opened.attempt(case):
            for line in clean(case.run, pipeline, args.dry_run):
                print(line, flush=True)
    return opened.conclude()


def new_command(args: argparse.Namespace) -> int:
    """limn new"""
    from tools.cli.new_subject import NewSubject, make_subject

    folder, facts = make_subject(NewSubject(
        args.clip, args.name, args.dest, args.link, args.focal_length_mm, args.sensor_width_mm, args.focal_length_px,
        args.transfer, args.moves))
    print(f"{folder}: {facts}")
    vouch = f" --trust {os.path.realpath(args.clip.parent)}" if args.link else ""
    print(f"look through {folder / 'subject.yaml'}, then: limn run {folder}{vouch}")
    return 0


def check_command(args: argparse.Namespace) -> int:
    """limn check"""
    for line in check_exports(args.folders, args.hashes):
        print(line, flush=True)
    return 0


def turntable_command(args: argparse.Namespace) -> int:
    """limn turntable"""
    from shared.contract.progress import terminal_bar
    from tools.relight.turntable import TurntableSettings, write_turntable

    def progress(items, label: str, total: int | None):
        return terminal_bar(items, label, total) if sys.stderr.isatty() else items

    errors: list[InputError] = []
    for folder in args.folders:
        try:
            for export in find_exports(folder):
                for line in write_turntable(export, TurntableSettings(args.size, args.frames, args.fps), progress):
                    print(line, flush=True)
        except InputError as error:
            errors.append(error)
    if errors:
        raise InputErrors(errors)
    return 0


def parameters_command(args: argparse.Namespace) -> int:
    """limn parameters"""
    stages = load_pipeline(args.pipeline).stages
    for name in args.stages:
        if name not in stages:
            raise unknown_name("stage", name, stages, "parameters")
    chosen = [stage for name, stage in stages.items() if not args.stages or name in args.stages]
    groups = {group.name: group for stage in chosen for group in stage.groups}
    if args.group is not None and args.group not in groups:
        raise unknown_name("group of parameters", args.group, groups, "parameters --group")
    table = {stage.name: [p for group in stage.groups if group.name == args.group for p in group.parameters]
             for stage in chosen} if args.group else {stage.name: stage.common for stage in chosen}
    print(parameter_table(table), end="")
    for group in () if args.group else groups.values():
        print(f"\nThose {group.case}: limn parameters --group {group.name}")
    return 0


def _pipeline_of(args: argparse.Namespace) -> Pipeline:
    """The pipeline, up to the stage of --until where that is given."""
    pipeline = load_pipeline(args.pipeline)
    return pipeline.until(args.until) if getattr(args, "until", None) else pipeline


def _for_each_plan(args: argparse.Namespace, show) -> int:
    """Shows each subject; those at fault are named in the end."""
    pipeline = _pipeline_of(args)
    parameters = all_parameters(pipeline, args.preset, args.set)
    opened = open_cases(find_subjects(args.subjects, args.list), args.out)
    for case in opened.cases:
        with opened.attempt(case):
            show(case, plan_case(pipeline, case, parameters, getattr(args, "verify", False),
                                 getattr(args, "renew", False)))
    return opened.conclude()


if __name__ == "__main__":
    raise SystemExit(main())
