"""Charts for developers as SVG files: axes, ticks, curves, legends. The numbers behind them lie beside them as CSV."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from shared.report.charts import COLOURS, nice_ticks

STYLE = (
    "text{font:11px sans-serif;fill:#444;paint-order:stroke;stroke:#fff;stroke-width:3px}"
    ".grid{stroke:#e4e4e4}.curve{fill:none;stroke-width:2}"
)
CHARACTER, LINE = 5.9, 13.0
"""Width and height of a label's text in the drawing's units, roughly."""
LEFT, RIGHT, TOP, BOTTOM = 66, 24, 18, 86
"""Margins of a chart of one panel; the lower one holds the title of the axis and the legend."""


class Axis:
    """Value -> place along an axis from `start` to `end`, logarithmic where told; kept within its ends."""

    def __init__(self, low: float, high: float, start: float, end: float, logarithmic: bool = False):
        self._of = math.log10 if logarithmic else float
        self._low, self._span = self._of(low), self._of(high) - self._of(low)
        self.low, self.high, self.start, self.end, self.logarithmic = low, high, start, end, logarithmic

    def __call__(self, value: float) -> float:
        share = min(max((self._of(value) - self._low) / self._span, 0.0), 1.0)
        return self.start + share * (self.end - self.start)

    def ticks(self, steps: Sequence[float] = (1, 2, 5)) -> list[float]:
        """Round values; on a logarithmic axis the steps times the powers of ten."""
        if not self.logarithmic:
            return list(nice_ticks(self.low, self.high))
        powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        return [m * 10.0**p for p in powers for m in steps if self.low <= m * 10.0**p <= self.high]


def text(x: float, y: float, words: object, anchor: str = "start", more: str = "") -> str:
    """One line of text; anchor: start, middle or end; more: further attributes."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{more}>{escape(str(words))}</text>'


def axes(across: Axis, down: Axis, x_label: str, y_label: str, y_ticks: Iterable[float] | None = None) -> list[str]:
    """Grid, ticks and titles of two axes, of which `down` starts below."""
    left, right, bottom, top = across.start, across.end, down.start, down.end
    parts = []
    for tick in across.ticks():
        x = across(tick)
        parts += [f'<path class="grid" d="M{x:.1f} {top}V{bottom}"/>', text(x, bottom + 16, f"{tick:g}", "middle")]
    for tick in down.ticks() if y_ticks is None else y_ticks:
        y = down(tick)
        parts += [f'<path class="grid" d="M{left} {y:.1f}H{right}"/>', text(left - 6, y + 4, f"{tick:.4g}", "end")]
    turned = f' transform="translate({left - 50} {(top + bottom) / 2}) rotate(-90)"'
    return [*parts, text((left + right) / 2, bottom + 34, x_label, "middle"), text(0, 0, y_label, "middle", turned)]


def legend(entries: Iterable[tuple[str, str]], x: float, y: float, width: float) -> list[str]:
    """Dots with words (colour, words) in rows no wider than width."""
    parts, left = [], x
    for colour, words in entries:
        wide = 30 + len(words) * CHARACTER
        if left > x and left + wide > x + width:
            left, y = x, y + 1.3 * LINE
        parts += [f'<circle cx="{left + 4:.0f}" cy="{y - 4:.0f}" r="4" fill="{colour}"/>', text(left + 13, y, words)]
        left += wide
    return parts


def picture(parts: Iterable[str], width: float, height: float, style: str = "") -> str:
    """An .svg file's text, on white."""
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"><style>{STYLE}{style}</style>'
    return f'{head}<rect width="{width}" height="{height}" fill="#fff"/>{"".join(parts)}</svg>\n'


def line_chart(
    curves: Mapping[str, Sequence[tuple[float, float]]], x_label: str, y_label: str, logarithmic: bool = False,
    width: float = 640, height: float = 330,
) -> str:  # fmt: skip
    """Curves {name: points (x, y)} from y = 0 on as an .svg file's text; logarithmic: the x axis. What is not finite
    interrupts a curve. At most len(COLOURS) curves."""
    points = np.array([point for own in curves.values() for point in own], float).reshape(-1, 2)
    x, y = points[:, 0], points[np.isfinite(points[:, 1]), 1]
    across = Axis(x.min(), x.max() if x.max() > x.min() else x.min() + 1.0, LEFT, width - RIGHT, logarithmic)
    down = Axis(0.0, 1.06 * y.max() if y.size and y.max() > 0 else 1.0, height - BOTTOM, TOP)
    parts = axes(across, down, x_label, y_label)
    for colour, own in zip(COLOURS, curves.values(), strict=False):
        path, joined = "", False
        for px, py in own:
            if math.isfinite(py):
                path += f"{'L' if joined else 'M'}{across(px):.1f} {down(py):.1f}"
            joined = math.isfinite(py)
        parts.append(f'<path class="curve" stroke="{colour}" d="{path}"/>')
    parts += legend(zip(COLOURS, curves, strict=False), LEFT, height - BOTTOM + 56, width - LEFT - RIGHT)
    return picture(parts, width, height)
