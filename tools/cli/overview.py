"""One self-contained page over many subjects: pictures, gates, warnings and costs in a table that can be sorted."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from urllib.parse import quote

from shared.contract.declare import EXPORT, folder_of
from shared.contract.folders import RunFolder
from shared.contract.manifest import read_record
from shared.contract.pipeline import Pipeline
from shared.errors import InputError
from tools.cli.cases import SubjectCase
from tools.cli.gates import RECORD, read_flags
from tools.cli.outcome import Outcome, costs_of
from tools.cli.plan import CURRENT, StagePlan
from tools.cli.records import number_of
from tools.cli.summary import ORDER

TEMPLATE = Path(__file__).with_name("overview_page.html")
FINISHED = ("review", "done")


def outcome_now(case: SubjectCase, pipeline: Pipeline, plans: Mapping[str, StagePlan]) -> Outcome:
    """How the subject stands, from its plan and its records; nothing is run, judged or written."""
    facts = {"subject": case.name, "folder": str(case.subject.folder), "results": str(case.run.root),
             **costs_of(case, pipeline)}
    left = [name for name, plan in plans.items() if plan.state != CURRENT]
    if left:
        return Outcome(state="not run", stage=left[0], reason="; ".join(plans[left[0]].reasons), **facts)
    flags = tuple(read_flags(case.run))
    return Outcome(state="review" if flags else "done", stage=list(plans)[-1], flags=flags,
                   reason="; ".join(map(str, flags)), **facts)


def values_of(run: RunFolder) -> dict[str, float]:
    """{gate: value} as they were judged; without what is no number."""
    values = (read_record(run.work / RECORD) or {}).get("values")
    return {name: float(values[name]) for name in values if number_of(values, name) is not None} if isinstance(
        values, dict) else {}


def write_overview(path: Path, outcomes: Sequence[Outcome], pipeline: Pipeline) -> None:
    """Writes the page: whole, or as it was before."""
    page = overview_page(outcomes, pipeline, path.parent)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(page, encoding="utf-8", errors="replace")
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise InputError("the overview cannot be written", where=str(path), got=error.strerror,
                         hint="choose another place") from error


def page_beside(summary: Path) -> Path:
    """Where the page of a summary goes: summary.html for summary.json."""
    return summary.with_suffix(".html") if summary.suffix == ".json" else summary.with_name(f"{summary.name}.html")


def overview_page(outcomes: Sequence[Outcome], pipeline: Pipeline, folder: Path) -> str:
    """The page as text, the worst subject first. folder: where it will lie; its links are relative to that."""
    ordered = sorted(outcomes, key=lambda outcome: (ORDER.index(outcome.state), outcome.subject))
    gates = [(name, gate.limit) for name, gate in pipeline.gates.items()]
    head = [_heading("subject"), "<th>pictures</th>", _heading("state"), _heading("reason"),
            *(_heading(name.replace("_", " "), limit) for name, limit in gates),
            *map(_heading, ("warnings", "minutes", "memory", "on disk"))]
    counts = [f"{sum(o.state == state for o in outcomes)} {state}" for state in reversed(ORDER)
              if any(o.state == state for o in outcomes)]
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        count=len(outcomes), tally=escape(", ".join(counts)), head="".join(head),
        rows="\n".join(_row(outcome, [name for name, _ in gates], folder) for outcome in ordered))


def _heading(name: str, limit: str = "") -> str:
    note = f"<small>{escape(limit)}</small>" if limit else ""
    return f'<th aria-sort="none"><button type="button">{escape(name)}{note}</button></th>'


def _row(outcome: Outcome, gates: Sequence[str], folder: Path) -> str:
    """One subject. Every text from outside passes through escape()."""
    run = RunFolder(Path(outcome.results)) if outcome.results else None
    is_judged = run is not None and outcome.state in FINISHED and _is_whole(outcome)
    values, missed = values_of(run) if is_judged else {}, {flag.gate for flag in outcome.flags}
    where = f"{outcome.stage}: " if outcome.stage and outcome.state not in FINISHED else ""
    cells = [_cell(_name(outcome, run, folder), outcome.subject),
             f'<td class="pictures">{_pictures(outcome, run)}</td>',
             _cell(f'<span class="state">{outcome.state}</span>', ORDER.index(outcome.state)),
             _cell(escape(where + outcome.reason), outcome.reason, "reason")]
    for gate in gates:
        value = values.get(gate)
        kind = "missed" if gate in missed else "number"
        cells.append(_cell("-" if value is None else f"{value:.3g}", "" if value is None else value, kind))
    listed = "".join(f"<li>{escape(str(text))}</li>" for text in outcome.warnings)
    warnings = f"<details><summary>{len(outcome.warnings)}</summary><ul>{listed}</ul></details>" if listed else "0"
    cells += [_cell(warnings, len(outcome.warnings)), _cell(f"{outcome.minutes:.1f}", outcome.minutes, "number"),
              _cell(f"{outcome.memory_mb:.0f} MB", outcome.memory_mb, "number"),
              _cell(f"{outcome.bytes / 1e6:.1f} MB", outcome.bytes, "number")]
    return f'<tr class="{outcome.state.replace(" ", "-")}">{"".join(cells)}</tr>'


def _is_whole(outcome: Outcome) -> bool:
    """Whether the subject went as far as the export, and not as far as it was told to only."""
    return folder_of(outcome.stage.rpartition("/")[2]) == EXPORT


def _cell(html: str, key: object, kind: str = "") -> str:
    mark = f' class="{kind}"' if kind else ""
    return f'<td{mark} data-key="{escape(str(key))}">{html}</td>'


def _name(outcome: Outcome, run: RunFolder | None, folder: Path) -> str:
    """The subject's name, linked to its report and to the picture that shows what is wrong, where they are."""
    report = run.root / EXPORT / "report.html" if run else None
    name = escape(outcome.subject)
    if report and outcome.state in FINISHED and report.is_file():
        name = f'<a href="{_link(report, folder)}">{name}</a>'
    for path, text in ((outcome.picture, "review"), (outcome.log, "log")):
        name += f' <a class="more" href="{_link(Path(path), folder)}">{text}</a>' if path else ""
    return name


def _link(path: Path, folder: Path) -> str:
    relative = os.path.relpath(os.path.abspath(path), os.path.abspath(folder))
    return escape(quote(os.fsencode(f"./{relative}")))


def _pictures(outcome: Outcome, run: RunFolder | None) -> str:
    """Thumbnails; where they cannot be read, words that say so."""
    if run is None:
        return ""
    from tools.cli.thumbnails import PICTURE_ERRORS, crop_pictures, result_pictures

    try:
        is_whole = outcome.state in FINISHED and _is_whole(outcome)
        found = result_pictures(run) if is_whole else crop_pictures(run)
    except PICTURE_ERRORS as error:
        return f'<span class="missed">cannot be read: {escape(str(error))}</span>'
    return "".join(f'<img src="{uri}" alt="{escape(text)}" title="{escape(text)}">' for text, uri in found)
