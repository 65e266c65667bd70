"""The report's line charts as files of their own."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from shared.report.charts import COLOURS, line_chart

_STYLE = (
    "text{font:12px sans-serif;fill:#333}.grid{stroke:#ddd;fill:none}.curve{fill:none;stroke-width:2}"
    ".mark{stroke:#888;fill:none}"
)
_LEGEND_ROW = 18


def save_line_chart(
    path: Path, x: Sequence[float], curves: Mapping[str, Sequence[float]], *, x_label: str, y_label: str, **options
) -> None:
    """shared.report.charts.line_chart as an .svg file with its style and a legend. At most len(COLOURS) curves."""
    chart = line_chart(x, curves, x_label=x_label, y_label=y_label, **options)
    left, top, width, height = map(float, re.search(r'viewBox="([^"]+)"', chart)[1].split())
    body = re.search(r"<svg[^>]*>(.*)</svg>", chart, re.S)[1]
    rows = []
    for k, (colour, name) in enumerate(zip(COLOURS, curves, strict=False)):
        y = height + _LEGEND_ROW * (k + 0.5)
        rows.append(
            f'<path d="M70 {y - 4}h24" stroke="{colour}" stroke-width="3"/><text x="100" y="{y}">{escape(name)}</text>'
        )
    box = f"{left} {top} {width} {height + _LEGEND_ROW * (len(rows) + 0.3)}"
    white = f'<rect x="{left}" y="{top}" width="100%" height="100%" fill="#fff"/>'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}"><style>{_STYLE}</style>{white}'
    path.write_text(f"{head}{body}{''.join(rows)}</svg>\n", encoding="utf-8")
