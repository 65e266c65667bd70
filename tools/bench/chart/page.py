"""The chart of tools/bench/chart/command.py as one interactive page: any score over any cost, with the Pareto front of
the two."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template

from tools.bench.chart.rows import COSTS, higher_is_better
from tools.bench.chart.svg import GROUP_COLOURS

TEMPLATE = Path(__file__).with_name("page.html")


def tradeoff_page(
    points: Sequence[Mapping], measure: str, subject: str, groups: Mapping[str, str], cost: str = "seconds"
) -> str:
    """points: see rows.summarise. A page that asks for nothing outside of itself."""
    measures = sorted({name for point in points for name in point["scores"]})
    data = {
        "points": list(points),
        "measures": {name: higher_is_better(name) for name in measures},
        "measure": measure,
        "costs": COSTS,
        "cost": cost,
        "groups": [[name, text, GROUP_COLOURS[name]] for name, text in groups.items()],
    }
    text = json.dumps(data, allow_nan=False).replace("</", "<\\/")
    template = Template(TEMPLATE.read_text(encoding="utf-8"))
    return template.substitute(title=f"Speed against accuracy: {escape(subject)}", data=text)
