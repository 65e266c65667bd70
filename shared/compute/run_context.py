"""What long work tells while it runs: how far it is, and lines for the log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

Item = TypeVar("Item")


class Progress(Protocol):
    """Wraps the items of a loop, whose length it can ask for, under a label."""

    def __call__(self, items: Iterable[Item], label: str) -> Iterable[Item]: ...


def _silent(items: Iterable[Item], label: str) -> Iterator[Item]:
    return iter(items)


@dataclass(frozen=True)
class RunContext:
    """progress(items, label) wraps loops; note(text) takes a line for the log; nothing is told by default."""

    progress: Progress = _silent
    note: Callable[[str], None] = lambda text: None


SILENT = RunContext()
