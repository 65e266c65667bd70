"""The sections of the report, each a heading and its HTML. Every text from outside passes through escape()."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import cv2
import numpy as np

from shared.report.advice import advice
from shared.report.charts import line_chart
from shared.report.content import ClipContent, Frame, ReportContent
from shared.report.pictures import (
    ERROR_RANGE,
    error_bytes,
    grey_bytes,
    jpeg_uri,
    shrunk,
    srgb_bytes,
    viridis_bytes,
)

FRAME_PIXELS, MAP_PIXELS, LIGHT_PIXELS, OVERLAY_PIXELS = 440, 1024, 768, 1500
_DIALOG = (
    '<dialog id="zoom"><img src="data:," alt=""><button type="button" aria-label="close">&times;</button></dialog>'
)
_MAP_TEXTS = {
    "diffuse_albedo": ("Diffuse albedo", "share of light that the skin scatters back"),
    "specular_intensity": ("Specular intensity", "1 reflects 4 % head-on; black 0, white {high:.3g}"),
    "roughness": ("Roughness", "black 0 (mirror), white 1 (matt)"),
    "normal": ("Normal", "fine relief in tangent space; even blue is flat"),
    "confidence": ("Confidence", "how well the clip determines each texel; purple 0, yellow 1"),
}


def table(head: Sequence[str], rows: Sequence[Sequence[object]], numbers: Sequence[int] = ()) -> str:
    """An HTML table; columns listed in numbers stand right."""

    def cells(tag: str, row: Sequence[object]) -> str:
        marks = ((' class="number"' if column in numbers else "") for column in range(len(row)))
        return "".join(f"<{tag}{mark}>{escape(str(cell))}</{tag}>" for mark, cell in zip(marks, row, strict=True))

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{cells("th", head)}</tr></thead><tbody>{body}</tbody></table></div>'


def figure(uri: str, alt: str, caption: str = "", *, element_id: str = "", zoom: bool = False) -> str:
    """An image with its caption; zoom lets a click enlarge it."""
    mark = f' id="{element_id}"' if element_id else ""
    image = f'<img{mark} src="{uri}" alt="{escape(alt)}">'
    if zoom:
        image = f'<button class="zoomable" type="button" aria-label="enlarge {escape(alt)}">{image}</button>'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def comparison_frame(frame: Frame) -> dict:
    """For the slider: {"clip", "render", "error": data URIs, "label": text, "psnr": dB or None, "held_out"}."""
    covered = (frame.render > 0.0).any(-1).astype(np.uint8)
    inside = cv2.erode(covered, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE) > 0
    clip, render = srgb_bytes(frame.clip), srgb_bytes(frame.render)
    judged = inside & ~frame.clipped
    difference = (clip[judged].astype(np.float64) - render[judged]) / 255.0
    mean_square = float((difference**2).mean()) if difference.size else 0.0
    psnr = float(-10 * np.log10(mean_square)) if mean_square > 0.0 else None
    kind = "held out" if frame.held_out else "fitted"
    error = error_bytes(frame.clip, frame.render, frame.clipped)
    return {
        "clip": jpeg_uri(shrunk(clip, FRAME_PIXELS)),
        "render": jpeg_uri(shrunk(render, FRAME_PIXELS)),
        "error": jpeg_uri(shrunk(error, FRAME_PIXELS)),
        "label": f"frame {frame.frame_index}, {frame.time_s:.2f} s, {kind}{f', PSNR {psnr:.1f} dB' if psnr else ''}",
        "psnr": psnr,
        "held_out": frame.held_out,
    }


def comparison_section(frames: Sequence[dict]) -> str:
    """Clip beside re-render beside error, with a slider over the chosen frames."""
    if not frames:
        return "<p>No frame was re-rendered.</p>"
    start = len(frames) // 2
    first = frames[start]
    pictures = _triple(first, "frame-")
    slider = (
        f'<div class="slider"><input id="frame" type="range" min="0" max="{len(frames) - 1}" value="{start}" '
        f'aria-label="frame"><output id="frame-label">{escape(first["label"])}</output></div>'
    )
    legend = (
        f'<div class="scale error"></div><p class="ends"><span>-{ERROR_RANGE} darker</span><span>equal</span>'
        f"<span>brighter +{ERROR_RANGE}</span></p>"
        '<p class="note">Linear radiance, clip maximum 1. Grey: outside of the head. Where the clip is '
        "overexposed, a brighter re-render counts as equal. PSNR over the head without its edge and overexposed "
        "pixels.</p>"
    )
    return f"{slider}{pictures}{legend}"


def _triple(frame: dict, element_id: str = "") -> str:
    """Clip, re-render and error side by side."""
    texts = {"clip": ("frame of the clip", "Clip"), "render": ("re-render of the frame", "Re-render"),
             "error": ("error map", "Re-render minus clip")}
    figures = (figure(frame[key], alt, f"<b>{text}</b>", element_id=f"{element_id}{key}" if element_id else "")
               for key, (alt, text) in texts.items())
    return f'<div class="triple">{"".join(figures)}</div>'


def clips_section(clips: Sequence[ClipContent]) -> str:
    """The other clips: some frames beside their re-renders, the light, the motion."""
    parts = []
    for clip in clips:
        facts = ", ".join(f"{escape(label)} {escape(value)}" for label, value in clip.facts)
        parts.append(f'<h3>{escape(clip.name)}</h3><p class="note">{facts}</p>')
        for frame in map(comparison_frame, clip.frames):
            parts.append(f'<p class="note">{escape(frame["label"])}</p>{_triple(frame)}')
        parts += [light_section(clip.envmap), pose_section(clip)]
        if clip.excluded:
            parts.append(f"<details><summary>{len(clip.excluded)} frames left out</summary>"
                         f"{excluded_section(clip.excluded)}</details>")
    return "".join(parts)


def map_section(maps: Mapping[str, np.ndarray]) -> str:
    """The maps as pictures; a click enlarges them."""
    parts = []
    for name, values in maps.items():
        title, text = _MAP_TEXTS.get(name, (name, ""))
        picture, high = map_picture(name, shrunk(np.asarray(values, np.float32), MAP_PIXELS))
        height, width = np.asarray(values).shape[:2]
        caption = f"<b>{escape(title)}</b>, {width} x {height}: {escape(text.format(high=high))}"
        parts.append(figure(jpeg_uri(picture), title, caption, zoom=True))
    return f'<div class="maps">{"".join(parts)}</div>{_DIALOG}<p class="note on-screen">Click a map to enlarge it.</p>'


def map_picture(name: str, values: np.ndarray) -> tuple[np.ndarray, float]:
    """-> uint8 picture of a map and the value that is shown as white. values [H, W] or [H, W, 3]."""
    if name == "confidence":
        return viridis_bytes(values, 0.0, 1.0), 1.0
    if name == "normal":
        return (np.clip(values, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8), 1.0
    if values.ndim == 3:
        return srgb_bytes(values), 1.0
    high = max(1.0, float(np.percentile(values, 99.5)))
    return grey_bytes(values, 0.0, high), high


_CHART = (
    "The colour chart as found; the middle of each patch shows the colour that it should have in the light on the "
    "chart's middle. The grid is green where the chart sets the scale of light and albedo, red where it is not used."
)


def light_section(envmap: np.ndarray, chart: np.ndarray | None = None) -> str:
    """The environment map as exposed and four stops darker, and the colour chart [H, W, 3] sRGB where one is in view.
    envmap [H, W, 3] linear.
    """
    picture = shrunk(envmap, LIGHT_PIXELS)
    pictures = "".join(
        figure(jpeg_uri(srgb_bytes(picture * gain)), f"environment map {text}", escape(text), zoom=True)
        for gain, text in ((1.0, "as the camera exposed it"), (1 / 16, "four stops darker, to see into the lamps"))
    )
    note = (
        '<p class="note">The whole sphere around the head. The middle is the direction of the camera, which lights the '
        "face; left of it is the right side of the picture, the edges are behind the head. Directions that no skin "
        "ever faced are smooth guesses.</p>"
    )
    if chart is not None:
        note += figure(jpeg_uri(chart), "the colour chart", _CHART)
    return f'<div class="pair">{pictures}</div>{note}'


def pose_section(content: ReportContent | ClipContent) -> str:
    """Rotation and position over the clip's frames; strokes below mark frames that were left out."""
    angles = dict(zip(("yaw", "pitch", "roll"), content.angles_deg.T, strict=True))
    position = dict(zip(("x", "y", "z"), (content.position_mm - content.position_mm.mean(0)).T, strict=True))
    marks = [frame for frame, _, _ in content.excluded]
    turning = line_chart(content.frame_index, angles, x_label="frame", y_label="rotation, degrees", marks=marks)
    moving = line_chart(
        content.frame_index, position, x_label="frame", y_label="position - mean, mm", marks=marks
    )
    return f'<div class="pair"><div>{turning}</div><div>{moving}</div></div>'


def tracking_section(overlay: np.ndarray | None) -> str:
    """Mesh and landmarks over a frame: overlay [H, W, 3] uint8."""
    if overlay is None:
        return "<p>The tracking stage left no overlay.</p>"
    picture = jpeg_uri(shrunk(overlay, OVERLAY_PIXELS))
    return figure(picture, "mesh and landmarks over a frame", "Mesh and landmarks over the clip.", zoom=True)


def excluded_section(excluded: Sequence[tuple[int, str, str]]) -> str:
    """Frames left out, with the reason."""
    if not excluded:
        return "<p>None: every sampled frame was used.</p>"
    return table(("frame", "stage", "reason"), excluded, numbers=(0,))


def warning_section(warnings: Sequence[tuple[str, str]]) -> str:
    """Each warning with what to do about it."""
    if not warnings:
        return "<p>None.</p>"
    entries = (
        f'<li><span class="from">{escape(stage)}</span><p><strong>{escape(text)}</strong></p>'
        f"<p>{escape(advice(text))}</p></li>"
        for stage, text in warnings
    )
    return f'<ul class="warnings">{"".join(entries)}</ul>'


def flat(values: Mapping[str, object], prefix: str = "") -> list[tuple[str, object]]:
    """Nested dictionaries -> [("outer, inner", value)]."""
    rows = []
    for key, value in values.items():
        name = f"{prefix}{key}".replace("_", " ")
        rows += flat(value, f"{name}, ") if isinstance(value, Mapping) else [(name, value)]
    return rows


def number(value: object) -> str:
    """Four significant digits for numbers, lists element by element, anything else as text."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(number(item) for item in value)
    return str(value)


def cost_section(content: ReportContent) -> str:
    """Seconds and peak memory of each stage."""

    def shown(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    rows = [(c.stage, shown(c.wall_s, 1), shown(c.cpu_s, 1), shown(c.peak_memory_mb, 0)) for c in content.costs]
    total = sum(c.wall_s or 0.0 for c in content.costs)
    rows.append(("all", f"{total:.1f}", "", ""))
    return table(("stage", "seconds", "CPU s", "peak MB"), rows, numbers=(1, 2, 3))


def parameter_section(content: ReportContent) -> str:
    """Every parameter of every stage."""
    rows = [(stage, name, number(value)) for stage, name, value in content.parameters]
    inner = table(("stage", "parameter", "value"), rows)
    return f"<details><summary>{len(rows)} parameters</summary>{inner}</details>"
