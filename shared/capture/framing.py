"""Where the head is in the picture, one crop that holds it in every frame, and what the crop does to the camera."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from shared.capture.landmarks import CHIN, OVAL

FOREHEAD = OVAL[0]
MASK_LEVEL = 0.5
# In face heights (hairline to chin). Least: holds skull, ears and neck of a bald head at any angle. Most: where hair,
# hats or hands are given up.
LEAST_ABOVE, LEAST_ASIDE, BELOW = 0.35, 0.30, 0.45
MOST_ABOVE, MOST_ASIDE = 0.90, 0.90
WINDOW_HEIGHTS = 3.2
STRAY_SHARE = 0.002
MARGIN_SHARE = 0.04
SCALE_STEPS = 32
# A phone's main camera sees 0.75 to 0.85 of the long side, a portrait lens 1.6 to 2.4: the middle, in ratio.
GUESSED_FOCAL = 1.3


class Crop(NamedTuple):
    """Whole source pixels x0, y0, width, height, and scale: u_crop = (u_source - x0) * scale, centres at +0.5."""

    x0: int
    y0: int
    width: int
    height: int
    scale: float

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the crop as stored; exact, since the scale is a number of 32nds."""
        return round(self.width * self.scale), round(self.height * self.scale)


def landmark_box(points: np.ndarray) -> np.ndarray:
    """[468, >=2] -> [4]: x0, y0, x1, y1 around the landmarks."""
    return np.concatenate([points[:, :2].min(axis=0), points[:, :2].max(axis=0)])


def face_height(points: np.ndarray) -> float:
    """Length from hairline to chin, px; points [468, >=2] px: landmarks."""
    return float(np.linalg.norm(points[FOREHEAD, :2] - points[CHIN, :2]))


def skull_box(points: np.ndarray) -> np.ndarray:
    """[4]: x0, y0, x1, y1 px, the tightest that a bald head without its neck can be; points [468, >=2] px:
    landmarks."""
    return landmark_box(points) + face_height(points) * np.array([0.0, -0.2, 0.0, 0.0])


def head_window(points: np.ndarray, width: int, height: int) -> tuple[int, int, int, int]:
    """Square x0, y0, x1, y1 around head and shoulders, cut at the picture's edges: what the person mask should see.
    points [468, >=2] px; width, height: of the picture, px."""
    box, half = landmark_box(points), WINDOW_HEIGHTS / 2 * face_height(points)
    centre = (box[:2] + box[2:]) / 2
    low = np.clip(np.floor(centre - half), 0, (width - 1, height - 1)).astype(int)
    high = np.clip(np.ceil(centre + half), low + 1, (width, height)).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def head_box(points: np.ndarray, mask: np.ndarray | None = None, offset: tuple[int, int] = (0, 0)) -> np.ndarray:
    """[4]: x0, y0, x1, y1 px around the whole head with hair, ears, chin and the upper neck.

    points: landmarks [468, >=2] px. mask: person mask [h, w] in [0, 1] whose first pixel is at `offset`; without one
    the least box that holds a head without hair.
    """
    x0, y0, x1, y1 = landmark_box(points)
    tall = face_height(points)
    least = np.array([x0 - LEAST_ASIDE * tall, y0 - LEAST_ABOVE * tall, x1 + LEAST_ASIDE * tall, y1 + BELOW * tall])
    if mask is None:
        return least
    most = np.array([x0 - MOST_ASIDE * tall, y0 - MOST_ABOVE * tall, x1 + MOST_ASIDE * tall, y1])
    left, top, right, bottom = np.rint(most - np.tile(offset, 2)).astype(int)
    left, top = max(left, 0), max(top, 0)
    own = own_region(mask > MASK_LEVEL, landmark_box(points) - np.tile(offset, 2))
    rows, columns = np.nonzero(own[top:max(bottom, top), left:max(right, left)])
    if len(rows) == 0:
        return least
    # A few stray pixels of the mask are no hair: leave out the outermost on each side.
    stray = STRAY_SHARE, 1 - STRAY_SHARE
    (hair_left, hair_right), hair_top = np.quantile(columns, stray), np.quantile(rows, STRAY_SHARE)
    shift_x, shift_y = left + offset[0], top + offset[1]
    return np.array([min(least[0], hair_left + shift_x), min(least[1], hair_top + shift_y),
                     max(least[2], hair_right + 1 + shift_x), least[3]])


def own_region(person: np.ndarray, box: np.ndarray) -> np.ndarray:
    """bool [H, W] -> bool [H, W]: the connected region that fills most of a box ([4] px), nobody else's."""
    height, width = person.shape
    x0, y0, x1, y1 = np.rint(np.clip(box, 0, (width, height, width, height))).astype(int)
    _, regions = cv2.connectedComponents(person.astype(np.uint8))
    inside = regions[y0:y1, x0:x1]
    inside = inside[inside > 0]
    return regions == np.bincount(inside).argmax() if inside.size else np.zeros_like(person, bool)


def interpolate_offsets(index: np.ndarray, known_index: np.ndarray, known_offsets: np.ndarray) -> np.ndarray:
    """[N, 4] from [K, 4] known at rising positions, linear in between. index [N] and known_index [K]: positions;
    known_offsets [K, 4] px."""
    return np.stack([np.interp(index, known_index, known_offsets[:, side]) for side in range(4)], axis=1)


def choose_crop(head_boxes: np.ndarray, width: int, height: int, max_size: int) -> Crop:
    """The one crop that holds the head in all frames with a margin.

    head_boxes: [N, 4] source px. width, height: of the source. Crops longer than `max_size` px are scaled down by a
    number of 32nds and are then whole multiples of 32 px, so that both axes scale alike; none is scaled up.
    """
    low, high = head_boxes[:, :2].min(axis=0), head_boxes[:, 2:].max(axis=0)
    margin = MARGIN_SHARE * float(np.max(high - low))
    limits = np.array([width, height])
    low = np.clip(np.floor(low - margin), 0, limits - 1).astype(int)
    high = np.clip(np.ceil(high + margin), low + 1, limits).astype(int)
    longest = int(np.max(high - low))
    # Lengths grow to multiples of 32 before they are scaled, hence the 31.
    fits = longest <= max_size
    steps = SCALE_STEPS if fits else SCALE_STEPS * max_size // (longest + SCALE_STEPS - 1)
    unit = 2 if fits else SCALE_STEPS
    (x0, wide), (y0, tall) = (_snapped(low[i], high[i], int(limits[i]), unit) for i in range(2))
    return Crop(x0, y0, wide, tall, min(max(steps, 1), SCALE_STEPS) / SCALE_STEPS)


def _snapped(low: int, high: int, limit: int, unit: int) -> tuple[int, int]:
    """Start and length of the interval grown to a multiple of `unit` inside [0, limit] (shrunk where it cannot)."""
    length = -(-(high - low) // unit) * unit
    if length > limit:
        length = max(limit // unit * unit, min(limit, unit))
    return int(min(max(low - (length - (high - low)) // 2, 0), limit - length)), int(length)


def pinhole(focal_length_px: float, width: int, height: int) -> np.ndarray:
    """Intrinsics [3, 3] with the principal point in the picture's centre (pixel centres at +0.5)."""
    return np.array([[focal_length_px, 0, width / 2], [0, focal_length_px, height / 2], [0, 0, 1]], float)


def crop_intrinsics(intrinsics: np.ndarray, crop: Crop) -> np.ndarray:
    """Intrinsics [3, 3] of the crop; exact, since pixel edges (not centres) are whole numbers."""
    to_crop = np.array([[crop.scale, 0, -crop.x0 * crop.scale], [0, crop.scale, -crop.y0 * crop.scale], [0, 0, 1]])
    return to_crop @ intrinsics
