"""Keeps the README's tables in step with the stages' declarations and with the chart of speed against accuracy.

    python -m tools.readme     rewrites the tables between their marks
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

from shared.contract.declare import parameter_table
from shared.contract.pipeline import load_pipeline
from shared.io.arrays import read_json
from tools.tradeoff_cases import ABLATION
from tools.tradeoff_rows import summarise

README = Path(__file__).resolve().parents[1] / "README.md"
CHART = README.parent / "docs" / "chart.json"
PARAMETERS = "<!-- parameters: limn parameters -->\n", "<!-- end of parameters -->\n"
COSTS = "<!-- costs: make chart OUT=docs -->\n", "<!-- end of costs -->\n"
SCORES = {
    "albedo, dE2000": ("albedo.aligned.delta_e2000_median", ".2f"),
    "albedo, PSNR": ("albedo.aligned.psnr_linear", ".1f"),
    "normals, deg": ("normal_deg.median", ".1f"),
    "light, 25 deg lobe": ("envmap.lobe25_rel_rmse", ".1%"),
    "relit, dB": ("relight.mean.psnr_gain", ".1f"),
}


def with_tables(text: str) -> str:
    """The README's text with the tables as they should be now. ValueError when a mark is missing."""
    text = _between(text, PARAMETERS, parameter_table(list(load_pipeline(None).stages.values())))
    return _between(text, COSTS, cost_table(read_json(CHART)["rows"]))


def _between(text: str, marks: tuple[str, str], content: str) -> str:
    before, rest = text.split(marks[0])
    _, after = rest.split(marks[1])
    return before + marks[0] + content + marks[1] + after


def cost_table(rows: Sequence[Mapping]) -> str:
    """What each preset and each other solver costs and reaches, by rising cost; see tools.tradeoff_rows."""
    points = sorted(summarise(rows), key=lambda point: point["cpu_seconds"])
    head = ["", "seconds", "processor seconds", "with export", "peak memory", *SCORES]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for point in (point for point in points if point["group"] != ABLATION):
        whole = f"{point['seconds_with_export']:.0f}" if "seconds_with_export" in point else ""
        costs = [f"{point['seconds']:.0f}", f"{point['cpu_seconds']:.0f}", whole, f"{point['peak_mb']:.0f} MB"]
        scores = [format(point["scores"][name], style) for name, style in SCORES.values()]
        lines.append(f"| {' | '.join([point['name'], *costs, *scores])} |")
    return "\n".join([*lines, "", _circumstances(rows, points)]) + "\n"


def _circumstances(rows: Sequence[Mapping], points: Sequence[Mapping]) -> str:
    cores = " or ".join(str(count) for count in sorted({row["threads"] for row in rows}))
    repeats = max(point["repeats"] for point in points)
    busy = median(point["others"] for point in points)
    return (
        f"Medians of {repeats}, from the clip to the maps, on {cores} core{'s' * (cores != '1')}; other work kept "
        f"{busy:.1f} cores of the machine busy meanwhile."
    )


def main() -> int:
    """Rewrites README.md."""
    README.write_text(with_tables(README.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
