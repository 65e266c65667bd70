"""Where the face ends in a picture: the step of colour beside the occluding contour of cheeks, chin and jaw.

A person mask knows where the person ends; where a cheek ends before hair, or a chin above the neck, only the picture
does. Across the predicted outline the colours are read along its normal, and the place is sought where they differ most
on both sides, as far as those inside are still like those deeper in the face: an edge of the hair behind it, or of the
background, has another colour inside. A beard's edge is none: hair is darker than this face's skin.

The place itself is where a step between the means of both sides has the moments that the colours have, which for one
channel is [Tabatabai1984], section II with the first moment alone. A lens blurs light and not its codes, so the step is
found in codes and its place told in linear light.
"""

from __future__ import annotations

import numpy as np

from shared.imaging.color import LUMINANCE, decode_srgb
from shared.imaging.image_sampling import remap

SPACING_PX = 0.5
SIDE_PX, GAP_PX = 3.0, 0.75
"""Each side's mean is taken from GAP_PX to SIDE_PX from the step: pictures are blurred, and codecs spread what is near.
"""
LOCAL_PX = 1.5
"""The step's place is told from the colours so near."""
LEAST_CONTRAST, LEAST_CLEAR = 0.1, 3.0
"""A step counts from this difference of both sides' codes of 0..1 on, and from this multiple of their own variation, or
that deeper in the face, on: stubble and scars have edges, too."""
CODE_NOISE, SKIN_SPREAD = 0.01, 0.08
"""In sRGB codes: noise of a quiet picture; how far skin varies over some millimetres."""
LEAST_BRIGHT = 0.4
"""Of the bare skin's usual code: what is darker is hair, or in a shadow too deep to say."""


def face_edges(
    codes: np.ndarray,
    pixels: np.ndarray,
    outward: np.ndarray,
    reach_px: np.ndarray,
    skin: np.ndarray,
) -> np.ndarray:
    """How far along outward [n, 2] (unit) from pixels [n, 2] the face ends, px [n], NaN where no step is clear.

    codes [H, W, 3] float32: sRGB codes in 0..1, in which noise is alike in light and shade; reach_px [n]: how far in
    and out steps are sought; skin [3]: usual code of the face's bare skin in this picture.
    """
    farthest_px = float(reach_px.max())
    deepest = int(np.ceil((2.0 * farthest_px + SIDE_PX) / SPACING_PX)) + 1
    farthest = int(np.ceil((farthest_px + SIDE_PX) / SPACING_PX)) + 1
    along = SPACING_PX * np.arange(-deepest, farthest + 1)
    places = pixels[:, None] + along[None, :, None] * outward[:, None]
    colours = remap(codes, places.reshape(-1, 2)).reshape(len(pixels), len(along), 3).astype(np.float64)

    side, gap = round(SIDE_PX / SPACING_PX), round(GAP_PX / SPACING_PX)
    tried = np.nonzero(np.abs(along) <= farthest_px)[0]
    inner, inner_variance = _means(colours, tried - side, tried - gap)
    outer, outer_variance = _means(colours, tried + gap + 1, tried + side + 1)
    deeper = colours[:, (along > -2.0 * farthest_px) & (along < -farthest_px)]
    face, stubble = deeper.mean(1), deeper.var(1).sum(1)
    contrast = np.linalg.norm(outer - inner, axis=-1)
    local = (inner_variance + outer_variance) / 2.0
    variation = np.sqrt(np.maximum(local, stubble[:, None]) + CODE_NOISE**2)
    unlike = np.linalg.norm(inner - face[:, None], axis=-1) / SKIN_SPREAD
    clear = contrast / variation * np.exp(-0.5 * unlike**2)
    peak = np.zeros(clear.shape, bool)
    peak[:, 1:-1] = (clear[:, 1:-1] >= clear[:, :-2]) & (clear[:, 1:-1] >= clear[:, 2:])
    best = np.where(peak & (np.abs(along[tried]) <= reach_px[:, None]), clear, 0.0).argmax(1)

    each = np.arange(len(pixels))
    window = tried[best][:, None] + np.arange(-round(LOCAL_PX / SPACING_PX), round(LOCAL_PX / SPACING_PX) + 1)
    near, inside, outside = (decode_srgb(part) for part in (
        colours[each[:, None], window], inner[each, best], outer[each, best]))  # fmt: skip
    step = outside - inside
    share = np.einsum("nkc,nc->nk", near - inside[:, None], step) / np.maximum((step**2).sum(1), 1e-12)[:, None]
    share = np.clip(share, 0.0, 1.0)
    found = along[tried[best]] + (LOCAL_PX + SPACING_PX / 2.0) * (1.0 - 2.0 * share.mean(1))
    sure = peak[each, best] & (clear[each, best] > LEAST_CLEAR) & (contrast[each, best] > LEAST_CONTRAST)
    sure &= face @ LUMINANCE > LEAST_BRIGHT * (skin @ LUMINANCE)
    return np.where(sure, found, np.nan)


def _means(colours: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means [n, K, 3] of colours [n, T, 3] from first [K] to before last [K], and their variance, summed over the
    channels [n, K]."""
    sums, squares = (
        np.concatenate([np.zeros_like(colours[:, :1]), np.cumsum(values, axis=1)], axis=1)
        for values in (colours, colours**2)
    )
    count = (last - first)[None, :, None]
    mean, square = ((total[:, last] - total[:, first]) / count for total in (sums, squares))
    return mean, np.maximum(square - mean**2, 0.0).sum(-1)
