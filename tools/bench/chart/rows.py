"""What the chart's table holds: a row per case and repeat, its summary per case, and the Pareto front."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence

from shared.contract.hashing import hash_value
from tools.bench.chart.cases import ChartCase
from tools.bench.chart.runs import SHOWN, Solved

ORDER = ("sample_frames", "track_landmarks", "init_albedo", "inverse_render", "export_usd")
EXPORT = ORDER[-1]
COSTS = {
    "seconds": "seconds from the clip to the maps",
    "cpu_seconds": "processor seconds from the clip to the maps",
    "peak_mb": "peak memory, MB",
    "seconds_with_export": "seconds with the export",
}
HIGHER_IS_BETTER = ("psnr", "correlation", "within_5mm", "coverage", "ssim")


def chart_row(
    case: ChartCase, threads: int, solved: Solved, code: Mapping[str, str], scores: Mapping[str, float]
) -> dict:
    """A row from one result; code: {file: fingerprint} of what made and scored it."""
    return {
        "case": row_name(case, solved.at), "group": case.group, "settings": [case.preset, *case.settings],
        "threads": threads, "code": code_digest(code), "result": solved.digest,
        "stages": {stage: vars(cost) for stage, cost in solved.costs.items()}, "scores": dict(scores),
    }  # fmt: skip


def code_digest(code: Mapping[str, str]) -> str:
    """By which a row names the {file: fingerprint} that made it."""
    return hash_value(dict(code))[:SHOWN]


def row_names(case: ChartCase) -> list[str]:
    """Of its rows: a peer has one for each of its seconds."""
    return [row_name(case, at) for at in case.seconds or (None,)]


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
