"""Accuracy over seconds as a picture: a point per case, the Pareto front, presets by name."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape

from shared.report.charts import COLOURS, nice_ticks
from tools.bench.chart.cases import ABLATION, GROUPS, PRESET
from tools.bench.chart.rows import COSTS, pareto_front

WIDTH, HEIGHT = 860, 520
LEFT, RIGHT, TOP, BOTTOM = 66, 24, 18, 86
GROUP_COLOURS = dict(zip(GROUPS, (COLOURS[0], "#56b4e9", COLOURS[1], COLOURS[3]), strict=True))
CHARACTER, LINE = 5.9, 13.0
"""Width and height of a label's text in the drawing's units, roughly."""
SPREAD = 3.0
_STYLE = (
    "text{font:11px sans-serif;fill:#444;paint-order:stroke;stroke:#fff;stroke-width:3px}"
    ".preset{font-weight:bold;font-size:13px;fill:#111}.grid{stroke:#e4e4e4}"
    ".front{stroke:#111;fill:none;stroke-dasharray:5 3}.range{stroke-width:1.4;opacity:.6}.lead{stroke:#bbb}"
)


class Axis:
    """Value -> place along an axis, logarithmic where told; kept within its ends."""

    def __init__(self, low: float, high: float, start: float, end: float, logarithmic: bool):
        self._of = math.log10 if logarithmic else float
        self._low, self._span = self._of(low), self._of(high) - self._of(low)
        self._start, self._end = start, end

    def __call__(self, value: float) -> float:
        share = min(max((self._of(value) - self._low) / self._span, 0.0), 1.0)
        return self._start + share * (self._end - self._start)


def log_ticks(low: float, high: float, steps: Sequence[float] = (1, 2, 5)) -> list[float]:
    """The steps times the powers of ten between low and high."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [m * 10.0**p for p in powers for m in steps if low <= m * 10.0**p <= high]


def tradeoff_svg(
    points: Sequence[Mapping], measure: str, title: str, groups: Mapping[str, str] = GROUPS, cost: str = "seconds"
) -> str:
    """points: see rows.summarise; those without the measure or cost are left out. An .svg file's text."""
    points = [point for point in points if measure in point["scores"] and cost in point]
    costs = [value for point in points for value in point["ranges"][cost]]
    values = [point["scores"][measure] for point in points]
    spread = is_spread(values)
    margin = 0.08 * (max(values) - min(values)) or 0.5
    y_span = (min(values) / 1.1, max(values) * 1.1) if spread else (min(values) - margin, max(values) + margin)
    x_span = min(costs) / 1.25, max(costs) * 1.25
    across = Axis(*x_span, LEFT, WIDTH - RIGHT, logarithmic=True)
    down = Axis(*y_span, HEIGHT - BOTTOM, TOP, logarithmic=spread)
    places = {point["name"]: (across(point[cost]), down(point["scores"][measure])) for point in points}
    front = pareto_front(points, measure, cost)
    y_ticks = log_ticks(*y_span, (1, 1.5, 2, 3, 5, 7)) if spread else nice_ticks(*y_span)
    parts = _ticks(across, down, log_ticks(*x_span), y_ticks)
    parts += _titles(COSTS[cost], title)
    parts.append(_front([places[name] for name in front]))
    parts += [_point(point, places[point["name"]], across, cost) for point in points]
    parts += _labels(points, places, front)
    parts += _legend(groups, {point["group"] for point in points})
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}"><style>{_STYLE}</style>'
    return f'{head}<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>{"".join(parts)}</svg>\n'


def is_spread(values: Sequence[float]) -> bool:
    """Whether a logarithmic axis shows these values better: all positive, the largest over three times the least."""
    return min(values) > 0.0 and max(values) > SPREAD * min(values)


def _ticks(across: Axis, down: Axis, x_ticks: Iterable[float], y_ticks: Iterable[float]) -> list[str]:
    bottom, parts = HEIGHT - BOTTOM, []
    for tick in x_ticks:
        x = across(tick)
        parts.append(f'<path class="grid" d="M{x:.1f} {TOP}V{bottom}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{tick:g}</text>')
    for tick in y_ticks:
        y = down(tick)
        parts.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:.4g}</text>')
    return parts


def _titles(below: str, beside: str) -> list[str]:
    middle, bottom = (LEFT + WIDTH - RIGHT) / 2, HEIGHT - BOTTOM
    turned = f'transform="translate(16 {(TOP + bottom) / 2}) rotate(-90)"'
    return [
        f'<text x="{middle}" y="{bottom + 34}" text-anchor="middle">{escape(below)}</text>',
        f'<text {turned} text-anchor="middle">{escape(beside)}</text>',
    ]


def _front(places: Sequence[tuple[float, float]]) -> str:
    """Steps: up to the next point's seconds nothing better is to be had."""
    path = f"M{places[0][0]:.1f} {places[0][1]:.1f}" + "".join(f"H{x:.1f}V{y:.1f}" for x, y in places[1:])
    return f'<path class="front" d="{path}"/>'


def _point(point: Mapping, place: tuple[float, float], across: Axis, cost: str) -> str:
    (x, y), colour = place, GROUP_COLOURS[point["group"]]
    first, last = (across(value) for value in point["ranges"][cost])
    radius = 6.5 if point["group"] == PRESET else 4
    words = f"{point['name']}: {point[cost]:.0f}"
    return (
        f'<path class="range" stroke="{colour}" d="M{first:.1f} {y:.1f}H{last:.1f}"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{colour}"><title>{escape(words)}</title></circle>'
    )


def _labels(points: Sequence[Mapping], places: Mapping, front: Sequence[str]) -> list[str]:
    """Names beside their points where there is room, presets and the front first; the others only where they fit."""
    taken = [(x - 5, y - 5, x + 5, y + 5) for x, y in places.values()]
    order = sorted(points, key=lambda point: (point["group"] != PRESET, point["name"] not in front))
    parts = []
    for point in order:
        named = point["group"] == PRESET
        x, y = places[point["name"]]
        # An ablation is named after its preset, which the legend says for all of them.
        text = point["name"].partition(", ")[2] if point["group"] == ABLATION else point["name"]
        width, height = len(text) * CHARACTER * (1.25 if named else 1.0), LINE
        box = _free_box(x, y, width, height, taken, must=named or point["name"] in front)
        if box is None:
            continue
        taken.append(box)
        left, base = box[0], box[3] - 3
        style = ' class="preset"' if named else ""
        if abs(base - y) > 2.2 * LINE:
            parts.append(f'<path class="lead" d="M{x:.1f} {y:.1f}L{left + width / 2:.1f} {base - 4:.1f}"/>')
        parts.append(f'<text{style} x="{left:.1f}" y="{base:.1f}">{escape(text)}</text>')
    return parts


def _free_box(x: float, y: float, width: float, height: float, taken: Sequence, must: bool) -> tuple | None:
    """Left, top, right, bottom of a free place near a point; must: else farther away, at last the first one."""
    reach = (0, 1, 2, 3, 4, 5) if must else (0, 1)
    shifts = [sign * k * height for k in reach for sign in ((1,) if k == 0 else (-1, 1))]
    boxes = []
    for shift in shifts:
        for left in (x + 9, x - 9 - width, x - width / 2):
            top = y - height / 2 + shift
            box = left, top, left + width, top + height
            if left > LEFT and left + width < WIDTH - 4 and top > 2 and top + height < HEIGHT - BOTTOM:
                boxes.append(box)
    free = [box for box in boxes if not any(_overlap(box, other) for other in taken)]
    return free[0] if free else boxes[0] if must and boxes else None


def _overlap(a: Sequence[float], b: Sequence[float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _legend(groups: Mapping[str, str], present: set[str]) -> list[str]:
    y, x, parts = HEIGHT - 14, float(LEFT), []
    for group, text in groups.items():
        if group in present:
            parts.append(f'<circle cx="{x + 4:.0f}" cy="{y - 4}" r="4" fill="{GROUP_COLOURS[group]}"/>')
            parts.append(f'<text x="{x + 13:.0f}" y="{y}">{escape(text)}</text>')
            x += 30 + len(text) * CHARACTER
    parts.append(f'<path class="front" d="M{x:.0f} {y - 4}h24"/><text x="{x + 30:.0f}" y="{y}">Pareto front</text>')
    return parts
