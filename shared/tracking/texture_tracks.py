"""Skin tracks against the clip's own mean texture: sub-pixel, over the whole turn, each with its covariance.

The mean of all frames in the head's atlas shows the skin without noise and without the light that slides over it. Each
frame, brought there by its believed pose, is off by a fraction of a pixel; inverse-compositional Lucas-Kanade over
small windows finds it, and how well it is known. Pixels that don't move with the skin (highlights, shadows' edges,
hair) differ from the mean and lose their weight.

Reference: [Baker2004], sections 3.2 (inverse-compositional Lucas-Kanade) and 5 (weights).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from shared.compute.robust import cauchy_weight
from shared.geometry.atlas import Atlas, PlacedFrame, sample

LEAST_COVER = 0.6
"""Share of a window that a frame must show."""

LEAST_AGREEMENT = 0.4
"""Share of what it shows that must agree with the mean; a frame twice as noisy as the others keeps that."""

OUTLIER_SPREADS = 1.5
"""Differences from the mean beyond so many of the texel's own spreads lose their weight (Cauchy)."""

LEAST_SPREAD = 1.0
"""Code values: the pictures are quantised."""

LOOKUP_ROW = 256


@dataclass(frozen=True)
class MeanContrast:
    """mean [h, w] of the frames' contrast pictures, spread [h, w] about it, seen [h, w]: how many frames count."""

    mean: np.ndarray
    spread: np.ndarray
    seen: np.ndarray

    @cached_property
    def gradient(self) -> tuple[np.ndarray, np.ndarray]:
        """Central differences [h, w] along columns and rows."""
        kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
        return cv2.filter2D(self.mean, cv2.CV_32F, kernel), cv2.filter2D(self.mean, cv2.CV_32F, kernel.T)


def mean_texture(frames: Callable[[], Iterable[tuple[np.ndarray, np.ndarray]]]) -> MeanContrast:
    """Mean over (picture [h, w] float32, weight [h, w]) pairs, then once more with outliers weighed down.

    frames() iterates over the pairs anew each time it is called.
    """
    mean, spread, _ = _moments(frames(), lambda image, weight: weight)
    scale = OUTLIER_SPREADS * spread
    mean, spread, seen = _moments(frames(), lambda image, weight: cauchy_weight(image - mean, scale, weight))
    return MeanContrast(mean.astype(np.float32), spread.astype(np.float32), seen.astype(np.float32))


def _moments(pairs, reweigh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    total, squares, weights = 0.0, 0.0, 0.0
    for image, weight in pairs:
        weight = reweigh(image, weight)
        total, squares, weights = total + weight * image, squares + weight * image * image, weights + weight
    mean = total / np.maximum(weights, 1e-6)
    return mean, np.sqrt(np.maximum(squares / np.maximum(weights, 1e-6) - mean * mean, LEAST_SPREAD**2)), weights


@dataclass(frozen=True)
class Windows:
    """sigma of the windows and largest believed error, in texels; steps; floor: the least noise of a track, px;
    least_spread: code values below which no texel's spread counts, for frames that are off and so differ everywhere."""

    sigma: float = 5.0
    search: float = 6.0
    steps: int = 3
    floor_px: float = 0.03
    least_spread: float = LEAST_SPREAD


def track_frame(
    atlas: Atlas, texture: MeanContrast, picture: np.ndarray, placed: PlacedFrame, windows: Windows
) -> tuple[np.ndarray, np.ndarray]:
    """Where one frame's contrast picture [H, W] shows the tracked texels.

    -> positions [N, 2] px (NaN: not found) and whitening [N, 2, 2] 1/px: whitening @ error has unit covariance where
    the window's pixels differ from the mean by independent noise. Nothing is found where the believed pose puts the
    head out of the picture, as the guess for a doubtful frame may.
    """
    known = (placed.shown > 0) & (texture.seen > 0)
    texels = np.flatnonzero(known)
    if not len(texels):
        return np.full((len(atlas.rows), 2), np.nan), np.zeros((len(atlas.rows), 2, 2))
    known[atlas.rows, atlas.columns] = True
    moving = np.flatnonzero(known)
    lookups = _Lookups(texels, placed.shown.shape[1])
    mean, spread = texture.mean.ravel().take(texels), texture.spread.ravel().take(texels)
    gx, gy = (part.ravel().take(texels) for part in texture.gradient)
    offset = np.zeros((*placed.shown.shape, 2), np.float32)
    scale = OUTLIER_SPREADS * np.maximum(spread, np.float32(windows.least_spread))
    windowed, offsets = _Windowed(placed.shown.shape, texels, windows), offset.reshape(-1, 2)
    for step in range(windows.steps):
        image = lookups.sample(picture, placed.layout, offset if step else None)
        difference = image.astype(np.float32) - mean
        weight = cauchy_weight(difference, scale)
        wx, wy = weight * gx, weight * gy
        normal = windowed.means(wx * gx, wx * gy, wy * gy, wx * difference)
        pull = windowed.means(wy * difference)
        moved = offsets.take(moving, 0) - _solved(normal.reshape(-1, 4).take(moving, 0), pull.ravel().take(moving))
        moved = np.clip(moved, -2.0 * windows.search, 2.0 * windows.search)
        offsets[moving, 0], offsets[moving, 1] = moved.T
    # outliers don't pull, but a window full of them says little: its variance counts them
    others = windowed.means(weight, np.ones_like(weight), difference * difference)
    at = atlas.rows, atlas.columns
    return _observations(atlas, placed, offset[at], _WindowMeans(*normal[at].T[:3], *others[at].T), windows)


class _Lookups:
    """Samples a frame at the texels that it shows, in rows of a shape that cv2.remap takes."""

    def __init__(self, texels: np.ndarray, width: int) -> None:
        """texels [n]: indices into the atlas; width: of the atlas."""
        self._count, rows = len(texels), -(-len(texels) // LOOKUP_ROW)
        self._texels = np.zeros((rows, LOOKUP_ROW), np.int64)  # what fills the last row is texel 0
        self._texels.ravel()[: len(texels)] = texels
        self._columns = (self._texels % width).astype(np.float32)
        self._rows = (self._texels // width).astype(np.float32)

    def sample(self, picture: np.ndarray, layout: np.ndarray, offset: np.ndarray | None) -> np.ndarray:
        """Values [n] of a picture [H, W] where its layout [h, w, 2] says that the texels lie, moved by an offset
        [h, w, 2] in texels; None: by nothing."""
        if offset is None:
            places = layout.reshape(-1, 2).take(self._texels, 0)
        else:
            moved = offset.reshape(-1, 2).take(self._texels, 0)
            places = cv2.remap(layout, self._columns + moved[..., 0], self._rows + moved[..., 1], cv2.INTER_LINEAR)
        return sample(picture, places, cv2.INTER_CUBIC).ravel()[: self._count]


class _Windowed:
    """Means over windows of values that only some texels have; the others count as 0."""

    def __init__(self, shape: tuple[int, int], texels: np.ndarray, windows: Windows) -> None:
        """shape (h, w) of the atlas; texels [n]: indices into it."""
        self._shape, self._texels, self._ksize = shape, texels, (_window_width(windows.sigma),) * 2
        self._images: dict[int, np.ndarray] = {}

    def means(self, *values: np.ndarray) -> np.ndarray:
        """1, 3 or 4 times values [n] -> [h, w] or [h, w, 3 or 4]: one pass for all."""
        count = len(values)
        if count not in self._images:
            self._images[count] = np.zeros((*self._shape, count), np.float32)
        image = self._images[count]
        for k, value in enumerate(values):
            image.reshape(-1, count)[self._texels, k] = value
        return cv2.stackBlur(image, self._ksize)


def _solved(normal: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """[n, 2] of the normal equations, damped a little where a window has no texture. normal [n, 4]: xx, xy, yy, x; pull
    [n]: y."""
    xy, x, y = normal[:, 1], normal[:, 3], pull
    xx, yy = normal[:, 0] + 1.0, normal[:, 2] + 1.0
    determinant = xx * yy - xy * xy
    return np.stack([(yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant], axis=1)


@dataclass(frozen=True)
class _WindowMeans:
    """At the tracked texels [N]: of the weighted products of gradients, of the weight (cover), of the texels shown, and
    of their squared differences."""

    xx: np.ndarray
    xy: np.ndarray
    yy: np.ndarray
    cover: np.ndarray
    shown: np.ndarray
    squares: np.ndarray


def _window_width(sigma: float) -> int:
    return 2 * int(round(2.0 * sigma)) + 1


def _observations(atlas, placed, moved, means, windows) -> tuple[np.ndarray, np.ndarray]:
    """The flow at the tracked texels, taken to the picture with its covariance."""
    place = np.stack([atlas.columns, atlas.rows], axis=1).astype(np.float32) + moved
    across, down = np.float32([2, 0]), np.float32([0, 2])
    stretch = np.stack(
        [0.25 * (_lookup(placed.layout, place + d) - _lookup(placed.layout, place - d)) for d in (across, down)], -1
    )
    pixels = 0.56 * _window_width(windows.sigma) ** 2  # texels that a triangular window amounts to
    shown = means.shown
    variance = (means.squares + 1e-3) / np.maximum(shown, 1e-6)
    normal = np.stack([np.stack([means.xx, means.xy], -1), np.stack([means.xy, means.yy], -1)], -2)
    information = normal.astype(np.float64) * (pixels / variance)[:, None, None]
    good = (placed.shown[atlas.rows, atlas.columns] > 0) & (shown > LEAST_COVER)
    good &= means.cover > LEAST_AGREEMENT * shown
    good &= np.linalg.norm(moved, axis=1) < windows.search
    good &= (np.linalg.det(information) > 1e-8) & (np.abs(np.linalg.det(stretch)) > 1e-3)
    covariance = stretch[good] @ np.linalg.inv(information[good]) @ np.swapaxes(stretch[good], 1, 2)
    covariance += windows.floor_px**2 * np.eye(2)
    whitening = np.zeros((len(place), 2, 2))
    whitening[good] = np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), 1, 2)
    found = np.full((len(place), 2), np.nan)
    found[good] = _lookup(placed.layout, place)[good]
    return found, whitening


def _lookup(field: np.ndarray, at: np.ndarray) -> np.ndarray:
    """A field [h, w, 2] interpolated at integer-centred positions [N, 2] -> [N, 2]."""
    x, y = np.ascontiguousarray(at[:, :1]), np.ascontiguousarray(at[:, 1:])
    return cv2.remap(field, x, y, cv2.INTER_LINEAR)[:, 0].astype(np.float64)
