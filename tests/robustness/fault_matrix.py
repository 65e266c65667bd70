"""Disturbs runs in every way that happens to operators and compares the outcome with an undisturbed run.

    python tests/robustness/fault_matrix.py [--kills 40] [--writes 60] [--toy] [--seed 0] [--json FILE] [FAULT ...]

FAULT: by_hand, kill, writes, disk_full, read_only, clock, two_runs, half_manifest, flipped_bit (all). Each must leave
the source as it was and, after at most one more run, exactly the results of the undisturbed run. by_hand runs each
stage without the workflow. writes disturbs single writes of a stage, drawn from all of them (--writes 0: every one, in
three ways each, which takes hours): afterwards the earlier result is there or the new one. disk_full and read_only
mount a tmpfs, clock and writes compile a library to preload: where that is impossible they say so and are left out.
Exit code 1 for wrong results.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
from faulty_files import KINDS  # noqa: E402
from quick import SETTINGS, TINY  # noqa: E402
from toy_runs import copy_pipeline, make_subject  # noqa: E402

from shared.contract.declare import folder_of  # noqa: E402
from shared.contract.folders import RunFolder  # noqa: E402
from shared.contract.hashing import HashMemory  # noqa: E402
from shared.contract.interpreter import settled_environment  # noqa: E402
from shared.contract.manifest import damage, read_manifest  # noqa: E402
from shared.contract.pipeline import REPOSITORY, load_pipeline  # noqa: E402

DISK_MB = 600
OTHERWISE = {
    "sample_frames": "min_sharpness=0.39", "track_landmarks": "outlier_factor=4.1", "init_albedo": "frames=39",
    "inverse_render": "independent_samples=4999", "export_usd": "map_format=float",
    "read_text": "letters=upper", "count_words": "least=2", "draw_bars": "width=9", "export_page": "title=Letters",
}
"""Of each stage a setting by which it makes the same files, with other content."""
FAULTY_FILES = Path(__file__).with_name("faulty_files.c")


class Bench:
    """One subject, how to run it, and what an undisturbed run makes of it."""

    def __init__(self, scratch: Path, toy: bool, rng: random.Random) -> None:
        self.scratch, self.rng = scratch, rng
        self.subject = scratch / "anna"
        if toy:
            self.pipeline = load_pipeline(copy_pipeline(scratch / "toy"))
            make_subject(self.subject)
            self.settings = ["count_words.pause_s=1"]
        else:
            self.pipeline = load_pipeline()
            shutil.copytree(TINY, self.subject, ignore=shutil.ignore_patterns("gt"))
            self.settings = [*SETTINGS]
        self.arguments = ["--pipeline", self.pipeline.path, *(f"--set={setting}" for setting in self.settings)]
        self.stages = list(self.pipeline.steps)
        self.source = contents(self.subject)
        self.reference = scratch / "reference" / "anna"
        start = time.monotonic()
        code, output = self.run(self.reference.parent)
        self.seconds = time.monotonic() - start
        if code not in (0, 3):
            raise RuntimeError(f"the undisturbed run failed:\n{output}")
        self.truth = self.results(self.reference)
        provenance = {name: self.reference / folder_of(name) / "provenance.json" for name in self.stages}
        self.stage_seconds = {name: json.loads(path.read_text())["wall_s"] for name, path in provenance.items()}

    def command(self, out: Path) -> list[str]:
        """`limn run` with its results under out/anna."""
        return [sys.executable, "-m", "tools.limn", "run", *map(str, (self.subject, "--out", out, "--cores", 1,
                                                                      *self.arguments))]

    def by_hand(self, stage: str, out: Path) -> list[str]:
        """The same of one stage, without the workflow."""
        own = [f"--set={setting}" for setting in self.settings if setting.startswith(f"{stage}.")]
        return [sys.executable, "-m", f"{self.pipeline.package}.{stage}", *map(str, (
            "--subject", self.subject, "--out", out, "--pipeline", self.pipeline.path, "--threads", 1, *own))]

    def start(self, out: Path, **environment: str) -> subprocess.Popen:
        """The command, running."""
        return subprocess.Popen(self.command(out), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                                stdin=subprocess.DEVNULL, start_new_session=True, env={**os.environ, **environment})

    def run(self, out: Path, **environment: str) -> tuple[int, str]:
        """-> exit code and output."""
        process = self.start(out, **environment)
        output, _ = process.communicate(timeout=600)
        return process.returncode, output

    def results(self, run: Path) -> dict[str, str]:
        """{file: SHA-256} of all that the manifests vouch for, read from the files themselves."""
        found = {}
        for name in self.stages:
            manifest = json.loads((run / folder_of(name) / "manifest.json").read_text())
            for file, entry in manifest["outputs"].items():
                if not entry.get("volatile"):
                    path = run / folder_of(name) / file
                    found[f"{name}/{file}"] = hashlib.sha256(path.read_bytes()).hexdigest()
        return found

    @cached_property
    def writes(self) -> list[tuple[str, str, int]]:
        """(stage, kind of fault, number of the write) for all writes of all stages, in an order drawn by chance.

        Each stage is run with another setting for that: what it makes is kept as its earlier result.
        """
        subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", self.faulty_files, FAULTY_FILES, "-ldl"], check=True)
        every = []
        for stage in self.stages:
            out, log = self.scratch / "earlier" / stage, self.scratch / f"{stage}.writes"
            self.prepared(out, stage)
            done = self.with_faults(stage, out, "--set", OTHERWISE[stage], FAULTY_LOG=str(log))
            if done.returncode != 0:
                raise RuntimeError(f"{stage} with another setting failed:\n{done.stdout}")
            every += [(stage, kind, at) for at in range(1, len(log.read_text().splitlines()) + 1) for kind in KINDS]
        self.rng.shuffle(every)
        return every

    @property
    def faulty_files(self) -> Path:
        """The library to preload."""
        return self.scratch / "faulty_files.so"

    def with_faults(self, stage: str, out: Path, *arguments: str, **faults: str) -> subprocess.CompletedProcess:
        """One stage by hand, its writes counted and disturbed."""
        search = os.pathsep.join([str(self.pipeline.root), str(REPOSITORY)])
        environment = {**os.environ, **settled_environment(1), "PYTHONPATH": search, **faults,
                       "LD_PRELOAD": str(self.faulty_files), "FAULTY_FOLDER": str(out / "anna")}
        return subprocess.run([*self.by_hand(stage, out), *arguments], env=environment, stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT, text=True, errors="replace", check=False)

    def published(self, run: Path, stage: str) -> dict[str, str] | str | None:
        """{file: SHA-256} of a stage's result; None where there is none, a text where it is not whole."""
        folder = run / folder_of(stage)
        if not folder.exists():
            return None
        manifest = read_manifest(folder)
        faults = damage(folder, manifest, HashMemory(self.scratch / "memory.json", verify=True)) if manifest else [
            "half published"]
        vouched = [name for name, entry in manifest["outputs"].items() if not entry.get("volatile")] if manifest else []
        return "; ".join(faults) or {name: hashlib.sha256((folder / name).read_bytes()).hexdigest()
                                     for name in (*vouched, "manifest.json")}

    def prepared(self, out: Path, until: str) -> Path:
        """out/anna with the results of all stages but this one, so that it has to run."""
        run = out / "anna"
        for name in self.stages:
            if name != until:
                shutil.copytree(self.reference / folder_of(name), run / folder_of(name))
        return run

    def only_before(self, out: Path, until: str) -> None:
        """Removes the results of all stages after this one, too: they have to be made again."""
        for name in self.stages[self.stages.index(until) + 1:]:
            shutil.rmtree(out / "anna" / folder_of(name))

    def judge(self, out: Path, **environment: str) -> list[str]:
        """Runs once more; what is wrong then."""
        code, output = self.run(out, **environment)
        faults = [] if code in (0, 3) else [f"the next run ended with {code}: {output.splitlines()[-1:]}"]
        faults += ["Traceback"] * ("Traceback" in output)
        return faults + self.wrong(out)

    def wrong(self, out: Path) -> list[str]:
        """Results that differ from the undisturbed run, inputs that were lost, files left behind."""
        try:
            found = self.results(out / "anna")
        except (OSError, ValueError, KeyError) as error:
            return [f"incomplete: {error}"]
        faults = [f"{name} differs" for name in self.truth if found.get(name) != self.truth[name]][:3]
        faults += ["the source changed"] * (contents(self.subject) != self.source)
        left = [path.name for path in (out / "anna" / "work").iterdir()
                if path.name.startswith(".") and path.name != ".hashes.json"]
        return faults + [f"left behind: {left}"] * bool(left)

    def wait_for_stage(self, process: subprocess.Popen, out: Path, stage: str) -> bool:
        """Waits until the stage's temporary folder is there; False where the run ended before."""
        work = out / "anna" / "work"
        while process.poll() is None:
            if any(work.glob(f".{stage}.tmp-*")):
                return True
            time.sleep(0.005)
        return False


def contents(folder: Path) -> dict[str, str]:
    """{file: SHA-256} of a folder."""
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob("*")) if path.is_file()}


def half_published(run: Path, stages: list[str]) -> list[str]:
    """Stage folders that are there without being whole."""
    return [f"{name} is half there" for name in stages
            if (run / folder_of(name)).exists() and not (run / folder_of(name) / "manifest.json").is_file()]


def by_hand(bench: Bench, out: Path, number: int) -> list[str]:
    """Every stage by hand, where nobody set threads before: the same bytes, the manifests' too, in every second case
    under settings of the user's own."""
    others = {"OMP_NUM_THREADS": "7", "OPENBLAS_NUM_THREADS": "7", "MKL_CBWR": "AVX2", "PYTHONHASHSEED": "7"}
    own = others if number % 2 else {}
    kept = {name: value for name, value in os.environ.items() if name not in settled_environment(1)}
    search = os.pathsep.join([str(bench.pipeline.root), str(REPOSITORY)])
    for stage in bench.stages:
        done = subprocess.run(bench.by_hand(stage, out), env={**kept, **own, "PYTHONPATH": search}, text=True,
                              capture_output=True, check=False)
        if done.returncode != 0:
            return [f"{stage} ended with {done.returncode}: {done.stderr.splitlines()[-1:]}"]
    return bench.wrong(out) + [
        f"{name}/manifest.json differs" for name in bench.stages
        if (out / "anna" / folder_of(name) / "manifest.json").read_bytes()
        != (bench.reference / folder_of(name) / "manifest.json").read_bytes()]


def kill(bench: Bench, out: Path, number: int) -> list[str]:
    """SIGKILL at a random moment of a stage: to limn, to the stage, or to everything at once."""
    stage = bench.stages[number % len(bench.stages)]
    victim = ("limn", "stage", "all")[number // len(bench.stages) % 3]
    bench.prepared(out, stage)
    if number % 4 == 0:
        bench.only_before(out, stage)
    process = bench.start(out)
    began = bench.wait_for_stage(process, out, stage)
    time.sleep(bench.rng.uniform(0, 1.2) * bench.stage_seconds[stage])
    group = family(process.pid)
    stages = [pid for pid in group if RunFolder(out / "anna").temporary_of(stage, pid).exists()]
    for pid in {"limn": [process.pid], "stage": stages, "all": group}[victim]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.communicate(timeout=600)
    deadline = time.monotonic() + 5
    while any(alive(pid) for pid in group) and time.monotonic() < deadline:
        time.sleep(0.02)
    faults = [f"process {pid} outlived" for pid in group if alive(pid)] + ["never began"] * (not began)
    return faults + half_published(out / "anna", bench.stages) + bench.judge(out)


def writes(bench: Bench, out: Path, number: int) -> list[str]:
    """A full or failing disk, or a kill, at one write of a stage, every second time over an earlier result."""
    stage, kind, at = bench.writes[number]
    run = bench.prepared(out, stage)
    old = None
    if number % 2:
        earlier = bench.scratch / "earlier" / stage / "anna"
        shutil.copytree(earlier / folder_of(stage), run / folder_of(stage))
        old = bench.published(earlier, stage)
    new = bench.published(bench.reference, stage)
    done = bench.with_faults(stage, out, FAULTY_AT=str(at), FAULTY_AS=kind)
    found = bench.published(run, stage)
    allowed = (0, -signal.SIGKILL) if kind == "kill" else (0, 1, 2)
    faults = [] if found in (old, new) else [f"a third result: {found if isinstance(found, str) else 'other bytes'}"]
    faults += [f"ended with {done.returncode}: {done.stdout.splitlines()[-3:]}"] * (done.returncode not in allowed)
    faults += ["called done, is not"] * (done.returncode == 0 and found != new)
    faults += ["Traceback"] * (done.returncode == 2 and "Traceback" in done.stdout)
    faults += ["the source changed"] * (contents(bench.subject) != bench.source)
    if number % 10 == 0:
        faults += bench.judge(out)
    return [f"{stage}, {kind} at write {at}: {fault}" for fault in faults]


def disk_full(bench: Bench, out: Path, number: int) -> list[str]:
    """The disk is filled to the last byte while a stage runs; a stage that is faster than that may finish."""
    stage = bench.stages[number % len(bench.stages)]
    with mounted(out):
        bench.prepared(out, stage)
        process = bench.start(out)
        bench.wait_for_stage(process, out, stage)
        filler = out / "filler"
        with contextlib.suppress(OSError), open(filler, "wb", buffering=0) as file:
            while process.poll() is None:
                with contextlib.suppress(OSError):
                    file.write(bytes(1 << 16))
                with contextlib.suppress(OSError):
                    file.write(bytes(512))
        output, _ = process.communicate(timeout=600)
        faults = half_published(out / "anna", bench.stages) + ["Traceback"] * ("Traceback" in output)
        if process.returncode not in (0, 3) and (process.returncode != 2 or "space" not in output):
            faults.append(f"ended with {process.returncode}: {output.splitlines()}")
        filler.unlink()
        return faults + bench.judge(out)


def read_only(bench: Bench, out: Path, number: int) -> list[str]:
    """Results on a disk that cannot be written, empty or with the results of some stages."""
    with mounted(out):
        if number % 2:
            bench.prepared(out, bench.stages[-1])
        else:
            (out / "anna").mkdir()
        before = contents(out)
        subprocess.run(["mount", "-o", "remount,ro", str(out)], check=True)
        code, output = bench.run(out)
        lines = [line for line in output.splitlines() if "cannot write here" in line]
        faults = [f"ended with {code}: {output.splitlines()[-3:]}"] * (code != 2 or len(lines) != 1)
        faults += ["files changed"] * (contents(out) != before)
        subprocess.run(["mount", "-o", "remount,rw", str(out)], check=True)
        return faults + bench.judge(out)


def clock(bench: Bench, out: Path, number: int) -> list[str]:
    """The clock jumps by years, there and back, while the stages run; then all times on disk are of another century."""
    offset, library = bench.scratch / "offset", bench.scratch / "jumping_clock.so"
    source = Path(__file__).with_name("jumping_clock.c")
    subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    offset.write_text("0")
    process = bench.start(out, LD_PRELOAD=str(library), JUMPING_CLOCK=str(offset))
    while process.poll() is None:
        offset.write_text(str(bench.rng.choice([-10, -3, 0, 10]) * 365 * 86400))
        time.sleep(0.15 * bench.seconds / len(bench.stages))
    output, _ = process.communicate()
    faults = [f"ended with {process.returncode}: {output.splitlines()[-3:]}"] * (process.returncode not in (0, 3))
    faults += bench.wrong(out)
    for path in (out / "anna").rglob("*"):
        moment = bench.rng.choice([0, 2**31, 4 * 10**9])
        os.utime(path, (moment, moment))
    return faults + bench.judge(out)


def two_runs(bench: Bench, out: Path, number: int) -> list[str]:
    """A second run of the same subject while the first works on one of the stages."""
    stage = bench.stages[number % len(bench.stages)]
    bench.prepared(out, stage)
    first = bench.start(out)
    bench.wait_for_stage(first, out, stage)
    code, output = bench.run(out)
    faults = [] if code == 2 and "another process works here" in output or first.poll() is not None else [
        f"the second ended with {code}"]
    output, _ = first.communicate(timeout=600)
    faults += [f"the first ended with {first.returncode}"] * (first.returncode not in (0, 3))
    return faults + bench.wrong(out)


def half_manifest(bench: Bench, out: Path, number: int) -> list[str]:
    """A manifest that was cut at a random place."""
    stage = bench.stages[number % len(bench.stages)]
    shutil.copytree(bench.reference, out / "anna")
    path = out / "anna" / folder_of(stage) / "manifest.json"
    data = path.read_bytes()
    path.write_bytes(data[:bench.rng.randrange(len(data) - 2)])
    return bench.judge(out)


def flipped_bit(bench: Bench, out: Path, number: int) -> list[str]:
    """One bit of one file of a stage, its time of change set back."""
    stage = bench.stages[number % len(bench.stages)]
    shutil.copytree(bench.reference, out / "anna")
    bench.run(out)
    names = [name.partition("/")[2] for name in bench.truth if name.startswith(f"{stage}/")]
    path = out / "anna" / folder_of(stage) / bench.rng.choice(sorted(names))
    data, times = bytearray(path.read_bytes()), path.stat()
    data[bench.rng.randrange(len(data))] ^= 1 << bench.rng.randrange(8)
    path.write_bytes(data)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    return bench.judge(out)


@contextlib.contextmanager
def mounted(folder: Path) -> Iterator[None]:
    """A tmpfs of its own on the folder."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def family(pid: int) -> list[int]:
    """A process and all below it."""
    import psutil

    with contextlib.suppress(psutil.Error):
        process = psutil.Process(pid)
        return [pid, *(child.pid for child in process.children(recursive=True))]
    return [pid]


def alive(pid: int) -> bool:
    """Whether the process runs still."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


def can_mount() -> bool:
    """Whether this process may mount a tmpfs."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(["mount", "-t", "tmpfs", "tmpfs", folder], capture_output=True, check=False)
        if done.returncode == 0:
            subprocess.run(["umount", folder], check=True)
        return done.returncode == 0


FAULTS: dict[str, tuple[Callable[[Bench, Path, int], list[str]], int, str]] = {
    "by_hand": (by_hand, 2, ""), "kill": (kill, 40, ""), "writes": (writes, 60, "cc"),
    "disk_full": (disk_full, 5, "mount"), "read_only": (read_only, 2, "mount"), "clock": (clock, 2, "cc"),
    "two_runs": (two_runs, 3, ""), "half_manifest": (half_manifest, 5, ""), "flipped_bit": (flipped_bit, 5, ""),
}


def main(arguments: list[str] | None = None) -> int:
    """Prints a line for each disturbance and a sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("faults", nargs="*", metavar="FAULT", help=", ".join(FAULTS))
    parser.add_argument("--kills", type=int, default=40)
    parser.add_argument("--writes", type=int, default=60)
    parser.add_argument("--toy", action="store_true", help="the toy pipeline of the tests: seconds instead of minutes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    able = {"mount": can_mount(), "cc": shutil.which("cc") is not None, "": True}
    records = []
    with tempfile.TemporaryDirectory(prefix="limn-faults-") as folder:
        bench = Bench(Path(folder), options.toy, random.Random(options.seed))
        print(f"undisturbed: {bench.seconds:.1f} s, {len(bench.truth)} files", flush=True)
        for name in options.faults or FAULTS:
            fault, count, needs = FAULTS[name]
            if not able[needs]:
                print(f"{name}: left out, {needs} is not possible here")
                continue
            count = {"kill": options.kills, "writes": options.writes}.get(name, count)
            for number in range(count or len(bench.writes)):
                out = Path(tempfile.mkdtemp(dir=folder))
                start = time.monotonic()
                wrong = fault(bench, out, number)
                seconds = time.monotonic() - start
                shutil.rmtree(out)
                records.append({"fault": name, "number": number, "wrong": wrong})
                print(f"{name:14} {number:3}  {seconds:6.1f} s  {'; '.join(wrong) or 'equal'}", flush=True)
    bad = [record for record in records if record["wrong"]]
    print(f"{len(records)} disturbances, {len(bad)} wrong")
    if options.json:
        options.json.write_text(json.dumps(records, indent=1) + "\n")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
