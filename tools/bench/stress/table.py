"""The stress test as files: stress.csv with every number, stress.md for people, stress.svg."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from tools.bench.stress.chart import write_chart
from tools.bench.stress.verdict import CONFIDENT, FAILED, LIMITS, SILENT, is_wrong

_SHOWN = (*LIMITS, *CONFIDENT.values(), "confident_share", "specular_bias", "roughness_bias", "log_scale")
_COLUMNS = ("perturbation", "severity", "unit", "verdict", "wrong", "said", *_SHOWN, "gates_missed", "warnings", "exit",
            "seconds", "code")


def write_tables(rows: Sequence[dict], missing: Sequence[str], folder: Path, code: str) -> None:
    """All three; rows of stress.verdicts, missing: what has not been run, code: version that rows should have."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "stress.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(_csv_row(row) for row in rows)
    write_chart(rows, folder / "stress.svg")
    (folder / "stress.md").write_text("\n".join(_page(rows, missing, code)) + "\n", encoding="utf-8")


def _csv_row(row: dict) -> dict:
    verdict, scores = row["verdict"], row["scores"]
    return {
        "perturbation": row["perturbation"].name, "severity": f"{row['severity']:g}", "unit": row["perturbation"].unit,
        "verdict": verdict.word, "wrong": " ".join(verdict.wrong), "said": "; ".join(verdict.said),
        **{name: f"{scores[name]:.4g}" for name in _SHOWN if name in scores},
        "gates_missed": "; ".join(row["missed_gates"]), "warnings": "; ".join(row["warnings"]), "exit": row["exit"],
        "seconds": f"{row['seconds']:.1f}", "code": row["code"],
    }


def _page(rows: Sequence[dict], missing: Sequence[str], code: str) -> list[str]:
    """The Markdown page's lines."""
    bad = [row for row in rows if row["verdict"].word in (SILENT, FAILED)]
    zero = rows[0]["scores"]
    lines = [
        "# Where Limn fails, and whether it says so", "",
        "Made by `python -m tools.bench.stress`: synthetic subjects whose truth is known, one perturbation each, run "
        "with small settings (224 px, 24 frames, maps of 256 texels, the mesh as tracked). Severity 0 is the same "
        "case for all.", "",
        "![Scores over severity](stress.svg)", "",
        "**Wrong**: a score is worse than its limit and than its growth times the score at 0. **Said**: a stage "
        "refuses the clip (exit code 2), or a quality gate is missed that 0 keeps, or a warning that 0 does not give "
        "names the matter, or all that is wrong is the albedo and it is right where the confidence is above 0.5.", "",
        "| score | what | limit | growth | at 0 |", "|---|---|---|---|---|",
        *(f"| {name} | {limit.what} | {limit.most:g} {limit.unit} | {limit.growth:g} | {zero[name]:.3g} |"
          for name, limit in LIMITS.items()), "",
        f"{sum(row['severity'] > 0 for row in rows)} cases, wrong and silent or failed: {len(bad)}. Bold scores are "
        "wrong. Gates that the case at 0 misses, which do not count: "
        f"{'; '.join(rows[0]['missed_gates']) or 'none'}.",
        "",
        "| perturbation | severity | " + " | ".join(LIMITS) + " | verdict | what Limn said |",
        "|---|---|" + "---|" * len(LIMITS) + "---|---|",
        *(_line(row, zero, row["code"] != code) for row in rows if row["severity"]),
    ]
    if any(row["code"] != code for row in rows):
        lines += ["", "\\* made with an earlier version of a stage"]
    if missing:
        lines += ["", f"Not run yet: {'; '.join(missing)}."]
    return lines


def _line(row: dict, zero: dict, old: bool) -> str:
    verdict, scores, perturbation = row["verdict"], row["scores"], row["perturbation"]
    cells = []
    for name in LIMITS:
        value = scores.get(name)
        text = "" if value is None else f"{value:.3g}"
        cells.append(f"**{text}**" if text and is_wrong(name, value, zero[name]) else text)
    said, mark = "; ".join(verdict.said) or "nothing", " \\*" if old else ""
    return (f"| {perturbation.what}{mark} | {row['severity']:g} {perturbation.unit} | " + " | ".join(cells)
            + f" | {verdict.word} | {said.replace('|', '/')} |")
