"""Line charts as inline SVG: sharp in print, readable on a phone, no library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

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

    parts = [*_grid(to_pixels, (x_low, x_high), (low, high)), *_titles(x_label, y_label)]
    for mark in marks:
        across = float(to_pixels(mark, low)[0])
        parts.append(f'<path class="mark" d="M{across:.1f} {_HEIGHT - _BOTTOM}v-8"/>')
    for colour, curve in zip(COLOURS, curves.values(), strict=False):
        path = _path(*to_pixels(x, curve))
        parts.append(f'<path class="curve" stroke="{colour}" d="{path}"/>')
    label = escape(f"{', '.join(curves)} over {x_label}")
    svg = f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{label}">{"".join(parts)}</svg>'
    return svg + _legend(curves)


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


def _grid(to_pixels, x_span: tuple[float, float], y_span: tuple[float, float]) -> list[str]:
    parts = []
    for tick in nice_ticks(*y_span):
        down = float(to_pixels(x_span[0], tick)[1])
        parts.append(f'<path class="grid" d="M{_LEFT} {down:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{down + 4:.1f}" text-anchor="end">{tick:.4g}</text>')
    for tick in nice_ticks(*x_span, 8):
        across = float(to_pixels(tick, y_span[0])[0])
        parts.append(f'<path class="grid" d="M{across:.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>')
        below = _HEIGHT - _BOTTOM + 17
        parts.append(f'<text x="{across:.1f}" y="{below}" text-anchor="middle">{tick:.4g}</text>')
    return parts


def _titles(x_label: str, y_label: str) -> list[str]:
    middle = (_TOP + _HEIGHT - _BOTTOM) / 2
    return [
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{_HEIGHT - 4}" text-anchor="middle">{escape(x_label)}</text>',
        f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">{escape(y_label)}</text>',
    ]


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


def _legend(curves: Mapping[str, Sequence[float]]) -> str:
    entries = (
        f'<span><i style="background:{colour}"></i>{escape(name)}</span>'
        for colour, name in zip(COLOURS, curves, strict=False)
    )
    return f'<p class="legend">{"".join(entries)}</p>'
