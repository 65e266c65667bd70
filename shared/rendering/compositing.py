"""A re-render over what the clip shows behind the head: its alpha, and a background without the old head's fringe.

Alpha is what both the head's surfaces and the person in the frame cover. Where thin strips of the one stick out over
the other, the outlines disagree, and the narrower one counts; a thick piece of the head beside the mask says that the
mask is wrong there. Below the head the person goes on and stays as filmed: there the re-render fades into the frame.
The background is the frame, but near the head's outline what lies beyond the person goes on below it, so that no pixel
that shows the old head in part is seen beside the new one.
Reference: [Porter1984] (premultiplied colours, over).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from shared.compute.smooth_step import smooth_step
from shared.imaging.color import encode_srgb
from shared.imaging.matte import BORDER_PX, blurred, continued, disc, person_matte, unsure_px
from shared.imaging.picture_detail import edge_width

STRIP_SHARE = 0.02
"""Of the picture's long side: what is narrower is a strip by which two outlines disagree; and over so much the
re-render fades into the frame where the person goes on."""
LEAST_AGREED = 0.8
"""Share of the head that lies on the person; with less the mask is another's, or of nothing."""
LARGEST_BLUR_PX = 2.0
"""Blur by more is motion, along some edges only, or no edge at all: alpha is not drawn after it."""
_HALF = 0.5
_NEARLY_NONE = 1e-3
"""Beside shares whose quotient is wanted: with both none it is 1."""


@dataclass(frozen=True, eq=False)
class HeadLayers:
    """What a re-render of a frame is laid over, and how. frame [H, W, 3]: linear; alpha [H, W]: of the re-render, in
    [0, 1]; patch [H, W, 4]: premultiplied colours and alpha of what covers the old head's fringe in the frame; agreed:
    share of the head that lies on the person, below LEAST_AGREED alpha is the head's alone and the patch empty."""

    frame: np.ndarray
    alpha: np.ndarray
    patch: np.ndarray
    agreed: float

    @property
    def background(self) -> np.ndarray:
        """[H, W, 3] linear: the patch over the frame."""
        return over(self.patch, self.frame)

    def premultiplied(self, render: np.ndarray) -> np.ndarray:
        """float32 [H, W, 4]: a re-render [H, W, 3] linear, not darkened where the head covers a pixel in part and 0
        beside it, times alpha, and alpha. Its outermost colours go on where the frame's blur carries them."""
        colours, alpha = continued(render, (render > 0.0).any(-1)), self.alpha[..., None]
        return np.concatenate([colours * alpha, alpha], axis=-1).astype(np.float32)

    def composite(self, render: np.ndarray) -> np.ndarray:
        """float32 [H, W, 3] linear: the re-render, as for premultiplied, over the background."""
        return over(self.premultiplied(render), self.background)


def over(layer: np.ndarray, below: np.ndarray) -> np.ndarray:
    """float32 [H, W, 3]: a layer [H, W, 4] of premultiplied colours and alpha over what is below [H, W, 3],
    [Porter1984]."""
    return (layer[..., :3] + (1.0 - layer[..., 3:]) * below).astype(np.float32)


def head_layers(frame: np.ndarray, person: np.ndarray, coverage: np.ndarray) -> HeadLayers:
    """Layers of a head in a frame [H, W, 3] linear, with the mask of its person [H, W] bool; coverage [H, W] in [0, 1]:
    how much of each pixel the head's surfaces cover, hair as far as its alpha lets it be seen."""
    head = coverage > _HALF
    agreed = float(person[head].mean()) if head.any() else 1.0
    if agreed < LEAST_AGREED:
        return HeadLayers(frame, coverage.astype(np.float32), np.zeros((*head.shape, 4), np.float32), agreed)
    strip = max(2, round(STRIP_SHARE * max(head.shape)))
    own = _closed(person | _thick(head & ~person, strip), unsure_px(head.shape))
    body = _thick(own & ~head, strip)
    inner = _from_background(own, strip)
    outline = np.minimum(blurred(coverage.astype(np.float32), _blur_px(frame, own, strip)), person_matte(frame, own))
    seam = _near(body, strip) * inner
    alpha = outline * (1.0 - seam)
    # Of what the re-render leaves open, the outline's share shows the background, and the seam's the frame.
    behind = (1.0 - outline + _NEARLY_NONE) / (1.0 - alpha + _NEARLY_NONE)
    # Loose hair beyond the mask is the old head's, too: a few pixels of background go with it.
    beyond = strip // 2 + 1
    fringe = _grown((coverage > 0.0) | (own & ~body & _grown(head, strip)), beyond) & ~_grown(body, strip // 2)
    share = (blurred(fringe.astype(np.float32), BORDER_PX) * (1.0 - inner) * behind)[..., None]
    patch = np.concatenate([share * continued(frame, ~_grown(own, beyond)), share], axis=-1).astype(np.float32)
    return HeadLayers(frame, alpha.astype(np.float32), patch, agreed)


def _blur_px(frame: np.ndarray, person: np.ndarray, strip: int) -> float:
    """Standard deviation of the blur of the frame's edges along the outline of a person [H, W] bool."""
    outline = _grown(person, strip) & _grown(~person, strip)
    codes = np.rint(255.0 * encode_srgb(np.clip(frame, 0.0, 1.0))).astype(np.uint8)
    return float(np.clip(np.nan_to_num(edge_width(codes, outline)), 0.0, LARGEST_BLUR_PX))


def _near(region: np.ndarray, strip: int) -> np.ndarray:
    """[H, W] in [0, 1]: 1 in a region [H, W] bool, 0 a strip's width away from it, without corners between."""
    if not region.any():
        return np.zeros(region.shape)
    return smooth_step(1.0 - distance_transform_edt(~region) / strip)


def _from_background(person: np.ndarray, strip: int) -> np.ndarray:
    """[H, W] in [0, 1]: 0 within a strip's width from where nobody is, 1 from two on."""
    if person.all():
        return np.ones(person.shape)
    return np.clip(distance_transform_edt(person) / strip - 1.0, 0.0, 1.0)


def _thick(region: np.ndarray, strip: int) -> np.ndarray:
    """The parts of a region [H, W] bool that a disc a strip wide fits into; it goes on beyond the picture."""
    wide = cv2.copyMakeBorder(region.astype(np.uint8), strip, strip, strip, strip, cv2.BORDER_REPLICATE)
    return cv2.morphologyEx(wide, cv2.MORPH_OPEN, disc(strip // 2))[strip:-strip, strip:-strip] > 0


def _closed(region: np.ndarray, reach: int) -> np.ndarray:
    """A region [H, W] bool without its holes and inlets up to 2 reach px wide."""
    return cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_CLOSE, disc(reach)) > 0


def _grown(region: np.ndarray, reach: int) -> np.ndarray:
    """A region [H, W] bool with what lies within reach px of it."""
    return cv2.dilate(region.astype(np.uint8), disc(reach)) > 0
