"""Accuracy over seconds as a picture: a point per case, the Pareto front, presets by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from shared.report.charts import COLOURS
from tools.bench.chart.cases import ABLATION, GROUPS, PRESET
from tools.bench.chart.rows import COSTS, pareto_front
from tools.bench.drawing import BOTTOM, CHARACTER, LEFT, LINE, RIGHT, TOP, Axis, axes, legend, picture, text

WIDTH, HEIGHT = 860, 520
GROUP_COLOURS = dict(zip(GROUPS, (COLOURS[0], "#56b4e9", COLOURS[1], COLOURS[3]), strict=True))
SPREAD = 3.0
_STYLE = (
    ".preset{font-weight:bold;font-size:13px;fill:#111}.front{stroke:#111;fill:none;stroke-dasharray:5 3}"
    ".range{stroke-width:1.4;opacity:.6}.lead{stroke:#bbb}"
)


def tradeoff_picture(
    points: Sequence[Mapping], measure: str, title: str, groups: Mapping[str, str] = GROUPS, cost: str = "seconds"
) -> str:
    """points: see rows.summarise; those without the measure or cost are left out. An .svg file's text."""
    points = [point for point in points if measure in point["scores"] and cost in point]
    costs = [value for point in points for value in point["ranges"][cost]]
    across = Axis(min(costs) / 1.25, max(costs) * 1.25, LEFT, WIDTH - RIGHT, logarithmic=True)
    down = _score_axis([point["scores"][measure] for point in points])
    places = {point["name"]: (across(point[cost]), down(point["scores"][measure])) for point in points}
    front = pareto_front(points, measure, cost)
    parts = axes(across, down, COSTS[cost], title, down.ticks((1, 1.5, 2, 3, 5, 7)))
    # Up to the next point's seconds nothing better is to be had: steps.
    steps = [places[name] for name in front]
    path = f"M{steps[0][0]:.1f} {steps[0][1]:.1f}" + "".join(f"H{x:.1f}V{y:.1f}" for x, y in steps[1:])
    parts.append(f'<path class="front" d="{path}"/>')
    parts += [_point(point, places[point["name"]], across, cost) for point in points]
    parts += _labels(points, places, front)
    present = {point["group"] for point in points}
    entries = [(GROUP_COLOURS[group], words) for group, words in groups.items() if group in present]
    parts += legend([*entries, ("#111", "dashed: Pareto front")], LEFT, HEIGHT - 28, WIDTH - LEFT - RIGHT)
    return picture(parts, WIDTH, HEIGHT, _STYLE)


def _score_axis(values: Sequence[float]) -> Axis:
    """Logarithmic where it shows the values better: all positive, the largest over SPREAD times the least."""
    low, high = min(values), max(values)
    if spread := low > 0.0 and high > SPREAD * low:
        low, high = low / 1.1, high * 1.1
    else:
        margin = 0.08 * (high - low) or 0.5
        low, high = low - margin, high + margin
    return Axis(low, high, HEIGHT - BOTTOM, TOP, logarithmic=spread)


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
        words = point["name"].partition(", ")[2] if point["group"] == ABLATION else point["name"]
        width, height = len(words) * CHARACTER * (1.25 if named else 1.0), LINE
        box = _free_box(x, y, width, height, taken, must=named or point["name"] in front)
        if box is None:
            continue
        taken.append(box)
        left, base = box[0], box[3] - 3
        if abs(base - y) > 2.2 * LINE:
            parts.append(f'<path class="lead" d="M{x:.1f} {y:.1f}L{left + width / 2:.1f} {base - 4:.1f}"/>')
        parts.append(text(left, base, words, more=' class="preset"' if named else ""))
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
