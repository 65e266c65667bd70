"""The table at the end of a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from tools.cli.outcome import Outcome

_REASON_LETTERS = 110
ORDER = ("failed", "killed", "not run", "interrupted", "input error", "review", "done")
"""States of a subject, the worst first."""


def table_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """Subject, stage, state, minutes, memory, quality flags or reason: the worst first, then a sum."""
    ordered = sorted(outcomes, key=lambda outcome: (ORDER.index(outcome.state), outcome.subject))
    rows = [("subject", "stage", "state", "minutes", "memory", "flags, reason")]
    rows += [(o.subject, o.stage or "-", o.state, f"{o.minutes:.1f}", f"{o.memory_mb:.0f} MB", _why(o))
             for o in ordered]
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    lines = ["  ".join([*(cell.ljust(width) if i < 3 else cell.rjust(width)
                          for i, (cell, width) in enumerate(zip(row, widths, strict=False))), row[5]]).rstrip()
             for row in rows]
    counts = Counter(outcome.state for outcome in outcomes)
    tally = ", ".join(f"{counts[state]} {state}" for state in reversed(ORDER) if counts[state])
    return [*lines, f"{len(outcomes)} subjects: {tally}"]


def _why(outcome: Outcome) -> str:
    reason = outcome.reason if len(outcome.reason) <= _REASON_LETTERS else outcome.reason[:_REASON_LETTERS] + " ..."
    place = outcome.picture or outcome.log
    return f"{reason}; {place}" if place else reason
