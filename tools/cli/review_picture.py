"""The picture that shows why a result is flagged: one panel for each gate that it missed."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from shared.contract.folders import RunFolder
from shared.io.arrays import read_json
from shared.io.frames import FrameSet
from shared.io.images import read_exr, read_png, write_png
from shared.report.content import compared_frames
from shared.report.pictures import error_bytes, srgb_bytes, viridis_bytes
from tools.cli.measures import clips_of, confidence_map, tracking_errors, tracking_records
from tools.cli.records import PICTURE

WIDTH_PX, TITLE_PX, TILE_PX = 960, 36, 320
_TEXT = (235, 235, 235)


def write_review(run: RunFolder, gates: Sequence[str], titles: Sequence[str]) -> None:
    """work/review.png."""
    panels = {"reprojection_px": _residuals, "reprojection_p95_px": _residuals, "rotation_range_deg": _views,
              "focal_off": _views, "held_out_residual": _worst_frames, "coverage": _confidence,
              "confidence": _confidence}
    rows = [_titled(title, _fitted(panels[gate](run))) for gate, title in zip(gates, titles, strict=True)]
    write_png(run.work / PICTURE, np.vstack(rows))


def _residuals(run: RunFolder) -> np.ndarray:
    """Where on the skin the tracks do not fit, of the clip that was tracked worst."""
    clip = max(tracking_errors(run), key=lambda pair: pair[0])[1]
    return read_png(clip.published("track_landmarks") / "residuals.png")


def _views(run: RunFolder) -> np.ndarray:
    """The tracked head in a few frames that lie far apart, of the clip that turns least."""
    clip = min(tracking_records(run), key=lambda pair: pair[0].get("rotation_range_deg", np.inf))[1]
    return read_png(clip.published("track_landmarks") / "overlay.png")


def _worst_frames(run: RunFolder) -> np.ndarray:
    """Clip, re-render and error of the three re-rendered frames that fit worst."""
    solved = run.published("inverse_render")
    record = read_json(solved / "solve.json")
    frames = FrameSet.open(clips_of(run)[0].published("sample_frames"))
    compared = compared_frames(frames, solved / "renders", record["render_frames"], record["held_out_frames"])
    rows = []
    for frame in compared:
        rendered = (frame.render > 0).any(axis=-1)
        error = float(np.abs(frame.render - frame.clip)[rendered].mean()) if rendered.any() else np.inf
        tiles = srgb_bytes(frame.clip), srgb_bytes(frame.render), error_bytes(frame.clip, frame.render, frame.clipped)
        note = f"frame {frame.frame_index}: {error:.3f}" + ", held out" * frame.held_out
        rows.append((-error, frame.frame_index, _noted(np.hstack([_tile(tile) for tile in tiles]), note)))
    return np.vstack([row for _, _, row in sorted(rows, key=lambda row: row[:2])[:3]])


def _confidence(run: RunFolder) -> np.ndarray:
    """The confidence map: dark where the clip does not determine the texel."""
    values = read_exr(confidence_map(run))
    return cv2.resize(viridis_bytes(values, 0.0, 1.0), (WIDTH_PX, WIDTH_PX), interpolation=cv2.INTER_AREA)


def _tile(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    return cv2.resize(picture, (TILE_PX, round(TILE_PX * height / width)), interpolation=cv2.INTER_AREA)


def _noted(picture: np.ndarray, note: str) -> np.ndarray:
    noted = np.ascontiguousarray(picture)
    cv2.putText(noted, note, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(noted, note, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
    return noted


def _fitted(picture: np.ndarray) -> np.ndarray:
    colour = np.dstack([picture] * 3) if picture.ndim == 2 else picture
    height, width = colour.shape[:2]
    return cv2.resize(colour, (WIDTH_PX, round(WIDTH_PX * height / width)), interpolation=cv2.INTER_AREA)


def _titled(title: str, picture: np.ndarray) -> np.ndarray:
    bar = np.full((TITLE_PX, WIDTH_PX, 3), 40, np.uint8)
    cv2.putText(bar, title, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _TEXT, 1, cv2.LINE_AA)
    return np.vstack([bar, picture])
