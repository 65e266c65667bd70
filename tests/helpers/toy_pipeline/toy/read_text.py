"""The subject's clip, here a text file, in one case of letters."""

from __future__ import annotations

from shared.contract import Job, Output, Parameter, Stage, main
from shared.errors import InputError

CASES = ("lower", "upper", "same")
STAGE = Stage(
    name="read_text",
    version=1,
    help="Reads the text.",
    inputs=(),
    outputs=(Output("text.txt", "the text"), Output("lines/*.txt", "its lines", optional=True)),
    parameters=(Parameter("letters", str, "lower", "Case of the letters.", choices=CASES),),
)


def run(job: Job) -> None:
    """Writes the text and its lines."""
    text = job.subject.video.read_text()
    if "no face" in text:
        raise InputError("no face in the clip", where=str(job.subject.video), hint="film a face")
    text = {"lower": text.lower(), "upper": text.upper(), "same": text}[job.params.letters]
    (job.out / "text.txt").write_text(text)
    (job.out / "lines").mkdir()
    for i, line in enumerate(job.progress(text.splitlines(), "lines")):
        (job.out / "lines" / f"{i:03d}.txt").write_text(line)


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run))
