"""Submits a job script to a scheduler in that scheduler's own units, and asks what became of it.

    python3 -m tools.cli.cluster submit sge|lsf|pbs --threads N --mem-mb MB --minutes M --log FILE SCRIPT
    python3 -m tools.cli.cluster status sge|lsf|pbs ID

For profiles/generic. Prints the job's id, or running, success or failed, and nothing else. What the schedulers mean:

    Grid Engine  h_vmem counts for each slot of the parallel environment (sge_pe(5), queue_conf(5)); times in seconds.
    LSF          a number without a unit is in what LSF_UNIT_FOR_LIMITS says, kB as a rule (lsf.conf(5)); -M is the
                 limit, rusage[mem] the reservation, per job on current clusters.
    PBS          mem of select counts for the whole chunk; times in seconds.

Uses nothing but the standard library: it runs under whatever python3 the submitting shell finds.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from pathlib import Path

SCHEDULERS = ("sge", "lsf", "pbs")
_SLURM_LOGS = Path(".snakemake") / "slurm_logs"
_ACCOUNTING_TRIES, _ACCOUNTING_PAUSE_S = 10, 3.0
LOG_SUFFIX = ".cluster.log"


def main(argv: list[str] | None = None) -> int:
    """0; 1 where the scheduler refuses, its words are on stderr."""
    args = _parser().parse_args(argv)
    try:
        print(args.command(args))
    except (subprocess.CalledProcessError, OSError, ValueError) as error:
        print(f"cluster: {error} {getattr(error, 'stderr', None) or ''}".rstrip(), file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    submit_parser = commands.add_parser("submit")
    submit_parser.add_argument("scheduler", choices=SCHEDULERS)
    for name in ("--threads", "--mem-mb", "--minutes"):
        submit_parser.add_argument(name, type=int, required=True)
    submit_parser.add_argument("--log", type=Path, required=True, help="the scheduler's own log")
    submit_parser.add_argument("--option", action="append", default=[], help="handed on as it is; may be repeated")
    submit_parser.add_argument("script", type=Path)
    submit_parser.set_defaults(command=submit)
    status_parser = commands.add_parser("status")
    status_parser.add_argument("scheduler", choices=SCHEDULERS)
    status_parser.add_argument("job")
    status_parser.set_defaults(command=lambda args: _STATUS[args.scheduler](args.job))
    return parser


def submit(args: argparse.Namespace) -> str:
    """Submits and returns the job's id; ValueError where the answer holds none."""
    log = os.path.realpath(args.log)  # the folder with the links goes when the run ends
    made = command(args.scheduler, args.threads, args.mem_mb, args.minutes, log)
    answer = _output([*made, *args.option, str(args.script)])
    pattern = {"sge": r"^(\d+)", "lsf": r"Job <(\d+)>", "pbs": r"^(\S+)$"}[args.scheduler]
    found = re.search(pattern, answer.strip(), re.MULTILINE)
    if not found:
        raise ValueError(f"no job id in the answer of {made[0]}: {answer.strip()!r}")
    return found.group(1)


def command(scheduler: str, threads: int, mem_mb: int, minutes: int, log: str) -> list[str]:
    """The scheduler's command without its job script. mem_mb: of the whole job."""
    if scheduler == "sge":
        per_slot = -(-mem_mb // threads)
        return ["qsub", "-terse", "-cwd", "-V", "-b", "n", "-j", "y", "-o", log, "-pe", "smp", str(threads),
                "-l", f"h_vmem={per_slot}M", "-l", f"h_rt={60 * minutes}"]
    if scheduler == "lsf":
        return ["bsub", "-n", str(threads), "-R", f"span[hosts=1] rusage[mem={mem_mb}MB]", "-M", f"{mem_mb}MB",
                "-W", str(minutes), "-oo", log]
    return ["qsub", "-V", "-j", "oe", "-o", log, "-l", f"select=1:ncpus={threads}:mem={mem_mb}mb",
            "-l", f"walltime={60 * minutes}"]


def sge_status(job: str) -> str:
    """In the queue, or as the accounting says, which may lag some seconds behind."""
    for _ in range(_ACCOUNTING_TRIES):
        if _answer(["qstat", "-j", job]) is not None:
            return "running"
        ended = dict(re.findall(r"^(failed|exit_status)\s+(\d+)", _answer(["qacct", "-j", job]) or "", re.MULTILINE))
        if ended:
            return "success" if set(ended.values()) == {"0"} else "failed"
        time.sleep(_ACCOUNTING_PAUSE_S)
    return "failed"


def lsf_status(job: str) -> str:
    """As bjobs says; a job that it has forgotten, bhist."""
    state = (_answer(["bjobs", "-noheader", "-o", "stat", job]) or "").strip()
    if state in ("DONE", "EXIT"):
        return "success" if state == "DONE" else "failed"
    if state:
        return "running"
    history = _answer(["bhist", "-l", job]) or ""
    return "success" if "Done successfully" in history else "failed"


def pbs_status(job: str) -> str:
    """As qstat says of jobs that have ended, too."""
    facts = dict(re.findall(r"^\s*(job_state|Exit_status) = (\S+)", _answer(["qstat", "-x", "-f", job]) or "",
                            re.MULTILINE))
    if facts.get("job_state") in ("F", "C", None):
        return "success" if facts.get("Exit_status") == "0" else "failed"
    return "running"


_STATUS = {"sge": sge_status, "lsf": lsf_status, "pbs": pbs_status}


def keep_slurm_logs(home: Path) -> None:
    """Moves the logs that Snakemake's Slurm executor left in its own folder beside the stages that they are about."""
    for path in sorted((home / _SLURM_LOGS).glob("rule_*/*/*.log"), key=lambda path: path.stat().st_mtime):
        work = home / "runs" / path.parent.name / "work"
        stage = path.parent.parent.name.removeprefix("rule_")
        if work.is_dir():
            (work / f"{stage}{LOG_SUFFIX}").write_bytes(path.read_bytes())


def _output(words: list[str]) -> str:
    return subprocess.run(words, check=True, text=True, capture_output=True).stdout


def _answer(words: list[str]) -> str | None:
    """What the command prints, None where it knows no such job."""
    try:
        return _output(words)
    except subprocess.CalledProcessError:
        return None


if __name__ == "__main__":
    raise SystemExit(main())
