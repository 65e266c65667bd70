"""`limn status`: where each stage of each subject stands, while a run works on it, too."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

from tools.cli.cases import SubjectCase
from tools.cli.engine import EVENTS, SCRATCH
from tools.cli.gates import read_flags
from tools.cli.housekeeping import folder_size, readable_size
from tools.cli.plan import CURRENT, StagePlan
from tools.cli.records import read_cost
from tools.cli.watch import Track

HEADER = f"{'state':9} {'size':>10} {'seconds':>8} {'peak':>9}  {'started':25}  folder"


def status_of(case: SubjectCase, plans: Mapping[str, StagePlan]) -> dict[str, object]:
    """One subject as a record: its stages with state, cost, size and, of those that run now, progress."""
    live = {track.stage: track for track in running_stages(case)}
    stages = []
    for name, plan in plans.items():
        folder, track = plan.case.run.published(plan.name), live.get(name)
        cost = read_cost(folder)
        failed = plan.case.run.failed(plan.name) / "log.txt"
        stages.append({
            "stage": name, "state": "running" if track else plan.state, "reasons": list(plan.reasons),
            "bytes": folder_size(folder) if folder.is_dir() else None, "seconds": cost.wall_s,
            "peak_memory_mb": cost.peak_memory_mb, "started": cost.started,
            "folder": str(folder.relative_to(case.run.root)) if folder.is_dir() else None,
            "progress": track.progress if track else "",
            "running_s": round(max(0.0, time.time() - track.since), 1) if track else None,
            "failed_log": str(failed) if failed.is_file() else "",
        })
    flags = [str(flag) for flag in read_flags(case.run)]
    current = all(plan.state == CURRENT for plan in plans.values())
    return {"subject": case.name, "folder": str(case.subject.folder), "results": str(case.run.root),
            "running": case.run.is_locked("run"), "flags": flags if current else [], "stages": stages}


def running_stages(case: SubjectCase) -> Iterator[Track]:
    """The stages at work, as their events tell; none where no living process holds the subject."""
    if not case.run.is_locked("run"):
        return
    for path in sorted(case.run.work.glob(f"{SCRATCH}*/{EVENTS}/**/*.jsonl")):
        within = path.relative_to(case.run.work).parts[2:]
        track = Track(case.name, "/".join(within).removesuffix(".jsonl"), path)
        for event in track.new_events():
            track.apply(event)
        if track.state == "running":
            yield track


def status_lines(record: Mapping) -> list[str]:
    """The record for people."""
    width = max(16, *(len(stage["stage"]) for stage in record["stages"]))
    lines = [f"{record['subject']}: {record['results']}" + "; a run works on it" * record["running"],
             f"  {'stage':{width}} {HEADER}"]
    for stage in record["stages"]:
        size = readable_size(stage["bytes"]) if stage["bytes"] is not None else "-"
        seconds = f"{stage['seconds']:.1f}" if stage["seconds"] is not None else "-"
        peak = f"{stage['peak_memory_mb']:.0f} MB" if stage["peak_memory_mb"] is not None else "-"
        lines.append(f"  {stage['stage']:{width}} {stage['state']:9} {size:>10} {seconds:>8} {peak:>9}  "
                     f"{stage['started'] or '-':25}  {stage['folder'] or '-'}")
        if stage["progress"]:
            lines.append(f"  {'':{width}} since {stage['running_s']:.0f} s: {stage['progress']}")
        if stage["failed_log"]:
            lines.append(f"  {'':{width}} failed: {stage['failed_log']}")
    return lines + [f"  review: {flag}" for flag in record["flags"]]
