"""Text and bars on one page, of several clips one below the other."""

from __future__ import annotations

from shared.contract import Job, Output, Parameter, Stage, main

STAGE = Stage(
    name="export_page",
    version=1,
    help="Writes the page.",
    inputs=("read_text", "draw_bars"),
    joins=("read_text", "draw_bars"),
    outputs=(Output("page.txt", "the page"), Output("report.html", "costs", volatile=True)),
    parameters=(Parameter("title", str, "Words", "Title of the page."),),
)


def run(job: Job) -> None:
    """Writes the page and, as its report, what the bars cost."""
    parts = [job.params.title]
    for clip in job.clips or ("",):
        text, bars = job.input("read_text", clip) / "text.txt", job.input("draw_bars", clip) / "bars.txt"
        parts += [clip] * bool(clip) + [text.read_text(), bars.read_text()]
    (job.out / "page.txt").write_text("\n\n".join(parts))
    seconds, version = job.provenance("draw_bars")["wall_s"], job.manifest("draw_bars")["version"]
    (job.out / "report.html").write_text(f"{seconds} {version}")


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run))
