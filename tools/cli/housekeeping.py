"""What limn does besides running: clean, report."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from shared.contract.folders import CLIPS, RunFolder
from shared.contract.pipeline import Pipeline
from shared.errors import InputError
from tools.cli.cases import SubjectCase
from tools.cli.cluster import LOG_SUFFIX
from tools.cli.gates import PICTURE, RECORD
from tools.cli.overview import KEPT_PICTURES
from tools.cli.plan import StagePlan
from tools.cli.workflow import clear_leftovers


def removable(run: RunFolder, pipeline: Pipeline) -> list[Path]:
    """What clean removes: what the pipeline has written under work/, never export/, never anything else."""
    names = tuple(pipeline.steps)
    paths = [run.work / name for name in names] + [run.failed(name) for name in names]
    paths += [run.stamp(name) for name in names] + [run.work / f"{name}{LOG_SUFFIX}" for name in names]
    paths += [run.memory, *(run.work / name for name in ("workflow.log", RECORD, PICTURE, KEPT_PICTURES))]
    found = [path for path in paths if path.exists()]
    return found + [path for clip in run.clips() for path in removable(clip, pipeline)]


def clean(run: RunFolder, pipeline: Pipeline, dry_run: bool) -> Iterator[str]:
    """Removes the run's work; gives a line for each path before that path goes, and the sum."""
    if not run.work.is_dir():
        yield f"{run.work}: nothing to remove"
        return
    total = 0
    with run.locked("run"):
        if not dry_run:
            for own in (run, *run.clips()):
                clear_leftovers(own, pipeline)
        for path in removable(run, pipeline):
            size = folder_size(path) if path.is_dir() else path.stat().st_size
            total += size
            yield f"{'would remove' if dry_run else 'remove'} {path} ({readable_size(size)})"
            if not dry_run:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        for folder in [folder for clip in run.clips() for folder in (clip.work, clip.root)] + [run.work / CLIPS]:
            with contextlib.suppress(OSError):  # not empty, or never there
                if not dry_run:
                    folder.rmdir()
    yield f"{run.work}: {readable_size(total)} {'to free' if dry_run else 'freed'}; export/ is kept"


def report_path(case: SubjectCase, plans: Mapping[str, StagePlan]) -> tuple[Path, list[str]]:
    """The report and remarks about it; InputError where there is none."""
    path = case.run.root / "export" / "report.html"
    if not path.is_file():
        raise InputError("no report yet", where=str(path.parent), hint=f"make it with: limn run {case.subject.folder}")
    stale = [name for name, plan in plans.items() if plan.state != "current"]
    return path, [f"{case.name}: not up to date: {', '.join(stale)}"] if stale else []


def folder_size(folder: Path) -> int:
    """Bytes of all files below."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def readable_size(size: float) -> str:
    """Bytes in words: 12.3 MB."""
    units: Sequence[str] = ("B", "kB", "MB", "GB")
    for unit in units:
        if size < 1000 or unit == units[-1]:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    raise AssertionError("unreachable")
