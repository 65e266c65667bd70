"""A small picture for people: some frames of a set side by side, with their masks' outlines."""

from __future__ import annotations

import cv2
import numpy as np

from shared.capture.crop_pixels import BACKGROUND, FACE

TILES_PER_SIDE, TILE_PX = 3, 320
PERSON_COLOUR, FACE_COLOUR = (255, 200, 0), (0, 220, 90)


class ContactSheet:
    """Nine tiles, evenly chosen from `count` frames that are added one by one."""

    def __init__(self, count: int) -> None:
        tiles = TILES_PER_SIDE**2
        self._chosen = set(np.rint(np.linspace(0, count - 1, min(count, tiles))).astype(int).tolist())
        self._added = 0
        self._tiles: list[np.ndarray] = []

    def add(self, rgb: np.ndarray, mask: np.ndarray) -> None:
        """The next frame: uint8 [H, W, 3] and its mask [H, W] (0, 128, 255)."""
        if self._added in self._chosen:
            self._tiles.append(_tile(rgb, mask))
        self._added += 1

    def picture(self) -> np.ndarray:
        """uint8 [960, 960, 3] RGB; unused tiles stay grey."""
        blank = np.full((TILE_PX, TILE_PX, 3), 64, np.uint8)
        tiles = self._tiles + [blank] * (TILES_PER_SIDE**2 - len(self._tiles))
        rows = [np.hstack(tiles[i:i + TILES_PER_SIDE]) for i in range(0, TILES_PER_SIDE**2, TILES_PER_SIDE)]
        return np.vstack(rows)


def _tile(rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The frame fitted into a square, outlines drawn after scaling so that they stay thin."""
    height, width = mask.shape
    scale = TILE_PX / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    for region, colour in ((mask > BACKGROUND, PERSON_COLOUR), (mask == FACE, FACE_COLOUR)):
        region = cv2.resize(region.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        outlines, _ = cv2.findContours(region, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(small, outlines, -1, colour, 1)
    tile = np.full((TILE_PX, TILE_PX, 3), 64, np.uint8)
    top, left = (TILE_PX - size[1]) // 2, (TILE_PX - size[0]) // 2
    tile[top:top + size[1], left:left + size[0]] = small
    return tile
