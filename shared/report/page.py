"""The report's page: one HTML file, filled from templates/report.html.j2, without any outside reference but links to
what may be made beside it to show to others.

What stands here turns arrays and records into what the template shows: pictures, charts and rows of text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np

from shared.geometry.mesh import shading_normals
from shared.io.export_maps import HAIR_ALBEDO, HAIR_ALPHA
from shared.io.material_maps import LABEL_WORDS, label_picture
from shared.rendering.studio_lights import STUDIO_LIGHTS
from shared.rendering.view_set import NOVEL_VIEWS, ViewSet
from shared.report.advice import advice
from shared.report.charts import line_chart
from shared.report.content import ClipContent, Frame, ReportContent, number
from shared.report.eye_pictures import close_up
from shared.report.pictures import (
    ERROR_RANGE,
    error_bytes,
    grey_bytes,
    jpeg_uri,
    over_chequers,
    shrunk,
    srgb_bytes,
    viridis_bytes,
)
from shared.report.template import filled
from shared.report.viewer import ACTION_STEP_MM, WET, irradiance_harmonics, packed

TEMPLATES = Path(__file__).with_name("templates")
FRAME_PIXELS, MAP_PIXELS, LIGHT_PIXELS, OVERLAY_PIXELS = 440, 1024, 768, 1500
VIEW_PIXELS, SHEET_PIXELS, VIEWER_TEXTURE_PIXELS = 512, 1600, 1024
TURNTABLE = {"head_turns.mp4": "the head turning under three lights", "light_turns.mp4": "a light turning about it",
             "maps.png": "a sheet of its maps"}
"""What `limn turntable` writes into turntable/ beside the export."""
_NOTHING = 90
_MAP_TEXTS = {
    "diffuse_albedo": ("Diffuse albedo", "share of light that the skin scatters back"),
    "specular_intensity": ("Specular intensity", "1 reflects 4 % head-on; black 0, white {high:.3g}"),
    "roughness": ("Roughness", "black 0 (mirror), white 1 (matt)"),
    "normal": ("Normal", "fine relief in tangent space; even blue is flat"),
    "confidence": ("Confidence", "how well the clip determines each texel; purple 0, yellow 1"),
    "hair_albedo": ("Hair", "albedo of what stands off the head, in its own atlas; chequered where there is none"),
    "material": ("Material", "the likeliest: " + ", ".join(f"{name} {colour}" for name, colour in LABEL_WORDS.items())),
}
_CHART = (
    "The colour chart as found; the middle of each patch shows the colour that it should have in the light on the "
    "chart's middle. The grid is green where the chart sets the scale of light and albedo, red where it is not used."
)
_SHAPE = (
    "From above: the tracked mesh, the refined one, its normals (red: to the right, green: up, blue: to the "
    "camera), and how far it was moved."
)


@dataclass(frozen=True)
class Figure:
    """An image of the page: data URI, words for who cannot see it, and its caption: a title in bold, then text."""

    uri: str
    alt: str
    title: str = ""
    text: str = ""


def report_html(content: ReportContent) -> str:
    """The page as text. Deterministic: the same content gives the same text."""
    frames, eyes = [], []
    for frame in content.frames:
        frames.append(comparison_frame(frame))
        eyes += eye_close_ups(frame)
    paragraphs, references = content.methods
    return str(filled(TEMPLATES, "report.html.j2", {
        "name": content.name,
        "facts": content.facts,
        "numbers": content.numbers,
        "warnings": [(stage, text, advice(text)) for stage, text in content.warnings],
        "frames": frames,
        "error_range": ERROR_RANGE,
        "eyes": eyes,
        "composites": composites(content.composites),
        "relit_eyes": relit_eyes(content.views, content.relit_eyes),
        "maps": map_pictures(content.maps),
        "shape": _one(content.shape, SHEET_PIXELS, "the shape from three sides", _SHAPE),
        "views": view_pictures(content.views) if content.views else None,
        "turntable": [(f"../turntable/{file}", text) for file, text in TURNTABLE.items()],
        "light_pictures": light_pictures(content.envmap),
        "chart": None if content.chart is None else Figure(jpeg_uri(content.chart), "the colour chart", text=_CHART),
        "motion_charts": motion_charts(content),
        "overlay": _one(content.overlay, OVERLAY_PIXELS, "mesh and landmarks over a frame",
                        "Mesh and landmarks over the clip."),
        "excluded_frames": content.excluded,
        "clips": [_clip(clip) for clip in content.clips],
        "errors": error_rows(content.residuals, frames),
        "residuals": residual_rows(content.residuals),
        "course": course_chart(content.iterations),
        "selection": selection_rows(content.selection),
        "solved": _columns(solved_models(content.iterations, content.residuals, content.model)),
        "model": [(name, number(value)) for name, value in flat(content.model)],
        "costs": cost_rows(content),
        "parameters": [(stage, name, number(value)) for stage, name, value in content.parameters],
        "paragraphs": paragraphs,
        "references": references,
        "files": content.files,
        "viewer": _viewer_data(content),
    }))


def _clip(clip: ClipContent) -> dict:
    """Another clip: some frames beside their re-renders, the light, the motion."""
    return {"name": clip.name, "facts": clip.facts, "frames": [comparison_frame(frame) for frame in clip.frames],
            "light_pictures": light_pictures(clip.envmap), "motion_charts": motion_charts(clip),
            "excluded_frames": clip.excluded}


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


def eye_close_ups(frame: Frame) -> list[Figure]:
    """Both eyes in the clip and in the re-render, of a frame chosen for that; else nothing."""
    if frame.eyes is None:
        return []
    text = f", frame {frame.frame_index}, {'held out' if frame.held_out else 'fitted'}"
    return [Figure(jpeg_uri(close_up(picture, frame.eyes)), f"the eyes, {title.lower()}{text}", title, text)
            for title, picture in (("Clip", frame.clip), ("Re-render", frame.render))]


def composites(pictures: Mapping[int, np.ndarray]) -> list[Figure]:
    """Frames of the clip, {frame: [H, W, 3] linear}, with the re-render in the old head's place."""
    return [Figure(jpeg_uri(shrunk(srgb_bytes(picture), MAP_PIXELS)), f"re-render in frame {frame}", f"Frame {frame}")
            for frame, picture in pictures.items()]


def relit_eyes(views: ViewSet | None, rectangle: tuple[int, int, int, int] | None) -> list[Figure]:
    """Both eyes, left, top, right and bottom px of the relit pictures, under each of the other lights."""
    if views is None or rectangle is None:
        return []
    return [Figure(jpeg_uri(close_up(picture, rectangle)), f"the eyes: {STUDIO_LIGHTS[name]}", name.replace("_", " "),
                   f": {STUDIO_LIGHTS[name]}") for name, picture in views.relit.items()]


def map_pictures(maps: Mapping[str, np.ndarray]) -> list[Figure]:
    """Each of the maps, {name: as for map_picture}; hair's colour as its alpha lets it be seen, both in one."""
    shown = {name: values for name, values in maps.items() if name != HAIR_ALPHA}
    if HAIR_ALPHA in maps:
        shown[HAIR_ALBEDO] = over_chequers(maps[HAIR_ALBEDO], maps[HAIR_ALPHA])
    return [map_picture(name, np.asarray(values)) for name, values in shown.items()]


def map_picture(name: str, values: np.ndarray) -> Figure:
    """A map, values [S, S], [S, S, 3] or of materials [S, S, len(LABELS)], with what its colours mean."""
    title, text = _MAP_TEXTS.get(name, (name, ""))
    codes, high = map_bytes(name, shrunk(np.asarray(values, np.float32), MAP_PIXELS))
    height, width = values.shape[:2]
    return Figure(jpeg_uri(codes), title, title, f", {width} x {height}: {text.format(high=high)}")


def map_bytes(name: str, values: np.ndarray) -> tuple[np.ndarray, float]:
    """-> uint8 picture of a map, values [S, S], [S, S, 3] or of materials [S, S, len(LABELS)], and the value that is
    shown as white."""
    if name == "confidence":
        return viridis_bytes(values, 0.0, 1.0), 1.0
    if name == "material":
        return label_picture(values), 1.0
    if name == "normal":
        return (np.clip(values, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8), 1.0
    if values.ndim == 3:
        return srgb_bytes(values), 1.0
    high = max(1.0, float(np.percentile(values, 99.5)))
    return grey_bytes(values, 0.0, high), high


def _one(picture: np.ndarray | None, longest: int, alt: str, text: str) -> Figure | None:
    """A picture that a stage left, uint8, or None where it left none."""
    return None if picture is None else Figure(jpeg_uri(shrunk(picture, longest)), alt, text=text)


def light_pictures(envmap: np.ndarray) -> list[Figure]:
    """The environment map, envmap [H, W, 3] linear, as exposed and four stops darker."""
    picture = shrunk(envmap, LIGHT_PIXELS)
    return [Figure(jpeg_uri(srgb_bytes(picture * gain)), f"environment map {text}", text=text)
            for gain, text in ((1.0, "as the camera exposed it"), (1 / 16, "four stops darker, to see into the lamps"))]


def view_pictures(views: ViewSet) -> dict[str, list[Figure]]:
    """The head from where no camera stood (novel), under other lights (relit), and how much of a reflected lobe it
    leaves open at several roughnesses (visibility)."""
    novel, relit, visibility = [], [], []
    for name, picture in views.novel.items():
        yaw, pitch = NOVEL_VIEWS[name]
        where = f"{abs(yaw):.0f}\u00b0 to the {name}" if yaw else f"{abs(pitch):.0f}\u00b0 from {name}"
        novel.append(Figure(_linear_uri(picture), f"the head, {where}", where))
    for name, picture in views.relit.items():
        text = STUDIO_LIGHTS[name]
        relit.append(Figure(_linear_uri(picture), text, name.replace("_", " "), f": {text}"))
    for roughness, share in views.visibility.items():
        visibility.append(Figure(_visibility_uri(share), f"visibility at roughness {roughness:g}",
                                  f"roughness {roughness:g}"))
    return {"novel": novel, "relit": relit, "visibility": visibility}


def _linear_uri(linear: np.ndarray) -> str:
    return jpeg_uri(srgb_bytes(shrunk(linear, VIEW_PIXELS)))


def _visibility_uri(share: np.ndarray) -> str:
    """[H, W] in 0 .. 1, not finite beside the head -> data URI."""
    outside = ~np.isfinite(share)
    codes = grey_bytes(np.where(outside, 0.0, share), 0.0, 1.0)
    codes[outside] = _NOTHING
    return jpeg_uri(shrunk(codes, VIEW_PIXELS))


def motion_charts(content: ReportContent | ClipContent) -> list[str]:
    """Rotation and position over the clip's frames; strokes below mark frames that were left out."""
    angles = dict(zip(("yaw", "pitch", "roll"), content.angles_deg.T, strict=True))
    position = dict(zip(("x", "y", "z"), (content.position_mm - content.position_mm.mean(0)).T, strict=True))
    marks = [frame for frame, _, _ in content.excluded]
    return [line_chart(content.frame_index, curves, x_label="frame", y_label=label, marks=marks)
            for curves, label in ((angles, "rotation, degrees"), (position, "position - mean, mm"))]


def error_rows(residuals: Mapping[str, object], frames: Sequence[Mapping]) -> list[tuple[str, str, str]]:
    """Errors on fitted and on held-out frames side by side, the solver's and the pictures'.

    frames: the compared ones, with "psnr" (dB or None) and "held_out".
    """
    rows = []
    pair = [residuals.get(name) for name in ("fitted", "held_out")]
    if any(isinstance(value, (int, float)) for value in pair):
        rows.append(("light and specular, at sample points (share of full scale)", *map(number, pair)))
    known = [frame for frame in frames if frame["psnr"] is not None]
    kinds = [[frame["psnr"] for frame in known if frame["held_out"] == held] for held in (False, True)]
    shown = [f"{np.mean(values):.1f}" if values else "-" for values in kinds]
    return [*rows, ("re-renders on this page (PSNR, dB)", *shown)]


def residual_rows(residuals: Mapping[str, object]) -> list[tuple[str, str]]:
    """The residuals that neither error_rows() nor the models tried show."""
    shown = ("fitted", "held_out", "texture_held_out")
    rest = {key: value for key, value in residuals.items() if key not in shown}
    return [(name, number(value)) for name, value in flat(rest)]


def course_chart(iterations: Sequence[Mapping[str, float]]) -> str:
    """fitted and held_out of each iteration, where there are at least two; else nothing."""
    names = [name for name in ("fitted", "held_out") if any(name in step for step in iterations)]
    if len(iterations) < 2 or not names:
        return ""
    missing = float("nan")
    curves = {
        name.replace("_", " "): [missing if step.get(name) is None else float(step[name]) for step in iterations]
        for name in names
    }
    steps = range(1, len(iterations) + 1)
    return line_chart(steps, curves, x_label="iteration", y_label="residual", from_zero=True)


def selection_rows(selection: Sequence[Mapping]) -> list[list[str]]:
    """The models that were tried, candidate by candidate."""
    keys = ("part", "candidate", "held_out", "fall", "standard_error", "accepted", "open", "seconds")
    errors = ("held_out", "fall", "standard_error")
    return [[f"{row[key]:.6f}" if key in errors and row[key] is not None else number(row[key]).replace("_", " ")
             for key in keys] for row in selection]


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


def _columns(candidates: Sequence[Mapping]) -> dict[str, list]:
    """{"head", "rows", "numbers"} of a table of the candidates, a column for each key that any of them has."""
    keys = list(dict.fromkeys(key for candidate in candidates for key in candidate))
    numbers = [k for k, key in enumerate(keys)
               if all(isinstance(candidate.get(key), (int, float, type(None))) for candidate in candidates)]
    return {"head": [key.replace("_", " ") for key in keys], "numbers": numbers,
            "rows": [[number(candidate.get(key)) for key in keys] for candidate in candidates]}


def cost_rows(content: ReportContent) -> list[tuple[str, str, str, str]]:
    """Seconds and peak memory of each stage, then of all."""

    def shown(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    rows = [(c.stage, shown(c.wall_s, 1), shown(c.cpu_s, 1), shown(c.peak_memory_mb, 0)) for c in content.costs]
    return [*rows, ("all", f"{sum(c.wall_s or 0.0 for c in content.costs):.1f}", "", "")]


def flat(values: Mapping[str, object], prefix: str = "") -> list[tuple[str, object]]:
    """Nested dictionaries -> [("outer, inner", value)]."""
    rows = []
    for key, value in values.items():
        name = f"{prefix}{key}".replace("_", " ")
        rows += flat(value, f"{name}, ") if isinstance(value, Mapping) else [(name, value)]
    return rows


def _viewer_data(content: ReportContent) -> dict:
    roughness, specular = content.maps.get("roughness"), content.maps.get("specular_intensity")
    wet, hair = np.zeros(len(content.mesh.vertices), bool), content.hair
    for eye in content.eyes:
        wet[eye.vertices] = True
    return {
        "mesh": packed(content.mesh, content.normals, wet, content.actions),
        "hair": None if hair is None else {
            "mesh": packed(hair, shading_normals(hair)),
            "albedo": jpeg_uri(srgb_bytes(shrunk(content.maps[HAIR_ALBEDO], VIEWER_TEXTURE_PIXELS))),
            "alpha": jpeg_uri(grey_bytes(shrunk(content.maps[HAIR_ALPHA], VIEWER_TEXTURE_PIXELS), 0.0, 1.0)),
        },
        "wet": WET,
        "action_step": ACTION_STEP_MM,
        "albedo": jpeg_uri(srgb_bytes(shrunk(content.maps["diffuse_albedo"], VIEWER_TEXTURE_PIXELS))),
        "harmonics": np.round(irradiance_harmonics(content.envmap), 6).tolist(),
        "roughness": 0.4 if roughness is None else round(float(np.median(roughness)), 4),
        "specular": 1.0 if specular is None else round(float(np.median(specular)), 4),
    }
