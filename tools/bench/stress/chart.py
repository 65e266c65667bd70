"""The stress test as one picture: a panel a perturbation, every score over severity, and below what Limn said."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import groupby
from pathlib import Path

import numpy as np

from shared.report.charts import COLOURS
from tools.bench.stress.verdict import FAILED, LIMITS, RIGHT, SAID, SILENT, WARNED, allowed

_COLUMNS, _WIDTH, _HEIGHT, _LEFT, _TOP = 5, 220, 168, 38, 26
_PLOT = (170, 88)
_LOWEST, _HIGHEST = -3.0, 3.0
"""Powers of two of a score over what is allowed."""
VERDICT_COLOURS = {RIGHT: "#009e73", WARNED: "#56b4e9", SAID: "#e69f00", SILENT: "#d00000", FAILED: "#000000"}
_STYLE = (
    "text{font:10px sans-serif;fill:#333}.name{font-weight:bold}.grid{stroke:#ddd}.limit{stroke:#888;"
    "stroke-dasharray:3 2}.curve{fill:none;stroke-width:1.5}"
)


def write_chart(rows: Sequence[dict], path: Path) -> None:
    """rows: of stress.verdicts, in order, perturbation by perturbation."""
    panels = [_panel(list(own)) for _, own in groupby(rows, key=lambda row: row["perturbation"].name)]
    lines = -(-len(panels) // _COLUMNS)
    width, height = _COLUMNS * _WIDTH, lines * _HEIGHT + 60
    placed = [f'<g transform="translate({k % _COLUMNS * _WIDTH} {k // _COLUMNS * _HEIGHT})">{panel}</g>'
              for k, panel in enumerate(panels)]
    legend = f'<g transform="translate(0 {lines * _HEIGHT + 8})">{_legend()}</g>'
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" aria-label="scores over '
        f'the severity of each perturbation"><style>{_STYLE}</style><rect width="100%" height="100%" fill="#fff"/>'
        f'{"".join(placed)}{legend}</svg>\n', encoding="utf-8")


def _panel(rows: list[dict]) -> str:
    """One perturbation: the axes, a curve a score, a square a severity in the colour of its verdict."""
    perturbation, count = rows[0]["perturbation"], len(rows)
    across = _LEFT + 8 + np.arange(count) * (_PLOT[0] - 16) / max(count - 1, 1)
    parts = [f'<text class="name" x="{_LEFT}" y="14">{escape(perturbation.name.replace("_", " "))}</text>']
    for power in range(int(_LOWEST), int(_HIGHEST) + 1):
        kind = "limit" if power == 0 else "grid"
        parts.append(f'<path class="{kind}" d="M{_LEFT} {_down(2.0**power):.1f}h{_PLOT[0]}"/>')
        if power % 3 == 0:
            place = f'x="{_LEFT - 4}" y="{_down(2.0**power) + 3:.1f}"'
            parts.append(f'<text {place} text-anchor="end">{2.0**power:g}</text>')
    zero = rows[0]["scores"]
    for colour, name in zip(COLOURS, LIMITS, strict=True):
        known = [(x, row["scores"][name] / allowed(name, zero[name])) for x, row in zip(across, rows, strict=True)
                 if np.isfinite(row["scores"].get(name, np.nan))]
        points = " ".join(f"{x:.1f},{_down(ratio):.1f}" for x, ratio in known)
        parts.append(f'<polyline class="curve" stroke="{colour}" points="{points}"/>')
    bottom = _TOP + _PLOT[1]
    for x, row in zip(across, rows, strict=True):
        verdict = row["verdict"]
        text = escape("; ".join((verdict.word, *verdict.said)))
        parts.append(f'<rect x="{x - 5:.1f}" y="{bottom + 5}" width="10" height="10" '
                     f'fill="{VERDICT_COLOURS[verdict.word]}"><title>{text}</title></rect>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 27}" text-anchor="middle">{row["severity"]:g}</text>')
    parts.append(f'<text x="{_LEFT + _PLOT[0] / 2}" y="{bottom + 40}" text-anchor="middle">'
                 f"{escape(perturbation.unit)}</text>")
    return "".join(parts)


def _down(ratio: float) -> float:
    """y of a score relative to what is allowed."""
    power = np.clip(np.log2(max(ratio, 1e-9)), _LOWEST, _HIGHEST)
    return float(_TOP + (_HIGHEST - power) / (_HIGHEST - _LOWEST) * _PLOT[1])


def _legend() -> str:
    parts, x = [], _LEFT
    for colour, name in zip(COLOURS, LIMITS, strict=True):
        parts.append(f'<path d="M{x} 10h18" stroke="{colour}" stroke-width="3"/>'
                     f'<text x="{x + 23}" y="14">{name}</text>')
        x += 110
    parts.append(f'<text x="{x}" y="14">each over the worst value that still is right (dashed: 1)</text>')
    x = _LEFT
    for word, colour in VERDICT_COLOURS.items():
        parts.append(f'<rect x="{x}" y="26" width="10" height="10" fill="{colour}"/>'
                     f'<text x="{x + 15}" y="35">{escape(word)}</text>')
        x += 140
    return "".join(parts)
