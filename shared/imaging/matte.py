"""How much of each pixel a person covers, drawn from a mask without softness; and colours continued into where they are
not known.

Pixels beside the mask's border are mixtures of what lies on either side. What each side looks like there is known from
the pixels near by that are certainly of one side, as a mean and a spread; the share follows from the pixel's colour.
The mask counts as much as colours are spread: where both sides look alike, its border is what remains.
References: [Porter1984] (what a share means), [Chuang2001] (the likeliest share between two normal distributions; both
are taken as equally wide in all channels, which has a closed solution), [Gortler1996] (pull and push).
"""

from __future__ import annotations

import cv2
import numpy as np

UNSURE_SHARE = 0.005
"""Of the picture's long side: pixels this near to the mask's border may be mixtures, or on its wrong side."""
NEAR_PX = 2.0
"""Standard deviation of the weights of pixels that tell what a side looks like, beside what is unsure."""
BORDER_PX = 1.0
"""Standard deviation of a mask's border: how soft it is expected to be."""
TOGETHER = 10.0
"""How many neighbours deviate from their side's mean as one, so that their colours say less against the mask. On a
path-traced head: mean error of the share beside the outline 0.017 (root mean square 0.093) of the mask alone, 0.011
(0.060) with 1, 0.011 (0.052) with 10."""
NOISE = 1e-2
"""Of a camera's linear light: sides whose colours differ by less are told apart by the mask alone."""
_NOBODY = 1e-4
"""Sums of weights below it are none."""
_UNKNOWN_SPREAD = 1e6
"""Variance of a side of which no pixel is near: beside any that colours have, so that the mask decides."""


def unsure_px(size: tuple[int, int]) -> int:
    """How many pixels beside the border of a mask of this size may be of either side. size: height, width."""
    return max(2, round(UNSURE_SHARE * max(size)))


def person_matte(rgb: np.ndarray, person: np.ndarray) -> np.ndarray:
    """float32 [H, W] in [0, 1]: the share of each pixel that a person covers. rgb [H, W, 3]: linear; person [H, W]
    bool: the mask. Beyond unsure_px from the mask's border it is the mask."""
    reach = unsure_px(person.shape)
    mask = person.astype(np.uint8)
    inside = cv2.erode(mask, disc(reach), borderType=cv2.BORDER_REPLICATE) > 0
    outside = cv2.dilate(mask, disc(reach), borderType=cv2.BORDER_REPLICATE) == 0
    own, own_spread = _near_colours(rgb, inside, NEAR_PX + 0.5 * reach)
    other, other_spread = _near_colours(rgb, outside, NEAR_PX + 0.5 * reach)
    expected = blurred(mask.astype(np.float32), BORDER_PX)
    apart = own - other
    spread = TOGETHER * (expected * own_spread + (1.0 - expected) * other_spread) + NOISE**2
    share = (((rgb - other) * apart).sum(-1) + spread * expected) / ((apart**2).sum(-1) + spread)
    return np.where(inside, 1.0, np.where(outside, 0.0, np.clip(share, 0.0, 1.0))).astype(np.float32)


def continued(rgb: np.ndarray, known: np.ndarray) -> np.ndarray:
    """float32 [H, W, 3]: rgb where known [H, W] bool, and continued smoothly from there where it is not: means over
    squares twice as wide each, from the narrowest that hold something known ([Gortler1996]). Zero where nothing is."""
    weight = known.astype(np.float32)
    return _pulled(rgb.astype(np.float32) * weight[..., None], weight)


def _pulled(total: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Means [H, W, 3] of what is known, total [H, W, 3] over weight [H, W] in [0, 1]; where that is short of 1, the
    rest is those of the picture of half the size."""
    height, width = weight.shape
    mean = total / np.maximum(weight, _NOBODY)[..., None]
    if min(height, width) <= 1 or weight.min() >= 1.0:
        return mean
    half = (width + 1) // 2, (height + 1) // 2
    few, some = (cv2.resize(picture, half, interpolation=cv2.INTER_AREA) for picture in (total, weight))
    more = np.minimum(1.0, 4.0 * some)
    below = _pulled(few * (more / np.maximum(some, _NOBODY))[..., None], more)
    below = cv2.resize(below, (width, height), interpolation=cv2.INTER_LINEAR)
    return mean * weight[..., None] + below * (1.0 - weight)[..., None]


def _near_colours(rgb: np.ndarray, known: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean [H, W, 3] of the known pixels near each, and their variance [H, W], of one channel on average."""
    weight = known.astype(np.float32)
    total = blurred(weight, sigma)
    near = np.maximum(total, _NOBODY)
    mean = blurred(rgb * weight[..., None], sigma) / near[..., None]
    square = blurred((rgb**2).sum(-1) * weight, sigma) / near
    spread = np.maximum(square - (mean**2).sum(-1), 0.0) / 3.0
    return mean, np.where(total < _NOBODY, _UNKNOWN_SPREAD, spread)


def disc(reach: int) -> np.ndarray:
    """uint8 [2 reach + 1, 2 reach + 1]: 1 within reach px of the middle, to grow or shrink regions by."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)


def blurred(picture: np.ndarray, sigma: float) -> np.ndarray:
    """A picture [H, W] or [H, W, 3] float32 by a standard deviation sigma, px; it goes on beyond its edges."""
    return cv2.GaussianBlur(picture, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE) if sigma > 0.0 else picture
