"""Puts the report's page together: one HTML file without any outside reference."""

from __future__ import annotations

import json
from html import escape
from pathlib import Path
from string import Template

import numpy as np

from shared.geometry.mesh import vertex_normals
from shared.report import model_sections, sections, view_sections
from shared.report.content import ReportContent
from shared.report.pictures import jpeg_uri, shrunk, srgb_bytes
from shared.report.viewer import irradiance_harmonics, packed, reduced

_FOLDER = Path(__file__).parent
_VIEWER_TEXTURE_PIXELS = 1024
_VIEWER = """<canvas id="viewer" aria-label="the head in 3D"></canvas>
<p id="viewer-absent" hidden>Not shown here (no WebGL 2, or too large a mesh): open head.usda or mesh.obj.</p>
<div class="controls">
<label><input id="viewer-moves-head" name="viewer-moves" type="radio" checked> drag turns the head</label>
<label><input id="viewer-moves-lamp" name="viewer-moves" type="radio"> drag moves the lamp</label>
<label>light of the clip <input id="viewer-clip" type="range" min="0" max="2" step="0.01" value="1"></label>
<label>lamp <input id="viewer-lamp" type="range" min="0" max="4" step="0.01" value="0.4"></label>
<label><input id="viewer-plain" type="checkbox"> shape only</label>
</div>
<p class="note">A quick look: mesh reduced, light of the clip as soft harmonics, no shadows.</p>"""


def report_html(content: ReportContent) -> str:
    """The page as text. Deterministic: the same content gives the same text."""
    frames = [sections.comparison_frame(frame) for frame in content.frames]
    blocks = (
        ("warnings", "Warnings", sections.warning_section(content.warnings)),
        ("frames", "Clip and re-render", sections.comparison_section(frames)),
        ("maps", "Maps", sections.map_section(content.maps)),
        ("view", "In the round", _VIEWER),
        ("shape", "Shape", view_sections.shape_section(content.shape)),
        ("novel", "Novel views", view_sections.novel_section(content.views)),
        ("relit", "Other lights", view_sections.relit_section(content.views)),
        ("visibility", "Visibility", view_sections.visibility_section(content.views)),
        ("light", "Light", sections.light_section(content.envmap, content.chart)),
        ("poses", "Motion", sections.pose_section(content)),
        ("tracking", "Tracking", sections.tracking_section(content.overlay)),
        ("excluded", "Frames left out", sections.excluded_section(content.excluded)),
        *([("clips", "Other clips", sections.clips_section(content.clips))] if content.clips else []),
        ("residuals", "Residuals", model_sections.residual_section(content, frames)),
        ("model_selection", "Models tried", model_sections.selection_section(content)),
        ("cost", "Time and memory", sections.cost_section(content)),
        ("parameters", "Parameters", sections.parameter_section(content)),
        ("methods", "Methods", model_sections.methods_section(content.methods)),
        ("files", "Files", sections.table(("file", "what"), content.files)),
    )
    page = Template(_text("page.html"))
    return page.substitute(
        title=escape(content.name),
        style=_text("page.css"),
        facts=", ".join(f"{escape(label)} {escape(value)}" for label, value in content.facts),
        numbers="".join(f"<li><b>{escape(v)}</b><span>{escape(k)}</span></li>" for k, v in content.numbers),
        navigation="".join(f'<a href="#{anchor}">{heading}</a>' for anchor, heading, _ in blocks),
        sections="".join(f'<section id="{a}"><h2>{heading}</h2>{body}</section>' for a, heading, body in blocks),
        data=_embedded({"frames": frames, "viewer": _viewer_data(content)}),
        script=_text("viewer.js") + _text("page.js"),
    )


def _viewer_data(content: ReportContent) -> dict | None:
    """None when the mesh cannot be made small enough for a page."""
    small = reduced(content.mesh)
    if small is None:
        return None
    roughness, specular = content.maps.get("roughness"), content.maps.get("specular_intensity")
    return {
        "mesh": packed(small, vertex_normals(content.mesh.vertices, content.mesh.faces)),
        "albedo": jpeg_uri(srgb_bytes(shrunk(content.maps["diffuse_albedo"], _VIEWER_TEXTURE_PIXELS))),
        "harmonics": np.round(irradiance_harmonics(content.envmap), 6).tolist(),
        "roughness": 0.4 if roughness is None else round(float(np.median(roughness)), 4),
        "specular": 1.0 if specular is None else round(float(np.median(specular)), 4),
    }


def _text(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")


def _embedded(value: object) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
