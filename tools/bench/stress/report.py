"""The stress test for people: the lines of stress.csv, stress.md, and stress.svg with a panel per perturbation."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import groupby

import numpy as np

from shared.report.charts import COLOURS
from tools.bench.drawing import Axis, legend, picture, text
from tools.bench.stress.verdict import (
    CONFIDENT,
    FAILED,
    LIMITS,
    RIGHT,
    SAID,
    SILENT,
    WARNED,
    allowed,
    is_wrong,
)

_SHOWN = (*LIMITS, *CONFIDENT.values(), "confident_share", "covered", "specular_bias", "roughness_bias", "log_scale")
_PANELS, _WIDTH, _HEIGHT, _LEFT, _TOP = 5, 220, 168, 38, 26
_PLOT = (170, 88)
_RANGE = 8.0
"""Scores are drawn from 1 / 8 to 8 times what is allowed."""
VERDICT_COLOURS = {RIGHT: "#009e73", WARNED: "#56b4e9", SAID: "#e69f00", SILENT: "#d00000", FAILED: "#000000"}
_STYLE = "text{font-size:10px}.name{font-weight:bold}.limit{stroke:#888;stroke-dasharray:3 2}.curve{stroke-width:1.5}"


def shown_row(row: dict) -> dict:
    """A line of stress.csv."""
    verdict, scores = row["verdict"], row["scores"]
    return {
        "perturbation": row["perturbation"].name, "severity": f"{row['severity']:g}", "unit": row["perturbation"].unit,
        "verdict": verdict.word, "wrong": " ".join(verdict.wrong), "said": "; ".join(verdict.said),
        **{name: f"{scores[name]:.4g}" for name in _SHOWN if scores.get(name) is not None},
        "gates_missed": "; ".join(row["missed_gates"]), "warnings": "; ".join(row["warnings"]), "exit": row["exit"],
        "seconds": f"{row['seconds']:.1f}", "code": row["code"],
    }


def page(rows: Sequence[dict], missing: Sequence[str], code: str) -> str:
    """stress.md; rows: of verdicts, missing: what has not been run, code: version that rows should have."""
    if not rows:
        return "The unchanged case has no result, or no other case has been run.\n"
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
        "names the matter, or all that is wrong is the albedo and it is right where the confidence is above 0.5. "
        "**Covered**: share of frames whose rotation lies within the 90 % region of its reported covariance; it is "
        "shown and not judged.", "",
        "| score | what | limit | growth | at 0 |", "|---|---|---|---|---|",
        *(f"| {name} | {limit.what} | {limit.most:g} {limit.unit} | {limit.growth:g} | {_number(zero.get(name))} |"
          for name, limit in LIMITS.items()), "",
        f"{sum(row['severity'] > 0 for row in rows)} cases, wrong and silent or failed: {len(bad)}. Bold scores are "
        "wrong. Gates that the case at 0 misses, which do not count: "
        f"{'; '.join(rows[0]['missed_gates']) or 'none'}.",
        "",
        "| perturbation | severity | " + " | ".join(LIMITS) + " | covered | verdict | what Limn said |",
        "|---|---|" + "---|" * len(LIMITS) + "---|---|---|",
        *(_line(row, zero, row["code"] != code) for row in rows if row["severity"]),
    ]
    if any(row["code"] != code for row in rows):
        lines += ["", "\\* made with an earlier version of a stage"]
    if missing:
        lines += ["", f"Not run yet: {'; '.join(missing)}."]
    return "\n".join(lines) + "\n"


def _line(row: dict, zero: dict, old: bool) -> str:
    verdict, scores, perturbation = row["verdict"], row["scores"], row["perturbation"]
    cells = []
    for name in LIMITS:
        value = scores.get(name)
        wrong = name in scores and is_wrong(name, value, zero[name])
        cells.append(f"**{_number(value)}**" if wrong else _number(value))
    cells.append(_number(scores.get("covered")))
    said, mark = "; ".join(verdict.said) or "nothing", " \\*" if old else ""
    return (f"| {perturbation.what}{mark} | {row['severity']:g} {perturbation.unit} | " + " | ".join(cells)
            + f" | {verdict.word} | {said.replace('|', '/')} |")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def stress_picture(rows: Sequence[dict]) -> str:
    """Every score over severity, a panel a perturbation, and below what Limn said; rows: of verdicts, in order."""
    panels = [_panel(list(own)) for _, own in groupby(rows, key=lambda row: row["perturbation"].name)]
    lines = -(-len(panels) // _PANELS)
    placed = [f'<g transform="translate({k % _PANELS * _WIDTH} {k // _PANELS * _HEIGHT})">{panel}</g>'
              for k, panel in enumerate(panels)]
    below, width = lines * _HEIGHT + 22, _PANELS * _WIDTH
    scores = [*zip(COLOURS, LIMITS, strict=True), ("#888", "each over the worst value that still is right (dashed: 1)")]
    words = [(colour, word) for word, colour in VERDICT_COLOURS.items()]
    legends = [*legend(scores, _LEFT, below, width), *legend(words, _LEFT, below + 20, width)]
    return picture([*placed, *legends], width, below + 38, _STYLE)


def _panel(rows: list[dict]) -> str:
    """One perturbation: the axes, a curve a score, a square a severity in the colour of its verdict."""
    perturbation, count, bottom = rows[0]["perturbation"], len(rows), _TOP + _PLOT[1]
    across = _LEFT + 8 + np.arange(count) * (_PLOT[0] - 16) / max(count - 1, 1)
    down = Axis(1.0 / _RANGE, _RANGE, bottom, _TOP, logarithmic=True)
    parts = [text(_LEFT, 14, perturbation.name.replace("_", " "), more=' class="name"')]
    for ratio in (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0):
        kind = "limit" if ratio == 1.0 else "grid"
        parts.append(f'<path class="{kind}" d="M{_LEFT} {down(ratio):.1f}h{_PLOT[0]}"/>')
    parts += [text(_LEFT - 4, down(ratio) + 3, f"{ratio:g}", "end") for ratio in (0.125, 1.0, 8.0)]
    zero = rows[0]["scores"]
    for colour, name in zip(COLOURS, LIMITS, strict=True):
        known = [(x, row["scores"].get(name)) for x, row in zip(across, rows, strict=True)]
        points = " ".join(f"{x:.1f},{down(max(value / allowed(name, zero[name]), 1e-9)):.1f}"
                          for x, value in known if value is not None)
        parts.append(f'<polyline class="curve" stroke="{colour}" points="{points}"/>')
    for x, row in zip(across, rows, strict=True):
        verdict = row["verdict"]
        words = escape("; ".join((verdict.word, *verdict.said)))
        parts.append(f'<rect x="{x - 5:.1f}" y="{bottom + 5}" width="10" height="10" '
                     f'fill="{VERDICT_COLOURS[verdict.word]}"><title>{words}</title></rect>')
        parts.append(text(x, bottom + 27, f"{row['severity']:g}", "middle"))
    return "".join([*parts, text(_LEFT + _PLOT[0] / 2, bottom + 40, perturbation.unit, "middle")])
