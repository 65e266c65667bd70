"""One self-contained page over many subjects: pictures, gates, warnings and costs in a table that can be sorted."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

from shared.contract.declare import EXPORT, folder_of
from shared.contract.disk import replacing
from shared.contract.folders import RunFolder
from shared.contract.hashing import hash_value
from shared.contract.manifest import read_record, write_record
from shared.contract.pipeline import Pipeline
from shared.errors import InputError
from shared.report.template import filled
from tools.cli.cases import SubjectCase
from tools.cli.gates import RECORD, read_flags
from tools.cli.outcome import Outcome, costs_of
from tools.cli.plan import CURRENT, StagePlan
from tools.cli.records import number_of
from tools.cli.summary import ORDER

TEMPLATES = Path(__file__).with_name("templates")
FINISHED = ("review", "done")
KEPT_PICTURES = "thumbnails.json"
"""A finished subject's thumbnails in its work folder: reading its pictures takes ten times as long as all the rest."""


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
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_text(page, encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError("the overview cannot be written", where=str(path), got=error.strerror,
                         hint="choose another place") from error


def load_pictures() -> None:
    """Loads what the pictures of the page need, which otherwise happens when the first is written."""
    importlib.import_module("tools.cli.thumbnails")


def page_beside(summary: Path) -> Path:
    """Where the page of a summary goes: summary.html for summary.json."""
    return summary.with_suffix(".html") if summary.suffix == ".json" else summary.with_name(f"{summary.name}.html")


def overview_page(outcomes: Sequence[Outcome], pipeline: Pipeline, folder: Path) -> str:
    """The page as text, the worst subject first. folder: where it will lie; its links are relative to that."""
    ordered = sorted(outcomes, key=lambda outcome: (ORDER.index(outcome.state), outcome.subject))
    counts = [f"{sum(o.state == state for o in outcomes)} {state}" for state in reversed(ORDER)
              if any(o.state == state for o in outcomes)]
    return str(filled(TEMPLATES, "overview.html.j2", {
        "tally": ", ".join(counts),
        "gates": [(name.replace("_", " "), gate.limit) for name, gate in pipeline.gates.items()],
        "rows": [_row(outcome, list(pipeline.gates), folder) for outcome in ordered],
    }))


def _row(outcome: Outcome, gates: Sequence[str], folder: Path) -> dict[str, object]:
    """What the template shows of one subject; judged: (value or None, whether it missed its gate), a pair per gate."""
    run = RunFolder(Path(outcome.results)) if outcome.results else None
    is_finished = outcome.state in FINISHED
    values = values_of(run) if run is not None and is_finished and _is_whole(outcome) else {}
    missed = {flag.gate for flag in outcome.flags}
    report = run.root / EXPORT / "report.html" if run else None
    pictures, fault = _pictures(outcome, run)
    return {
        "subject": outcome.subject,
        "state": outcome.state,
        "rank": ORDER.index(outcome.state),
        "where": f"{outcome.stage}: " if outcome.stage and not is_finished else "",
        "reason": outcome.reason,
        "report": _link(report, folder) if report and is_finished and report.is_file() else None,
        "more": [(_link(Path(path), folder), text)
                 for path, text in ((outcome.picture, "review"), (outcome.log, "log")) if path],
        "pictures": pictures,
        "pictures_fault": fault,
        "judged": [(values.get(gate), gate in missed) for gate in gates],
        "warnings": [str(text) for text in outcome.warnings],
        "minutes": outcome.minutes,
        "memory_mb": outcome.memory_mb,
        "bytes": outcome.bytes,
    }


def _is_whole(outcome: Outcome) -> bool:
    """Whether the subject went as far as the export, and not as far as it was told to only."""
    return folder_of(outcome.stage.rpartition("/")[2]) == EXPORT


def _link(path: Path, folder: Path) -> str:
    relative = os.path.relpath(os.path.abspath(path), os.path.abspath(folder))
    return quote(os.fsencode(f"./{relative}"))


def _pictures(outcome: Outcome, run: RunFolder | None) -> tuple[list[tuple[str, str]], str]:
    """Thumbnails, (text, data URI) each, and why they cannot be read where they cannot."""
    if run is None:
        return [], ""
    is_whole = outcome.state in FINISHED and _is_whole(outcome)
    sources = _picture_files(run) if is_whole else ""
    kept = _kept_pictures(run, sources) if is_whole else None
    if kept is not None:
        return kept, ""
    from tools.cli.thumbnails import PICTURE_ERRORS, crop_pictures, result_pictures

    try:
        pictures = list(result_pictures(run) if is_whole else crop_pictures(run))
    except PICTURE_ERRORS as error:
        return [], str(error)
    if is_whole:
        _keep_pictures(run, sources, pictures)
    return pictures, ""


def _picture_files(run: RunFolder) -> str:
    """Digest of the result's pictures and records, by name, size and time of change; links are not followed."""
    export, facts = run.root / EXPORT, []
    for folder in (export, export / "plates", export / "renders", export / "views"):
        with contextlib.suppress(OSError), os.scandir(folder) as entries:
            facts.append([folder.name, "", folder.lstat().st_mode, 0, 0])
            for entry in entries:
                status = entry.stat(follow_symlinks=False)
                facts.append([folder.name, entry.name, status.st_mode, status.st_size, status.st_mtime_ns])
    return hash_value(sorted(facts))


def _kept_pictures(run: RunFolder, sources: str) -> list[tuple[str, str]] | None:
    """The thumbnails that were kept of the same files; None where there are none."""
    record = read_record(run.work / KEPT_PICTURES) or {}
    pictures = record.get("pictures")
    if record.get("sources") != sources or not isinstance(pictures, list):
        return None
    sound = [tuple(pair) for pair in pictures if isinstance(pair, list) and len(pair) == 2
             and all(isinstance(part, str) for part in pair) and pair[1].startswith("data:image/jpeg;base64,")]
    return sound if len(sound) == len(pictures) else None


def _keep_pictures(run: RunFolder, sources: str, pictures: Sequence[tuple[str, str]]) -> None:
    """Keeps them for the next page; results that nobody may write to are read again each time."""
    with contextlib.suppress(OSError), replacing(run.work / KEPT_PICTURES) as temporary:
        write_record(temporary, {"sources": sources, "pictures": [list(pair) for pair in pictures]})
