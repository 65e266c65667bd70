"""A contact sheet of a result's maps: one picture for people, each map with its name and the range that it shows."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from shared.io.export_maps import HAIR_ALPHA, MAPS
from shared.io.material_maps import label_picture
from shared.report.pictures import grey_bytes, srgb_bytes, viridis_bytes

COLUMNS, TILE_PX, LABEL_PX = 4, 512, 28
_INK, _GROUND = (230, 230, 230), 24
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.5
_COLOUR_MAPPED = ("confidence",)
_FROM_0_TO_1 = ("confidence", "roughness", HAIR_ALPHA)


def map_sheet(maps: Mapping[str, np.ndarray]) -> np.ndarray:
    """Maps named as in export_maps.MAPS, [S, S] or [S, S, 3] linear, of materials [S, S, len(LABELS)] -> uint8
    [H, W, 3] RGB, COLUMNS tiles a row in the order of MAPS. Colours are sRGB-coded, data is linear between the ends
    that the label states."""
    tiles = [_tile(name, maps[name]) for name in MAPS if name in maps]
    tiles += [np.full_like(tiles[0], _GROUND)] * (-len(tiles) % COLUMNS)
    return np.vstack([np.hstack(tiles[k:k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)])


def _tile(name: str, values: np.ndarray) -> np.ndarray:
    interpolation = cv2.INTER_AREA if len(values) > TILE_PX else cv2.INTER_NEAREST
    small = cv2.resize(np.ascontiguousarray(values), (TILE_PX, TILE_PX), interpolation=interpolation)
    label = name.replace("_", " ")
    if MAPS[name][0] == "colour":
        picture = srgb_bytes(small)
    elif name == "material":
        picture = label_picture(small)
    elif small.ndim == 3:
        picture = (np.clip(small, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    else:
        low, high = (0.0, 1.0) if name in _FROM_0_TO_1 else (float(values.min()), float(values.max()))
        label += f", {low:.2f} to {high:.2f}"
        picture = viridis_bytes(small, low, high) if name in _COLOUR_MAPPED else cv2.cvtColor(
            grey_bytes(small, low, high), cv2.COLOR_GRAY2RGB)
    strip = np.full((LABEL_PX, TILE_PX, 3), _GROUND, np.uint8)
    cv2.putText(strip, label, (8, LABEL_PX - 9), _FONT, _FONT_SCALE, _INK, 1, cv2.LINE_AA)
    return np.vstack([strip, picture])
