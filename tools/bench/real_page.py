"""What a person judges real clips by: a sheet of each, and one page with all sheets beside their measures.

A row of a sheet is a held-out frame: the frame, its re-render, their difference (blue: the re-render is darker, red:
brighter, white: equal), the albedo, and the head under a light that the clip does not have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import cv2
import numpy as np

from shared.imaging.frame_index import spread_frames
from shared.io.images import write_png
from shared.report.pictures import error_bytes, srgb_bytes
from tools.bench.rerender import SolvedClip, is_clipped
from tools.bench.runner import shown_value
from tools.scoring.held_out import HeldOutFrame

SHEET_FRAMES, TILE_PX = 4, 360
GREY = 96
STYLE = (
    "body{font:14px sans-serif;margin:2em;color:#333}img{max-width:100%}h2{margin-top:2em}table{border-collapse:"
    "collapse}td,th{padding:2px 10px;text-align:left;border-bottom:1px solid #ddd}.many{columns:4 260px}.many div{"
    "break-inside:avoid}"
)


def clip_sheet(clip: SolvedClip, compared: Sequence[HeldOutFrame], path: Path) -> None:
    """Writes the sheet of a solved clip, some of whose compared frames it shows."""
    rows = []
    for k in spread_frames(len(compared), SHEET_FRAMES):
        item, camera = compared[k], clip.held_out[k]
        shown = (item.render > 0.0).any(-1)
        clipped = is_clipped(clip.frames.read_codes(camera.place))
        tiles = [srgb_bytes(item.picture), srgb_bytes(item.render),
                 error_bytes(item.picture, item.render, clipped),
                 srgb_bytes(clip.albedo(camera)), srgb_bytes(clip.relit(camera))]  # fmt: skip
        rows.append([tile[head_window(shown)] for tile in tiles])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, tiled(rows))


def head_window(shown: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the head in [H, W] bool, with a twentieth of its height around it."""
    rows, columns = (np.nonzero(shown.any(axis))[0] for axis in (1, 0))
    if not rows.size:
        return slice(None), slice(None)
    margin = round((rows[-1] - rows[0]) / 20)
    return tuple(slice(max(0, line[0] - margin), line[-1] + 1 + margin) for line in (rows, columns))


def tiled(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """Pictures uint8 [h, w, 3] in rows, each fitted into a square of TILE_PX on grey."""
    return np.vstack([np.hstack([_tile(picture) for picture in row]) for row in rows])


def _tile(picture: np.ndarray) -> np.ndarray:
    scale = TILE_PX / max(picture.shape[:2])
    size = tuple(max(1, min(TILE_PX, round(side * scale))) for side in picture.shape[1::-1])
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC)
    tile = np.full((TILE_PX, TILE_PX, 3), GREY, np.uint8)
    left, top = ((TILE_PX - side) // 2 for side in size)
    tile[top : top + size[1], left : left + size[0]] = small
    return tile


def html_page(rows: Sequence[Mapping], columns: Sequence[str], sheets: Path) -> str:
    """The page's text: a section for each row, whose sheet is sheets/<case>.png; the page lies beside that folder."""
    parts = [f"<!DOCTYPE html><html lang='en'><meta charset='utf-8'><title>Real clips</title><style>{STYLE}</style>",
             "<h1>Real clips</h1><p>Held-out frames: the frame, its re-render, their difference (blue: the re-render "
             "is darker; red: brighter), the albedo, under another light.</p>"]  # fmt: skip
    for row in rows:
        case = str(row["case"])
        parts.append(f"<h2>{escape(case)}</h2>")
        if (sheets / f"{case}.png").is_file():
            parts.append(f"<img src='{escape(f'{sheets.name}/{case}.png')}' alt='held-out frames of {escape(case)}'>")
        known = [(name, shown_value(row[name])) for name in columns if row.get(name) not in (None, "")]
        parts.append("<div class='many'>")
        parts += [f"<div><b>{escape(name)}</b> {escape(value)}</div>" for name, value in known]
        parts.append("</div>")
    return "\n".join([*parts, "</html>"]) + "\n"
