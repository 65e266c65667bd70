"""What a running stage tells: a bar on a terminal, plain lines elsewhere, log.txt always, events for the workflow."""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
import time
import traceback
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from tqdm import tqdm

Item = TypeVar("Item")
_EVENT_S, _LINE_S = 0.2, 5.0


def terminal_bar(items: Iterable[Item] | None, label: str, total: int | None) -> tqdm:
    """A tqdm bar that leaves nothing behind. A terminal that states no size counts as 80 x 24: tqdm would draw nothing.
    """
    from tqdm import tqdm

    tqdm.monitor_interval = 0
    size = shutil.get_terminal_size()
    return tqdm(items, desc=label, total=total, leave=False, ncols=size.columns - 1, nrows=size.lines)


class Reporter:
    """Log, terminal and events of one stage. Under the workflow (events given) the terminal is the workflow's.

    Every line of a log has one form: `2026-11-21T14:03:08Z     12.3 s  info     text`, levels info, warning and error.
    """

    def __init__(self, stage: str, log: Path | None, events: Path | None = None) -> None:
        self.stage, self.events = stage, events
        self.warnings: list[str] = []
        self._log = open(log, "w", encoding="utf-8", errors="backslashreplace", buffering=1) if log else None  # noqa: SIM115
        self._start = time.perf_counter()

    def close(self) -> None:
        """Closes the log."""
        if self._log:
            with contextlib.suppress(OSError):
                self._log.close()
            self._log = None

    def note(self, text: str) -> None:
        """One line for the log and, without the workflow, for the terminal."""
        self.write_log(text)
        if not self.events:
            self._say(f"{self.stage}: {text}")

    def warn(self, text: str) -> None:
        """A warning: kept in the provenance, once per text."""
        if text in self.warnings:
            return
        self.warnings.append(text)
        self.write_log(text, "warning")
        self.event("warning", text=text)
        if not self.events:
            self._say(f"{self.stage}: warning: {text}")

    def write_log(self, text: str, level: str = "info") -> None:
        """Lines into log.txt, each with the time, the seconds since the start and its level."""
        if not self._log:
            return
        now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        with contextlib.suppress(OSError):
            for line in text.splitlines() or [""]:
                self._log.write(f"{now} {time.perf_counter() - self._start:8.1f} s  {level:7}  {line}\n")

    def write_trace(self) -> None:
        """The exception that is being handled, into the log."""
        self.write_log(traceback.format_exc(), "error")

    def event(self, kind: str, **content: object) -> None:
        """One line of JSON for the workflow, which reads along."""
        if self.events:
            with contextlib.suppress(OSError), open(self.events, "a", encoding="utf-8") as file:
                file.write(json.dumps({"kind": kind, "time": round(time.time(), 1), **content}) + "\n")

    def track(self, items: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
        """Hands on the items and shows how many are done."""
        if total is None and hasattr(items, "__len__"):
            total = len(items)
        start, done = time.perf_counter(), 0
        self.write_log(f"{label}: {total if total is not None else 'unknown number'} to do")
        try:
            for item in self._shown(items, label, total):
                yield item
                done += 1
        finally:
            self.write_log(f"{label}: {done} in {time.perf_counter() - start:.1f} s")

    def _shown(self, items: Iterable[Item], label: str, total: int | None) -> Iterable[Item]:
        if self.events:
            return self._with_ticks(items, total, _EVENT_S,
                                    lambda done: self.event("progress", label=label, done=done, total=total))
        if sys.stderr.isatty():
            return terminal_bar(items, f"{self.stage}: {label}", total)
        whole = f"/{total}" if total is not None else ""
        return self._with_ticks(items, total, _LINE_S, lambda done: self._say(f"{self.stage}: {label} {done}{whole}"))

    @staticmethod
    def _with_ticks(items: Iterable[Item], total: int | None, every_s: float, tick) -> Iterator[Item]:
        """Calls tick(done) at the start, every so many seconds and at the end."""
        last, done = time.perf_counter(), 0
        tick(0)
        for item in items:
            yield item
            done += 1
            if done == total or time.perf_counter() - last >= every_s:
                last = time.perf_counter()
                tick(done)

    @staticmethod
    def _say(text: str) -> None:
        if sys.stderr.isatty():
            from tqdm import tqdm

            tqdm.write(text, file=sys.stderr)
        else:
            sys.stderr.write(text + "\n")
            sys.stderr.flush()
