"""The counts as bars."""

from __future__ import annotations

import json

from shared.contract import Job, Output, Parameter, Stage, main

STAGE = Stage(
    name="draw_bars",
    version=1,
    help="Draws bars.",
    inputs=("count_words",),
    outputs=(Output("bars.txt", "one line for each word"),),
    parameters=(Parameter("width", int, 10, "Longest bar.", "letters", 1, 80),),
)


def run(job: Job) -> None:
    """Writes a bar for each word."""
    counts = json.loads((job.input("count_words") / "words.json").read_text())
    lines = [f"{word} {'#' * min(count, job.params.width)}" for word, count in sorted(counts.items())]
    (job.out / "bars.txt").write_text("\n".join(lines))


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run))
