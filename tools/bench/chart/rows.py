"""The table behind tools/bench/chart/command.py: a row per case and repeat, its summary per case, and the Pareto
front."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from shared.contract.hashing import hash_value
from shared.io.arrays import read_json, write_json
from tools.bench.chart.cases import ChartCase
from tools.bench.chart.runs import SHOWN, Solved, current_code

SCHEMA = 1
ORDER = ("sample_frames", "track_landmarks", "init_albedo", "inverse_render", "export_usd")
EXPORT = ORDER[-1]
COSTS = {
    "seconds": "seconds from the clip to the maps",
    "cpu_seconds": "processor seconds from the clip to the maps",
    "peak_mb": "peak memory, MB",
    "seconds_with_export": "seconds with the export",
}
HIGHER_IS_BETTER = ("psnr", "correlation", "within_5mm", "coverage", "ssim")


@dataclass
class Rows:
    """The rows of one subject, kept in a JSON file; code: {digest: {file: fingerprint}} of what made them."""

    path: Path
    subject: str
    subject_key: str
    rows: list[dict] = field(default_factory=list)
    code: dict[str, dict[str, str]] = field(default_factory=dict)
    dropped: int = 0

    @classmethod
    def open(cls, path: Path, subject: str, subject_key: str) -> Rows:
        """What the file holds of this subject and of the code as it is now; all else is dropped and counted."""
        found = cls(path, subject, subject_key)
        content = read_json(path) if path.is_file() else {}
        rows = content.get("rows", [])
        if content.get("schema") == SCHEMA and content["subject_key"] == subject_key:
            found.code = {key: code for key, code in content["code"].items() if current_code(code)}
            found.rows = [row for row in rows if row["code"] in found.code]
        found.dropped = len(rows) - len(found.rows)
        return found

    def has(self, case: ChartCase, repeat: int, threads: int) -> bool:
        """Whether this repeat of a case is measured; of a peer, at all its seconds."""
        wanted = [row_name(case, at) for at in case.seconds or (None,)]
        settings = [case.preset, *case.settings]
        there = [row for row in self.rows if row["repeat"] == repeat and row["threads"] == threads]
        return all(any(row["case"] == name and row["settings"] == settings for row in there) for name in wanted)

    def scores_of(self, digest: str) -> dict[str, float] | None:
        """Scores of a result with the same content, where there is one."""
        return next((row["scores"] for row in self.rows if row["result"] == digest), None)

    def add(self, case: ChartCase, repeat: int, threads: int, solved: Solved, scores: dict[str, float]) -> dict:
        """A row from one result; replaces an older one of its name and repeat."""
        name, digest = row_name(case, solved.at), hash_value(dict(solved.code))[:SHOWN]
        self.code[digest] = dict(sorted(solved.code.items()))
        row = {
            "case": name, "group": case.group, "settings": [case.preset, *case.settings], "repeat": repeat,
            "threads": threads, "code": digest, "result": solved.digest,
            "stages": {stage: vars(cost) for stage, cost in solved.costs.items()}, "scores": scores,
        }  # fmt: skip
        self.rows = [old for old in self.rows if (old["case"], old["repeat"]) != (name, repeat)] + [row]
        return row

    def save(self) -> None:
        """Writes the JSON and, beside it, the same rows as CSV."""
        unfinished = self.path.with_name(f"{self.path.name}.partial")
        write_json(unfinished, {"schema": SCHEMA, "subject": self.subject, "subject_key": self.subject_key,
                                "rows": self.rows, "code": self.code})  # fmt: skip
        unfinished.replace(self.path)
        table = [csv_row(row) for row in self.rows]
        fields = list(dict.fromkeys(name for row in table for name in row))
        with open(self.path.with_suffix(".csv"), "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fields, lineterminator="\n")
            writer.writeheader()
            writer.writerows(table)


def row_name(case: ChartCase, at: float | None) -> str:
    """The case's name, a peer's with the seconds at which it is looked at."""
    return case.name if at is None else f"{case.name}, {at:g} s"


def row_costs(row: Mapping) -> dict[str, float]:
    """Seconds from the clip to the maps, with the export (where it ran), processor seconds and peak memory of the
    former, and how many cores other work kept busy on average."""
    stages = {name: cost for name, cost in row["stages"].items() if name != EXPORT}
    seconds = sum(cost["wall_s"] for cost in stages.values())
    found = {
        "seconds": seconds,
        "cpu_seconds": sum(cost["cpu_s"] for cost in stages.values()),
        "peak_mb": max(cost["peak_mb"] for cost in stages.values()),
        "others": sum(cost["others"] * cost["wall_s"] for cost in stages.values()) / seconds,
    }
    if EXPORT in row["stages"]:
        found["seconds_with_export"] = seconds + row["stages"][EXPORT]["wall_s"]
    return {name: round(value, 3) for name, value in found.items()}


def csv_row(row: Mapping) -> dict[str, object]:
    """One flat line: what was run, its costs, each stage's seconds, every score."""
    names = ("case", "group", "repeat", "threads")
    stages = {f"{name}_s": row["stages"][name]["wall_s"] for name in in_order(row["stages"]) if name in ORDER}
    settings = {"settings": " ".join(row["settings"])}
    return {name: row[name] for name in names} | row_costs(row) | stages | row["scores"] | settings


def in_order(stages: Iterable[str]) -> list[str]:
    """The pipeline's stages as they follow each other, then others."""
    return sorted(stages, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))


def summarise(rows: Iterable[Mapping]) -> list[dict]:
    """A point per case: medians of costs and scores over the repeats, and the costs' ranges."""
    cases: dict[str, list[Mapping]] = {}
    for row in rows:
        cases.setdefault(row["case"], []).append(row)
    points = []
    for name, own in cases.items():
        costs = [row_costs(row) for row in own]
        point = {"name": name, "group": own[0]["group"], "settings": own[0]["settings"], "repeats": len(own)}
        point |= {key: _median(costs, key) for key in costs[0]}
        spans = {key: [cost[key] for cost in costs if key in cost] for key in costs[0]}
        point["ranges"] = {key: [min(values), max(values)] for key, values in spans.items()}
        walls = [{stage: row["stages"][stage]["wall_s"] for stage in in_order(row["stages"])} for row in own]
        point["stages"] = {stage: _median(walls, stage) for stage in walls[0]}
        point["scores"] = {key: _median([row["scores"] for row in own], key) for key in own[0]["scores"]}
        points.append(point)
    return points


def _median(records: Sequence[Mapping[str, float]], key: str) -> float:
    return round(statistics.median(record[key] for record in records if key in record), 5)


def higher_is_better(measure: str) -> bool:
    """Whether a larger value of this score is the better one."""
    return any(word in measure for word in HIGHER_IS_BETTER)


def pareto_front(points: Sequence[Mapping], measure: str, cost: str = "seconds") -> list[str]:
    """Names of the points that no other beats in the score without costing more, by rising cost."""
    sign = -1.0 if higher_is_better(measure) else 1.0
    known = [point for point in points if measure in point["scores"] and cost in point]
    order = sorted(known, key=lambda point: (point[cost], sign * point["scores"][measure]))
    front, best = [], float("inf")
    for point in order:
        error = sign * point["scores"][measure]
        if error < best:
            front.append(point["name"])
            best = error
    return front
