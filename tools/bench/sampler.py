"""Runs a stage under a sampling profiler: `python -m tools.bench.sampler OUT.json STAGE [stage arguments]`.

A thread looks at the stacks of all Python threads every ten milliseconds. Wall time since the last look goes to the
phase of the main thread. Processor time of a Python thread goes to that thread's phase; that of threads without Python
(compiled loops, libraries) to the main thread's, which waits for them as a rule. The sum is the whole: nothing is
extrapolated from counts. A call that holds the interpreter's lock delays the look, and its time falls to what is seen
then. Loads nothing heavy before the stage does.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from tools.bench.phases import CHILDREN, SAMPLER, START, phase_of

INTERVAL_S = 0.01
_PAGE = os.sysconf("SC_PAGE_SIZE")


class Sampler:
    """Samples this process from `start` to `stop`."""

    def __init__(self, interval_s: float = INTERVAL_S):
        self.interval_s, self.samples = interval_s, 0
        self.phases: dict[str, dict] = {}
        self._stop = threading.Event()
        self._main = threading.get_ident()
        self._thread = threading.Thread(target=self._watch, daemon=True, name="sampler")
        self._wall, self._cpu, self._own, self._children = 0.0, 0.0, {}, _children_s()

    def start(self) -> None:
        """The interpreter's start counts as a phase of its own."""
        self._wall, self._cpu = time.perf_counter(), time.process_time()
        self._add(START, "before the first line", _age_s(), self._cpu)
        self._thread.start()

    def stop(self) -> dict:
        """{"phases": {name: {"wall_s", "cpu_s", "peak_mb", "functions": {name: cpu_s}}}, "wall_s", "cpu_s", "samples",
        "peak_mb"}."""
        self._stop.set()
        self._thread.join()
        if (seconds := _children_s() - self._children) > 0.0:
            self._add(CHILDREN, "children", 0.0, seconds)
        totals = {name: sum(phase[name] for phase in self.phases.values()) for name in ("wall_s", "cpu_s")}
        peak = max((phase["peak_mb"] for phase in self.phases.values()), default=0.0)
        return {"phases": self.phases, **totals, "samples": self.samples, "peak_mb": peak}

    def _add(self, phase: str, function: str, wall_s: float, cpu_s: float, resident_mb: float = 0.0) -> None:
        empty = {"wall_s": 0.0, "cpu_s": 0.0, "peak_mb": 0.0, "functions": {}}
        entry = self.phases.setdefault(phase, empty)
        entry["wall_s"] += wall_s
        entry["cpu_s"] += cpu_s
        entry["peak_mb"] = max(entry["peak_mb"], resident_mb)
        entry["functions"][function] = entry["functions"].get(function, 0.0) + cpu_s

    def _watch(self) -> None:
        while not self._stop.wait(self.interval_s):
            self._look()
        self._look()

    def _look(self) -> None:
        wall, cpu = time.perf_counter(), time.process_time()
        frames = sys._current_frames()
        native = {thread.ident: thread.native_id for thread in threading.enumerate()}
        resident, left = _resident_mb(), cpu - self._cpu
        own = {ident: _thread_s(native[ident]) for ident in frames if native.get(ident)}
        for ident, seconds in own.items():
            if ident == self._main:
                continue
            used = min(max(0.0, seconds - self._own.get(ident, 0.0)), left)
            left -= used
            if used and ident == self._thread.ident:
                self._add(SAMPLER, "sampler", 0.0, used)
            elif used:
                self._add(*phase_of(_stack(frames[ident])), 0.0, used, resident)
        self._add(*phase_of(_stack(frames.get(self._main))), wall - self._wall, left, resident)
        self._wall, self._cpu, self._own = wall, cpu, own
        self.samples += 1


def _stack(frame: FrameType | None) -> Iterator[tuple[str, str]]:
    while frame is not None:
        yield frame.f_globals.get("__name__") or "", frame.f_code.co_name
        frame = frame.f_back


def _thread_s(native: int) -> float:
    """Processor seconds of a thread so far; 0 where the kernel does not tell (it has just ended)."""
    try:
        with open(f"/proc/self/task/{native}/schedstat", encoding="ascii") as file:
            return int(file.read().split()[0]) / 1e9
    except (OSError, IndexError, ValueError):
        return 0.0


def _children_s() -> float:
    """Processor seconds of children that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _resident_mb() -> float:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * _PAGE / 2**20


def _age_s() -> float:
    """Seconds since this process started, to a hundredth."""
    fields = Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    uptime = float(Path("/proc/uptime").read_text(encoding="ascii").split()[0])
    return max(0.0, uptime - int(fields[19]) / os.sysconf("SC_CLK_TCK"))


def main() -> int:
    """The stage's exit code; OUT.json is written whatever it is."""
    out, folder, package, name, *arguments = sys.argv[1:]
    sampler = Sampler()
    sampler.start()
    from shared.contract import launch

    sys.argv = [launch.__file__, folder, package, name, *arguments]
    try:
        return launch.main()
    finally:
        Path(out).write_text(json.dumps(sampler.stop(), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
