"""How much detail the pictures of a face hold: how wide the sharpest edges are, how much of the light is noise, and how
far apart its tones are.

All are absolute, unlike the sharpness in frame_quality, which tells a clip's worse frames from its better ones: a clip
that is out of focus throughout is even.
"""

from __future__ import annotations

import cv2
import numpy as np

from shared.imaging.color import LUMINANCE, decode_srgb

SOFTENED_PX = (1.0, 2.3)
"""Two blurs that edges are seen through: the first is above most noise."""
EDGE_PERCENTILE = 99.3
_RIPPLE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
"""Sees neither slopes nor edges that run straight; white noise of deviation 1 gives deviation 6."""
_MEDIAN_OF_NORMAL = 0.6745
LOOKED_AT = 24
SOFT_EDGES_PX, LEAST_DETAIL_PX = 1.9, 100.0
"""Edges wider than this are not those of a sharp picture; a face of so many px is small even where it is sharp."""
SMEARED = 1.7
"""Edges of a clip's worst tenth that are so many times wider than usual were smeared by a motion. Heads that turn
before a fast shutter measure 1.1 to 1.35."""
FLAT_TONES = 0.5
"""Code value of a face's darkest hundredth over its median. Under sRGB faces measure 0.05 to 0.46, one stop too bright
or in even light, too; a logarithmic curve lifts pupils and nostrils to more."""
MOST_NOISE = 0.12
"""Clips of good cameras have 0.005 to 0.03, one of 256 colours 0.04."""


def edge_width(rgb: np.ndarray, inside: np.ndarray) -> float:
    """Standard deviation, px, of the blur of the sharpest edges inside bool [H, W]; the softer of the two directions.

    rgb: uint8 [H, W, 3] sRGB. An edge blurred by w and then by s has slopes in proportion to 1 / sqrt(w^2 + s^2). The
    ratio of those under two s, at the steepest places, is a function of w alone. NaN where too little is inside.
    """
    if np.count_nonzero(inside) < 100:
        return float("nan")
    luma = (rgb @ LUMINANCE).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(luma, (0, 0), s) for s in SOFTENED_PX)
    inner, widths = inside[:-1, :-1], []
    for axis in (0, 1):
        slopes = [np.abs(np.diff(luma, axis=axis))[:len(inner), :inner.shape[1]][inner] for luma in (fine, coarse)]
        steep, softened = (max(float(np.percentile(slope, EDGE_PERCENTILE)), 1e-6) for slope in slopes)
        share = min(softened / steep, 0.999) ** 2
        squared = (share * SOFTENED_PX[1] ** 2 - SOFTENED_PX[0] ** 2) / (1.0 - share)
        widths.append(np.sqrt(max(squared, 0.0)))
    return float(max(widths))


def noise_share(rgb: np.ndarray, inside: np.ndarray) -> float:
    """Standard deviation of the noise inside bool [H, W], as a share of the light there.

    rgb: uint8 [H, W, 3] sRGB; both are taken in linear light. NaN where too little is inside. Reference:
    [Immerkaer1996], with a median in place of the mean, which leaves out what is drawn.
    """
    if np.count_nonzero(inside) < 100:
        return float("nan")
    light = (decode_srgb(rgb / np.float32(255)) @ LUMINANCE).astype(np.float32)
    ripple = np.median(np.abs(cv2.filter2D(light, -1, _RIPPLE))[inside]) / (6.0 * _MEDIAN_OF_NORMAL)
    return float(ripple / max(float(np.median(light[inside])), 1e-6))


def flatness(rgb: np.ndarray, inside: np.ndarray) -> float:
    """Code value of the darkest hundredth over the median, inside bool [H, W]. rgb: uint8 [H, W, 3] sRGB. NaN where too
    little is inside."""
    if np.count_nonzero(inside) < 100:
        return float("nan")
    dark, usual = np.percentile(rgb[inside] @ LUMINANCE, (1.0, 50.0))
    return float(dark / max(usual, 1.0))


class ClipDetail:
    """Looks at some frames of a clip, then tells what is wrong with all of them."""

    def __init__(self, count: int) -> None:
        """count: frames there will be."""
        self._every = max(1, count // LOOKED_AT)
        self._seen: list[tuple[float, float, float, float]] = []

    def look(self, number: int, rgb: np.ndarray, inside: np.ndarray, height_px: float) -> None:
        """Frame `number`: uint8 [H, W, 3] sRGB, the face's skin, inside [H, W] bool, and the face's height, px."""
        if number % self._every == 0:
            self._seen.append((edge_width(rgb, inside), noise_share(rgb, inside), flatness(rgb, inside), height_px))

    def warnings(self) -> list[str]:
        """What makes the whole clip poor; sentences for people."""
        seen = np.array([row for row in self._seen if np.isfinite(row).all()])
        if not len(seen):
            return []
        width, noise, flat, height = np.median(seen, axis=0)
        smeared, found = float(np.percentile(seen[:, 0], 90.0)), []
        if width > SOFT_EDGES_PX and height / width < LEAST_DETAIL_PX:
            found.append(f"the face is blurred: its sharpest edges are {width:.1f} px wide, so it shows the detail of "
                         f"a sharp face {height / width:.0f} px high; check focus and shutter")
        elif smeared > max(SOFT_EDGES_PX, SMEARED * width) and height / smeared < LEAST_DETAIL_PX:
            found.append(f"a tenth of the frames are blurred by motion: edges are {smeared:.1f} px wide and more, "
                         f"{width:.1f} px in the median; turn more slowly, with a shorter exposure")
        if flat > FLAT_TONES:
            found.append(f"the face's darkest parts have {flat:.0%} of its usual code values: footage with a "
                         "logarithmic transfer function, or glare; convert it to the stated one")
        if noise > MOST_NOISE:
            found.append(f"noise is {noise:.0%} of the face's light: too dark, or a high ISO; film with more light")
        return found
