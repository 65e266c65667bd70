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


@dataclass(frozen=True)
class MeanContrast:
    """mean [h, w] of the frames' contrast pictures, spread [h, w] about it, seen [h, w]: how many frames count."""

    mean: np.ndarray
    spread: np.ndarray
    seen: np.ndarray


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
    """sigma of the windows and largest believed error, in texels; steps; floor: the least noise of a track, px."""

    sigma: float = 5.0
    search: float = 6.0
    steps: int = 3
    floor_px: float = 0.03


def track_frame(
    atlas: Atlas, texture: MeanContrast, picture: np.ndarray, placed: PlacedFrame, windows: Windows
) -> tuple[np.ndarray, np.ndarray]:
    """Where one frame's contrast picture [H, W] shows the tracked texels.

    -> positions [N, 2] px (NaN: not found) and whitening [N, 2, 2] 1/px: whitening @ error has unit covariance where
    the window's pixels differ from the mean by independent noise.
    """
    gradient = _gradient(texture.mean)
    known = placed.shown * (texture.seen > 0)
    rows, columns = np.mgrid[0 : known.shape[0], 0 : known.shape[1]].astype(np.float32)
    offset = np.zeros((*known.shape, 2), np.float32)
    for step in range(windows.steps):
        layout = placed.layout if step == 0 else _shifted(placed.layout, columns, rows, offset)
        difference = sample(picture, layout, cv2.INTER_CUBIC).astype(np.float32) - texture.mean
        weight = cauchy_weight(difference, OUTLIER_SPREADS * texture.spread, known)
        sums = _window_sums(gradient, difference, known, weight, windows.sigma)
        offset -= sums.offset()
        np.clip(offset, -2.0 * windows.search, 2.0 * windows.search, out=offset)
    return _observations(atlas, placed, offset, sums, windows)


def _shifted(layout: np.ndarray, columns: np.ndarray, rows: np.ndarray, offset: np.ndarray) -> np.ndarray:
    return cv2.remap(layout, columns + offset[..., 0], rows + offset[..., 1], cv2.INTER_LINEAR)


def _gradient(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Central differences [h, w] along columns and rows."""
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
    return cv2.filter2D(image, cv2.CV_32F, kernel), cv2.filter2D(image, cv2.CV_32F, kernel.T)


@dataclass(frozen=True)
class _WindowSums:
    """Window means [h, w] of the weighted products of gradients and of gradients with differences, and others."""

    xx: np.ndarray
    xy: np.ndarray
    yy: np.ndarray
    x: np.ndarray
    y: np.ndarray
    cover: np.ndarray
    shown: np.ndarray
    squares: np.ndarray

    def offset(self) -> np.ndarray:
        """[h, w, 2] of the normal equations, damped a little where a window has no texture."""
        xx, yy = self.xx + 1.0, self.yy + 1.0
        determinant = xx * yy - self.xy * self.xy
        return np.stack([yy * self.x - self.xy * self.y, xx * self.y - self.xy * self.x], -1) / determinant[..., None]


def _window_sums(gradient, difference, known, weight, sigma) -> _WindowSums:
    width = _window_width(sigma)

    def mean(values):
        return cv2.stackBlur(values, (width, width))

    gx, gy = gradient
    wx, wy = weight * gx, weight * gy
    products = wx * gx, wx * gy, wy * gy, wx * difference, wy * difference, weight
    # outliers don't pull, but a window full of them says little: its variance counts them
    return _WindowSums(*(mean(values) for values in products), mean(known), mean(known * difference * difference))


def _window_width(sigma: float) -> int:
    return 2 * int(round(2.0 * sigma)) + 1


def _observations(atlas, placed, offset, sums, windows) -> tuple[np.ndarray, np.ndarray]:
    """The flow at the tracked texels, taken to the picture with its covariance."""
    at = atlas.rows, atlas.columns
    moved = offset[at]
    place = np.stack([atlas.columns, atlas.rows], axis=1).astype(np.float32) + moved
    across, down = np.float32([2, 0]), np.float32([0, 2])
    stretch = np.stack(
        [0.25 * (_lookup(placed.layout, place + d) - _lookup(placed.layout, place - d)) for d in (across, down)], -1
    )
    pixels = 0.56 * _window_width(windows.sigma) ** 2  # texels that a triangular window amounts to
    shown = sums.shown[at]
    variance = (sums.squares[at] + 1e-3) / np.maximum(shown, 1e-6)
    normal = np.stack([np.stack([sums.xx[at], sums.xy[at]], -1), np.stack([sums.xy[at], sums.yy[at]], -1)], -2)
    information = normal.astype(np.float64) * (pixels / variance)[:, None, None]
    good = (placed.shown[at] > 0) & (shown > LEAST_COVER) & (sums.cover[at] > LEAST_AGREEMENT * shown)
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
