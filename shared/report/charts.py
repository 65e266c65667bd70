"""Line charts as inline SVG: sharp in print, readable on a phone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from shared.report.template import filled

TEMPLATES = Path(__file__).with_name("templates")
_WIDTH, _HEIGHT = 640, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 66, 12, 12, 40
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito's palette: distinct with any kind of colour vision."""


def line_chart(
    x: Sequence[float],
    curves: Mapping[str, Sequence[float]],
    *,
    x_label: str,
    y_label: str,
    marks: Sequence[float] = (),
    from_zero: bool = False,
) -> str:
    """An SVG element: curves {name: values [N]} over x [N], marks as grey strokes on the x axis.

    Points that are not finite interrupt a curve. from_zero: the y axis starts at 0.
    """
    x = np.asarray(x, float)
    values = np.concatenate([np.asarray(curve, float) for curve in curves.values()])
    values = values[np.isfinite(values)]
    low, high = _span(values, from_zero)
    x_low, x_high = (x.min(), x.max()) if len(x) else (0.0, 1.0)
    x_high = x_high if x_high > x_low else x_low + 1.0

    def to_pixels(px, py):
        across = _LEFT + (np.asarray(px) - x_low) / (x_high - x_low) * (_WIDTH - _LEFT - _RIGHT)
        down = _TOP + (high - np.asarray(py)) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)
        return across, down

    shown = zip(COLOURS, curves.items(), strict=False)
    return filled(TEMPLATES, "line_chart.svg.j2", {
        "width": _WIDTH, "height": _HEIGHT, "left": _LEFT, "right": _WIDTH - _RIGHT, "top": _TOP,
        "bottom": _HEIGHT - _BOTTOM, "x_label": x_label, "y_label": y_label,
        "y_ticks": [(float(to_pixels(x_low, tick)[1]), tick) for tick in nice_ticks(low, high)],
        "x_ticks": [(float(to_pixels(tick, low)[0]), tick) for tick in nice_ticks(x_low, x_high, 8)],
        "marks": [float(to_pixels(mark, low)[0]) for mark in marks],
        "curves": [(name, colour, _path(*to_pixels(x, curve))) for colour, (name, curve) in shown],
    })


def _span(values: np.ndarray, from_zero: bool) -> tuple[float, float]:
    if len(values) == 0:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    margin = 0.06 * (high - low) or max(abs(high) * 0.1, 0.5)
    return (min(0.0, low) if from_zero else low - margin), high + margin


def nice_ticks(low: float, high: float, count: int = 5) -> np.ndarray:
    """About count round numbers (1, 2 or 5 times a power of ten apart) between low and high."""
    raw = (high - low) / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw)
    return np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step + 0.0  # -0 becomes 0


def _path(across: np.ndarray, down: np.ndarray) -> str:
    """Move-to after each gap, else line-to."""
    parts, pen_down = [], False
    for px, py in zip(across, down, strict=True):
        if not np.isfinite(py):
            pen_down = False
            continue
        parts.append(f"{'L' if pen_down else 'M'}{px:.1f} {py:.1f}")
        pen_down = True
    return "".join(parts)
