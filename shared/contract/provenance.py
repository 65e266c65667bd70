"""provenance.json: when, where, at what cost and with which packages. Never part of a key."""

from __future__ import annotations

import contextlib
import os
import platform
import resource
import sys
import threading
import time
from datetime import UTC, datetime
from functools import cache
from importlib import metadata

from shared.contract.machine import kernels, processor

_SAMPLE_S = 0.5


class Meter:
    """Wall and CPU seconds and the peak resident memory of this process and its children."""

    def __init__(self) -> None:
        self.started = datetime.now(UTC).isoformat(timespec="seconds")
        self._wall, self._cpu = time.perf_counter(), _cpu_seconds()
        self._peak = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def stop(self) -> dict[str, object]:
        """{"started", "wall_s", "cpu_s", "peak_memory_mb"}."""
        self._stop.set()
        self._thread.join()
        peak = max(self._peak, own_peak_bytes(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024)
        return {
            "started": self.started,
            "wall_s": round(time.perf_counter() - self._wall, 3),
            "cpu_s": round(_cpu_seconds() - self._cpu, 3),
            "peak_memory_mb": round(peak / 2**20, 1),
        }

    def _watch(self) -> None:
        import psutil

        own = psutil.Process()
        while not self._stop.wait(_SAMPLE_S):
            with contextlib.suppress(psutil.Error):
                children = own.children(recursive=True)
                if children:
                    self._peak = max(self._peak, sum(_resident(p) for p in [own, *children]))


def _resident(process: object) -> int:
    import psutil

    try:
        return process.memory_info().rss
    except psutil.Error:
        return 0


def _cpu_seconds() -> float:
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def own_peak_bytes() -> int:
    """High-water mark since exec; getrusage would also count what the parent had before it."""
    with contextlib.suppress(OSError), open("/proc/self/status", encoding="ascii") as file:
        for line in file:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@cache
def installed_packages() -> tuple[tuple[str, str, frozenset[str]], ...]:
    """(name, version, its top modules) of each installed package, as this process found them."""
    found = []
    for distribution in metadata.distributions():
        tops = (distribution.read_text("top_level.txt") or "").split() or [distribution.name.replace("-", "_")]
        found.append((distribution.name, distribution.version, frozenset(top.partition("/")[0] for top in tops)))
    return tuple(found)


def environment() -> dict[str, object]:
    """Host, platform, processor, kernels chosen for it, Python, versions of the loaded packages, command line."""
    loaded = {name.partition(".")[0] for name in sys.modules}
    packages = {name: version for name, version, tops in installed_packages() if not loaded.isdisjoint(tops)}
    return {
        "host": platform.node(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "cpu": processor(),
        "kernels": kernels(),
        "packages": packages,
        "command": [sys.executable, *sys.argv],
    }
