"""How often each word occurs. `pause_s` or the variable TOY_PAUSE_S makes it slow, `hoard_mb` large, TOY_FAIL fail."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

from shared.contract import Job, Output, Parameter, Stage, main
from shared.errors import LimnError

STAGE = Stage(
    name="count_words",
    version=1,
    help="Counts words.",
    inputs=("read_text",),
    outputs=(Output("words.json", "{word: count}"), Output("when.json", "time of the run", volatile=True)),
    parameters=(
        Parameter("least", int, 1, "Fewest occurrences.", "words", 1, 100),
        Parameter("pause_s", float, 0.0, "Pause before the counting.", "s", 0.0, 600.0),
        Parameter("hoard_mb", int, 0, "Memory to hold meanwhile.", "MB", 0, 4000),
    ),
)


def run(job: Job) -> None:
    """Counts, after a pause in which half the result lies in the folder."""
    (job.out / "words.json").write_text("{")
    if "TOY_PID" in os.environ:
        Path(os.environ["TOY_PID"]).write_text(str(os.getpid()))
    hoard = b"x" * (job.params.hoard_mb << 20)
    pause_s = float(os.environ.get("TOY_PAUSE_S", job.params.pause_s))
    for _ in job.progress(range(int(pause_s * 10)), "pause"):
        time.sleep(0.1 + 0 * len(hoard))
    if "TOY_FAIL" in os.environ:
        raise ValueError("the abacus broke")
    words: dict[str, int] = {}
    for word in (job.input("read_text") / "text.txt").read_text().split():
        words[word] = words.get(word, 0) + 1
    kept = {word: count for word, count in words.items() if count >= job.params.least}
    (job.out / "words.json").write_text(json.dumps(kept, sort_keys=True))
    (job.out / "when.json").write_text(json.dumps({"time": time.time()}))
    if not kept:
        job.warn("no word is left")


def check(job: Job) -> None:
    """The counts can be read and none is below the limit."""
    counts = json.loads((job.out / "words.json").read_text()).values()
    if any(count < job.params.least for count in counts):
        raise LimnError("a word too rare was kept")


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run, check))
