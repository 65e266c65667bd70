"""Sections of the report with pictures from cameras and lights that the clip did not have."""

from __future__ import annotations

from html import escape

import numpy as np

from shared.rendering.studio_lights import STUDIO_LIGHTS
from shared.rendering.view_set import NOVEL_VIEWS, ViewSet
from shared.report.pictures import grey_bytes, jpeg_uri, shrunk, srgb_bytes
from shared.report.sections import figure

VIEW_PIXELS, SHEET_PIXELS = 512, 1600
_NOTHING = 90


def shape_section(sheet: np.ndarray | None) -> str:
    """The refined mesh beside the tracked one. sheet [H, W, 3] uint8: as of shape_pictures.shape_sheet."""
    if sheet is None:
        return "<p>inverse_render left no picture of the shape.</p>"
    caption = (
        "From above: the tracked mesh, the refined one, its normals (red: to the right, green: up, blue: to the "
        "camera), and how far it was moved."
    )
    return figure(jpeg_uri(shrunk(sheet, SHEET_PIXELS)), "the shape from three sides", caption, zoom=True)


def novel_section(views: ViewSet | None) -> str:
    """The head under the clip's light from where no camera stood."""
    if views is None:
        return "<p>Not rendered: the parameter <code>views</code> is off.</p>"
    parts = []
    for name, picture in views.novel.items():
        yaw, pitch = NOVEL_VIEWS[name]
        where = f"{abs(yaw):.0f}\u00b0 to the {name}" if yaw else f"{abs(pitch):.0f}\u00b0 from {name}"
        parts.append(_picture(picture, f"<b>{where}</b>", f"the head, {where}"))
    note = "What no frame of the clip shows is a smooth guess: compare the map of the confidence."
    return f'<div class="maps">{"".join(parts)}</div><p class="note">{note}</p>'


def relit_section(views: ViewSet | None) -> str:
    """The head under other lights."""
    if views is None:
        return "<p>Not rendered: the parameter <code>views</code> is off.</p>"
    parts = []
    for name, picture in views.relit.items():
        text = STUDIO_LIGHTS[name]
        parts.append(_picture(picture, f"<b>{escape(name.replace('_', ' '))}</b>: {escape(text)}", text))
    note = (
        "The clip's light has to be gone here: shadows or highlights that stay in place under every light are baked "
        "into the albedo."
    )
    return f'<div class="maps">{"".join(parts)}</div><p class="note">{note}</p>'


def visibility_section(views: ViewSet | None) -> str:
    """How much of a reflected lobe the head leaves open, at several roughnesses."""
    if views is None:
        return "<p>Not rendered: the parameter <code>views</code> is off.</p>"
    parts = []
    for roughness, share in views.visibility.items():
        outside = ~np.isfinite(share)
        codes = grey_bytes(np.where(outside, 0.0, share), 0.0, 1.0)
        codes[outside] = _NOTHING
        alt, caption = f"visibility at roughness {roughness:g}", f"<b>roughness {roughness:g}</b>"
        parts.append(figure(jpeg_uri(shrunk(codes, VIEW_PIXELS)), alt, caption, zoom=True))
    note = (
        "White: nothing of the head stands in the way of what the skin reflects towards the front; black: all is "
        "covered. A mirror sees all or nothing, a rough surface the open share of the sky."
    )
    return f'<div class="maps">{"".join(parts)}</div><p class="note">{note}</p>'


def _picture(linear: np.ndarray, caption: str, alt: str) -> str:
    return figure(jpeg_uri(srgb_bytes(shrunk(linear, VIEW_PIXELS))), alt, caption, zoom=True)
