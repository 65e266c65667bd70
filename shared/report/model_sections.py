"""Sections of the report on what was solved: the models that were tried, residuals, the model that was chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from itertools import groupby

import numpy as np

from shared.report.charts import line_chart
from shared.report.content import ReportContent
from shared.report.sections import flat, number, table


def selection_section(content: ReportContent) -> str:
    """The models that were tried, in order, each with its error on held-out frames."""
    parts = [selection_table(content.selection)] if content.selection else []
    candidates = solved_models(content.iterations, content.residuals, content.model)
    if not candidates and not parts:
        return "<p>Nothing was recorded.</p>"
    if candidates:
        columns = list(dict.fromkeys(key for candidate in candidates for key in candidate))
        rows = [[number(candidate.get(column)) for column in columns] for candidate in candidates]
        numeric = [k for k, column in enumerate(columns)
                   if all(isinstance(candidate.get(column), (int, float, type(None))) for candidate in candidates)]
        parts.append(table([column.replace("_", " ") for column in columns], rows, numbers=numeric))
    parts.append(f"<h3>Chosen</h3>{table(('part', 'choice'), [(k, number(v)) for k, v in flat(content.model)])}")
    return "".join(parts)


def selection_table(selection: Sequence[Mapping]) -> str:
    """The models that were tried, candidate by candidate."""
    head = ("part", "candidate", "held-out error", "fell by", "standard error", "accepted", "seconds")
    keys = ("part", "candidate", "held_out", "fall", "standard_error", "accepted", "seconds")
    errors = ("held_out", "fall", "standard_error")
    rows = [[f"{row[key]:.6f}" if key in errors and row[key] is not None else number(row[key]).replace("_", " ")
             for key in keys] for row in selection]
    note = ('<p class="note">Tried on few points and frames: a candidate stays where the error on frames that were '
            "held out falls by more than its standard error. The model that was chosen was then solved in full:</p>")
    return table(head, rows, numbers=(2, 3, 4, 6)) + note


def solved_models(
    iterations: Sequence[Mapping], residuals: Mapping[str, object], model: Mapping[str, object]
) -> list[dict]:
    """Models from what the solver logged: one per light model and resolution, one per width of the specular map.

    Errors are those of the last step of each; chosen: where model names it.
    """
    candidates = []
    for (light, resolution), steps in groupby(iterations, key=lambda step: (step.get("light"), step.get("resolution"))):
        steps = [step for step in steps if not step.get("undone")]
        if light is None or not steps:
            continue
        name = f"light, {light} {resolution}" if resolution else f"light, {light}"
        chosen = f"6 x {resolution}^2" in str(model.get("light", "")) or model.get("light") == light
        candidates.append({"model": name, "steps": len(steps), "fitted": steps[-1].get("fitted"),
                           "held_out": min(step["held_out"] for step in steps), "chosen": chosen})
    tried = residuals.get("texture_held_out")
    for name, error in (tried.items() if isinstance(tried, Mapping) else ()):
        chosen = name == model.get("specular_variation")
        candidates.append({"model": f"specular map, {name}", "steps": None, "fitted": None, "held_out": error,
                           "chosen": chosen})
    return candidates


def residual_section(content: ReportContent, frames: Sequence[Mapping]) -> str:
    """Errors on fitted and on held-out frames side by side, the solver's and the pictures', and their course.

    frames: the compared ones, with "psnr" (dB or None) and "held_out".
    """
    rows = []
    pair = [content.residuals.get(name) for name in ("fitted", "held_out")]
    if any(isinstance(value, (int, float)) for value in pair):
        rows.append(("light and specular, at sample points (share of full scale)", *map(number, pair)))
    known = [frame for frame in frames if frame["psnr"] is not None]
    kinds = [[frame["psnr"] for frame in known if frame["held_out"] == held] for held in (False, True)]
    shown = [f"{np.mean(values):.1f}" if values else "-" for values in kinds]
    rows.append(("re-renders on this page (PSNR, dB)", *shown))
    parts = [table(("error", "fitted frames", "held-out frames"), rows, numbers=(1, 2))]
    said = ("fitted", "held_out", "texture_held_out")  # the last stands among the models tried
    rest = {key: value for key, value in content.residuals.items() if key not in said}
    if rest:
        parts.append(table(("residual", "value"), [(k, number(v)) for k, v in flat(rest)], numbers=(1,)))
    curves = _curves(content.iterations)
    if curves:
        steps = range(1, len(content.iterations) + 1)
        parts.append(line_chart(steps, curves, x_label="iteration", y_label="residual", from_zero=True))
    parts.append('<p class="note">Held-out frames took no part in the fit. Much larger errors there mean that poses or '
                 "shape are off, or that the light changed.</p>")
    return "".join(parts)


def _curves(iterations: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """fitted and held_out of each iteration, where there are at least two."""
    if len(iterations) < 2:
        return {}
    names = [name for name in ("fitted", "held_out") if any(name in step for step in iterations)]
    missing = float("nan")
    return {
        name.replace("_", " "): [missing if step.get(name) is None else float(step[name]) for step in iterations]
        for name in names
    }


def methods_section(methods: tuple[Sequence[str], Sequence[str]]) -> str:
    """What was done, in sentences for a paper; references as a numbered list."""
    paragraphs, references = methods
    text = "".join(f"<p>{escape(paragraph)}</p>" for paragraph in paragraphs)
    listed = "".join(f"<li>{escape(reference)}</li>" for reference in references)
    return f'<p class="note">The same as plain text: methods.txt.</p>{text}<ol>{listed}</ol>'
