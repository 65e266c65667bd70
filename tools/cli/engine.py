"""Snakemake as the engine of a run: its configuration, its process, and the stages' event files.

Snakemake decides order and parallelism. Each call gets a scratch folder for its state, so nothing stale can lock the
next one.
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
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from shared.contract import fork_client, fork_server, launch
from shared.contract.cache_folder import VARIABLE, cache_folder
from shared.contract.folders import RunFolder
from shared.contract.fork_server import Served
from shared.contract.manifest import write_record
from shared.contract.needs import scale_of
from shared.contract.pipeline import REPOSITORY, Pipeline
from shared.errors import InputError
from tools.cli.cases import SubjectCase
from tools.cli.resources import KINDS
from tools.cli.watch import Track, Watch

SCRATCH = ".workflow-"
EVENTS, SERVERS = "events", "servers"
_POLL_S, _TRACKS_PER_S = 0.2, 1000
_SET_PARENT_DEATH_SIGNAL = 1
_CLUSTER_THREADS = 4
_CLUSTER_MB = 400
"""What the engine itself takes inside each job of a cluster."""


@dataclass(frozen=True)
class EngineSettings:
    """How to run. parameters: {stage: {parameter: value}}. arguments: what hands them to each stage's command line.

    cores: in all, None for what a profile says. memory_mb: for all jobs together. threads: of one stage, None for an
    even share of the cores. profile: folder of a
    Snakemake profile (profile_folder). renew: do again what other code or packages made.
    """

    pipeline: Pipeline
    parameters: Mapping[str, Mapping[str, object]]
    arguments: Mapping[str, Sequence[str]]
    out: Path | None
    cores: int | None
    memory_mb: int | None = None
    threads: int | None = None
    profile: str | None = None
    summary: Path | None = None
    renew: bool = False

    def threads_of(self, stage: str, subjects: int) -> int:
        """Cores of one job, where so many subjects wait."""
        cores = self.cores or _CLUSTER_THREADS
        share = self.threads or (cores if self.profile else max(1, cores // min(cores, subjects)))
        return min(self.pipeline.steps[stage].threads or share, share)


@contextlib.contextmanager
def scratch_folder(run: RunFolder) -> Iterator[Path]:
    """A folder in work/ for the engine's state and the events of the subject's stages, removed in the end."""
    path = run.work / f"{SCRATCH}{os.getpid()}"
    for name in (EVENTS, SERVERS, "runs", "tmp"):
        (path / name).mkdir(parents=True)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def configure(scratches: Sequence[Path], cases: Sequence[SubjectCase], settings: EngineSettings) -> list[list[Track]]:
    """Writes Snakemake's configuration into the first scratch folder; returns each subject's stages to watch."""
    pipeline, runs, tracks, home = settings.pipeline, {}, [], scratches[0]
    for case, scratch in zip(cases, scratches, strict=True):
        own, watched = _configure_case(case, scratch / EVENTS, settings, home / "runs", len(runs))
        runs |= own
        tracks.append(watched)
    stages = {name: {"threads": settings.threads_of(name, len(cases)),
                     "resources": {kind: dict(step.resources[kind]) for kind in KINDS if kind in step.resources}}
              for name, step in pipeline.steps.items()}
    scale = asdict(scale_of(pipeline.sizes, pipeline.stages, settings.parameters, str(pipeline.path)))
    write_record(home / "config.json",
                 {"runs": runs, "stages": stages, "scale": scale, "memory_mb": settings.memory_mb,
                  "overhead_mb": _CLUSTER_MB if settings.profile else 0})
    return tracks


def _configure_case(
    case: SubjectCase, events: Path, settings: EngineSettings, links: Path, first: int
) -> tuple[dict, list[Track]]:
    """{number: {stage: its command and the stamps that it waits for}} from the number first on, and what to watch.

    A number stands for the subject, or for one of its clips.
    """
    runs: dict[str, dict[str, dict]] = {}
    numbers: dict[str, str] = {}
    stamps: dict[str, str] = {}
    tracks = []
    for part, name in case.jobs(settings.pipeline):
        if part.clip not in numbers:
            number = numbers[part.clip] = str(first + len(numbers))
            part.run.root.mkdir(parents=True, exist_ok=True)
            (links / number).symlink_to(part.run.root, target_is_directory=True)
        number, label = numbers[part.clip], part.label(name)
        path = events / f"{label}.jsonl"
        path.parent.mkdir(exist_ok=True)
        needs = [stamps[part.label(need)] for need in part.inputs(settings.pipeline.stages[name])]
        stamps[label] = f"runs/{number}/work/{name}.stamp"
        runs.setdefault(number, {})[name] = {"command": _command(name, part, settings, path), "needs": needs}
        tracks.append(Track(case.name, label, path))
    return runs, tracks


def _command(name: str, case: SubjectCase, settings: EngineSettings, events: Path) -> str:
    """The shell command of one stage."""
    pipeline = settings.pipeline
    start = ["-m", launch.__name__] if settings.profile else ["-I", "-S", fork_client.__file__, f"{SERVERS}/{name}"]
    command = [sys.executable, *start, str(pipeline.root), pipeline.package, name, "--subject",
               str(case.subject.folder), "--pipeline", str(pipeline.path), "--events", str(events)]
    if case.clip:
        command += ["--clip", case.clip]
    if settings.out:
        command += ["--out", os.path.abspath(settings.out)]
    return shlex.join([*command, *settings.arguments[name]])


def run_engine(home: Path, cases: Sequence[SubjectCase], settings: EngineSettings, watch: Watch, log: Path,
               meanwhile: Callable[[], object]) -> bool:
    """Runs Snakemake to its end and shows the stages' events; False where the user interrupted it.

    meanwhile: is called once a stage works.
    """
    process = _start(home, settings, log)
    server = None if settings.profile else _start_server(home, cases, settings, log)
    pause, is_called = _POLL_S + len(watch.tracks) / _TRACKS_PER_S, False
    try:
        while not _has_ended(process, pause):
            watch.poll()
            if not is_called and watch.has_begun:
                is_called = True
                with interrupted_later():
                    meanwhile()
        watch.poll()
        return True
    except KeyboardInterrupt:
        if settings.profile:
            _cancel_jobs(process)
        return False
    finally:
        for started in filter(None, (process, server)):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(started.pid, signal.SIGKILL)
            started.wait()


@contextlib.contextmanager
def interrupted_later() -> Iterator[None]:
    """Keeps what would interrupt the block until it is through; KeyboardInterrupt then.

    Libraries that are being loaded run Python from C. An interrupt that leaves such code marks the whole process as
    ended by SIGINT, even where it is caught later (unhandled_keyboard_interrupt in CPython's Python/pythonrun.c).
    """
    came: list[int] = []
    before = {number: signal.signal(number, lambda caught, _frame: came.append(caught))
              for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
              if callable(signal.getsignal(number))}  # one that is ignored, or ends the process at once, does so still
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        raise KeyboardInterrupt


def _has_ended(process: subprocess.Popen, wait_s: float) -> bool:
    """Whether it has, or does within that time."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(wait_s)
    return process.poll() is not None


def _start(home: Path, settings: EngineSettings, log: Path) -> subprocess.Popen:
    """Snakemake, started in a process group of its own that dies with this process."""
    command = [sys.executable, "-m", "tools.cli.snakemake_process",
               "--snakefile", str(Path(__file__).with_name("Snakefile")), "--directory", str(home),
               "--configfile", str(home / "config.json"), "--keep-going", "--nolock",
               "--rerun-incomplete", "--rerun-triggers", "mtime", "--nocolor"]
    if settings.cores:
        command += ["--cores", str(settings.cores)]
    if settings.memory_mb:
        command += ["--resources", f"mem_mb={settings.memory_mb}"]
    if settings.profile:
        command += ["--profile", settings.profile]
    return _process(command, home, log)


def _start_server(home: Path, cases: Sequence[SubjectCase], settings: EngineSettings, log: Path) -> subprocess.Popen:
    """The process of which stages on this machine are forked, see shared/contract/fork_server.py."""
    pipeline = settings.pipeline
    jobs = Counter(name for case in cases for part, name in case.jobs(pipeline) if not part.run.stamp(name).exists())
    stages = [str(Served(name, settings.threads_of(name, len(cases)), jobs[name]))
              for name in pipeline.steps if jobs[name]]
    return _process([sys.executable, "-m", fork_server.__name__, str(home / SERVERS), str(pipeline.root),
                     pipeline.package, *stages], home, log)


def _process(command: Sequence[str], home: Path, log: Path) -> subprocess.Popen:
    """A process of the engine, in a process group of its own that dies with this process; it adds to the log."""
    with open(log, "ab") as file:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                                env=engine_environment(home), cwd=home, start_new_session=True,
                                preexec_fn=_die_with_parent)


def engine_environment(home: Path) -> dict[str, str]:
    """The environment of Snakemake: none of the user's settings for it, and its caches in the scratch folder.

    It would write them into HOME, which a service's user may not have; XDG's variables are set for the engine alone.
    """
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SNAKEMAKE_")}
    search = [str(REPOSITORY), kept.get("PYTHONPATH", "")]
    caches = {name: str(home / "tmp") for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME")}
    return kept | caches | {
        "PYTHONPATH": os.pathsep.join(filter(None, search)), "TMPDIR": str(home / "tmp"),
        "PYTHONHASHSEED": "0",  # so that the stages' interpreters need not start anew
        VARIABLE: cache_folder()}  # of the user: that of the engine goes with its run


def profile_folder(name: str) -> str:
    """A profile of this repository by its name, else a folder, else one where Snakemake keeps them. InputError where
    there is none."""
    known = {path.name: path for path in (REPOSITORY / "profiles").iterdir() if path.is_dir()}
    if name in known:
        return str(known[name])
    of_user = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
    of_host = (os.environ.get("XDG_CONFIG_DIRS") or "/etc/xdg").split(os.pathsep)
    for folder in (name, *(os.path.join(place, "snakemake", name) for place in (of_user, *of_host))):
        if os.path.isdir(folder):
            return os.path.abspath(folder)
    raise InputError("no such profile", where="--profile", got=name,
                     expected=f"{', '.join(sorted(known))} or a folder")


def _cancel_jobs(process: subprocess.Popen) -> None:
    """Lets Snakemake take back what it has submitted: jobs elsewhere do not die with it."""
    process.send_signal(signal.SIGINT)
    with contextlib.suppress(subprocess.TimeoutExpired, KeyboardInterrupt):
        process.wait(60)


def _die_with_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell's background job would hand on that it is ignored
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
