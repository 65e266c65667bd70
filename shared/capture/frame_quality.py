"""Which frames of a clip are worth using: sharpness, duplicates, empty frames, shots, and an even choice in time.

Everything is judged against the frame's own neighbours, never against a fixed level: how sharp a good frame is depends
on the face, the lens and the codec, but it hardly changes from one good frame to the next.
"""

from __future__ import annotations

import cv2
import numpy as np

from shared.imaging.color import LUMINANCE, decode_srgb

PROXY_WIDTH, PROXY_HEIGHT = 32, 18
NEIGHBOURS = 7
# Fine detail is read between these two blurs (standard deviations in px): above single-pixel noise.
FINE_PX, COARSE_PX = 0.8, 1.6
DUPLICATE_SHARE, DUPLICATE_CODES = 0.15, 0.02
CUT_CORRELATION = 0.7
CUT_RATIO, CUT_CODES = 8.0, 6.0
BLACK_CODE, FLAT_CODES = 12.0, 2.0


def sharpness(luma: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Energy of the fine detail inside a box, [2]: across (x) and down (y), squared code values per px.

    luma: uint8 [H, W]. box: [4] = x0, y0, x1, y1 px. Zeros for a box outside the picture. Motion blur takes one of
    the two away and leaves the other: 3 px of it leave 0.5, 5 px 0.2, 9 px 0.1 of the energy along the motion.
    """
    height, width = luma.shape
    x0, y0, x1, y1 = np.rint(np.clip(box, 0, (width, height, width, height))).astype(int)
    if x1 - x0 < 4 or y1 - y0 < 4:
        return np.zeros(2)
    part = luma[y0:y1, x0:x1].astype(np.float32)
    fine = cv2.GaussianBlur(part, (0, 0), FINE_PX) - cv2.GaussianBlur(part, (0, 0), COARSE_PX)
    return np.array([np.mean(np.square(np.diff(fine, axis=axis))) for axis in (1, 0)], float)


def proxy(rgb: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3] -> uint8 [18, 32, 3]: enough to recognise a shot, small enough to keep for every frame."""
    return cv2.resize(rgb, (PROXY_WIDTH, PROXY_HEIGHT), interpolation=cv2.INTER_AREA)


def background_drift(proxies: np.ndarray, background: np.ndarray) -> float:
    """How far the brightness of what stands still wanders over the clip, relative to its median; 0 is perfect.

    proxies: uint8 [N, 18, 32, 3], sRGB-encoded. background: bool [18, 32]. Spread from the 5th to the 95th
    percentile of linear luminance; NaN where less than a twentieth of the picture is background.
    """
    if np.count_nonzero(background) < background.size / 20:
        return float("nan")
    luminance = (decode_srgb(proxies[:, background] / 255.0) @ LUMINANCE).mean(axis=1)
    low, middle, high = np.quantile(luminance, (0.05, 0.5, 0.95))
    return float((high - low) / max(middle, 1e-4))


def local_median(values: np.ndarray) -> np.ndarray:
    """[N] -> [N]: median over each value and its NEIGHBOURS on both sides; NaN counts as absent."""
    padded = np.pad(np.asarray(values, float), NEIGHBOURS, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1)
    known = np.isfinite(windows).any(axis=1)
    medians = np.full(len(windows), np.nan)
    medians[known] = np.nanmedian(windows[known], axis=1)
    return medians


def relative_sharpness(energies: np.ndarray) -> np.ndarray:
    """[N, 2] (NaN: unknown) -> [N]: each over its neighbourhood's median, the lesser of the two directions.

    1 is as sharp as the neighbours. Good frames stay above 0.75, at 256 colours or hard compression above 0.5.
    """
    usual = np.stack([local_median(column) for column in energies.T], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(usual > 0, energies / usual, 1.0).min(axis=1)


def find_duplicates(difference: np.ndarray) -> np.ndarray:
    """bool [N]: frames that repeat the one before.

    difference: [N] mean absolute difference from the frame before in code values, NaN for the first. A repeated
    frame differs far less than its neighbours do, even where the encoder wrote it again.
    """
    limit = np.fmax(DUPLICATE_CODES, DUPLICATE_SHARE * local_median(difference))
    return np.isfinite(difference) & (difference < limit)


def find_empty(proxies: np.ndarray) -> np.ndarray:
    """bool [N]: black frames and frames of a single colour. proxies: uint8 [N, 18, 32, 3]."""
    pixels = proxies.reshape(len(proxies), -1, 3).astype(np.float32)
    return (pixels.max(axis=(1, 2)) < BLACK_CODE) | (pixels.std(axis=1).max(axis=1) < FLAT_CODES)


def find_shots(proxies: np.ndarray) -> np.ndarray:
    """int [N]: number of the shot that each frame belongs to, from 0 in the order of appearance.

    proxies: uint8 [N, 18, 32, 3]. A new shot starts where the picture stops resembling the frame before. A shot that
    resembles the last frame of an earlier one continues it: a few alien frames in between do not split a clip.
    """
    shots = np.zeros(len(proxies), int)
    change = _changes(proxies)
    usual = np.fmax(local_median(change), 1e-6)
    last_of_shot = {0: 0}
    for i in range(1, len(proxies)):
        shots[i] = shots[i - 1]
        jump = change[i] > max(CUT_RATIO * usual[i], CUT_CODES)
        if jump or not _alike(proxies[i - 1], proxies[i]):
            seen = (shot for shot, last in last_of_shot.items() if shot != shots[i - 1])
            near = (shot for shot in seen if _same_picture(proxies[last_of_shot[shot]], proxies[i], usual[i]))
            shots[i] = next(near, len(last_of_shot))
        last_of_shot[shots[i]] = i
    return shots


def _changes(proxies: np.ndarray) -> np.ndarray:
    """[N] mean absolute difference of each proxy from the one before; NaN for the first."""
    steps = np.abs(np.diff(proxies.astype(np.float32), axis=0)).mean(axis=(1, 2, 3))
    return np.concatenate([[np.nan], steps])


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two proxies correlate as neighbouring frames of one shot do."""
    a, b = (p.astype(np.float32).ravel() - p.mean() for p in (a, b))
    return float(a @ b) >= CUT_CORRELATION * float(np.linalg.norm(a) * np.linalg.norm(b))


def _same_picture(a: np.ndarray, b: np.ndarray, usual: float) -> bool:
    """Whether two proxies, some frames apart, show one shot: alike, and no further apart than a cut's threshold."""
    difference = float(np.abs(a.astype(np.float32) - b.astype(np.float32)).mean())
    return difference <= max(CUT_RATIO * usual, CUT_CODES) and _alike(a, b)


def spread_evenly(time_s: np.ndarray, score: np.ndarray, count: int) -> np.ndarray:
    """int [<= count]: rising indices of frames spread evenly in time, in each stretch the one of the best score.

    time_s: [N] rising. score: [N] relative sharpness. The clip is cut into `count` stretches of equal length; the
    score counts less towards a stretch's ends, so that the spacing stays even where all are equally sharp.
    """
    total = len(time_s)
    if total <= count:
        return np.arange(total)
    length = (time_s[-1] - time_s[0]) / (count - 1)
    place = (time_s - time_s[0]) / length + 0.5
    stretch = np.minimum(place.astype(int), count - 1)
    off_centre = np.abs(place - stretch - 0.5)
    rank = np.minimum(score, 1.2) - 0.3 * off_centre
    order = np.lexsort((np.arange(total), -rank, stretch))
    first = np.concatenate([[True], np.diff(stretch[order]) > 0])
    return np.sort(order[first])
