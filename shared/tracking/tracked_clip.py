"""What tracking looks at.

Loads nothing but OpenCV and numpy: frames are looked at while the solver's libraries are still being loaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import cv2
import numpy as np

DETAIL_SIGMA_PX = 1.2
"""The finest texture moves least with the light: it halves the pose error against a scale four times as wide."""


CRUSHED_CODE, CLIPPED_CODE = 8, 250
"""8-bit code values at and beyond which a pixel says nothing of the skin's texture."""

GREEN_AND_BLUE = 0.84, 0.16
"""Their shares of brightness where red is left out."""

SPOILT_SHARE = 0.05
"""Grey contrast with so much clipped red in its window shows the border of what is clipped, which the light moves."""


def local_contrast(grey: np.ndarray, sigma_px: float, spread_px: float, floor: float) -> np.ndarray:
    """Log image minus its local mean over its local spread: [H, W] uint8 -> [H, W] uint8, 128 is the mean.

    sigma_px and spread_px: reach of the mean and of the spread; floor: spread of log radiance below which is noise.
    """
    log = np.log(np.arange(256) + 8.0).astype(np.float32)[grey]  # of doubles: single ones differ by the processor
    detail = log - cv2.GaussianBlur(log, (0, 0), sigma_px)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), spread_px)) + floor
    return np.clip(np.rint(detail / spread * 45.0 + 128.0), 0, 255).astype(np.uint8)


def unusable_pixels(channels: Sequence[np.ndarray]) -> np.ndarray:
    """Channels [H, W] uint8 each -> [H, W] uint8, 1 where one is clipped or all are crushed, grown by two pixels."""
    brightest = reduce(cv2.max, channels)
    bad = (brightest >= CLIPPED_CODE) | (brightest <= CRUSHED_CODE)
    return cv2.dilate(bad.astype(np.uint8), np.ones((5, 5), np.uint8))


@dataclass(frozen=True)
class TrackedClip:
    """F frames: contrast and detail pictures [H, W] uint8, unusable pixels, landmarks [F, 468, 2] px, time [F] s.

    intrinsics [3, 3] and size (width, height) belong to the pictures. given_poses [F, 4, 4]: where to start instead of
    the landmarks; hold_poses: keep them as they are. lids_px [F, 2, 16, 2] px (shared.capture.iris), None where nobody
    looked for eyes.
    """

    contrast: list[np.ndarray]
    detail: list[np.ndarray]
    unusable: list[np.ndarray]
    landmarks_px: np.ndarray
    time_s: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    given_poses: np.ndarray | None = None
    hold_poses: bool = False
    lids_px: np.ndarray | None = None

    @property
    def count(self) -> int:
        """F"""
        return len(self.contrast)

    def subset(self, frames: np.ndarray) -> TrackedClip:
        """Chosen frames [K], indices."""
        given = None if self.given_poses is None else self.given_poses[frames]
        lids = None if self.lids_px is None else self.lids_px[frames]
        pictures = {name: [getattr(self, name)[i] for i in frames] for name in ("contrast", "detail", "unusable")}
        return replace(
            self,
            landmarks_px=self.landmarks_px[frames],
            time_s=self.time_s[frames],
            given_poses=given,
            lids_px=lids,
            **pictures,
        )

    @property
    def face_width_px(self) -> float:
        """Median width of the landmarks' box."""
        return face_width(self.landmarks_px)


def face_width(landmarks_px: np.ndarray) -> float:
    """Median width of the box around landmarks [F, 468, 2], px."""
    return float(np.median(np.ptp(landmarks_px[..., 0], axis=1)))


@dataclass(frozen=True)
class GreyFrame:
    """What the pictures of a frame are made of: grey [H, W] uint8, and 1 where a pixel says nothing, [H, W] uint8.

    Skin's red burns out first, and with it what could be tracked. Where red alone is clipped, and as far around as
    a window reaches, green and blue stand in: cool [H, W] uint8 is their mixture, red_clipped [H, W] bool where red
    alone is clipped; None where it is nowhere.
    """

    grey: np.ndarray
    unusable: np.ndarray
    cool: np.ndarray | None = None
    red_clipped: np.ndarray | None = None

    @classmethod
    def of(cls, rgb: np.ndarray, background: np.ndarray) -> GreyFrame:
        """From [H, W, 3] uint8 and background [H, W] bool."""
        grey, (red, green, blue) = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), cv2.split(rgb)
        unusable = unusable_pixels((red, green, blue))
        still_unusable = unusable_pixels((green, blue))
        red_clipped = (unusable > still_unusable) & ~background
        if not red_clipped.any():
            return cls(grey, unusable | background.astype(np.uint8))
        cool = cv2.addWeighted(green, GREEN_AND_BLUE[0], blue, GREEN_AND_BLUE[1], 0.0)
        unusable[red_clipped] = 0
        return cls(grey, unusable | background.astype(np.uint8), cool, red_clipped)

    def contrast(self, face_width_px: float) -> tuple[np.ndarray, np.ndarray]:
        """The wide contrast of the skin and its finest detail, [H, W] uint8 each."""
        sigma = float(np.clip(face_width_px / 55.0, 2.5, 12.0))
        return self._contrast(sigma, 1.5 * sigma, 0.02), self.detail()

    def detail(self) -> np.ndarray:
        """The skin's finest detail alone, [H, W] uint8."""
        return self._contrast(DETAIL_SIGMA_PX, 2.25 * DETAIL_SIGMA_PX, 0.05)

    def _contrast(self, sigma_px: float, spread_px: float, floor: float) -> np.ndarray:
        """Local contrast, of green and blue where clipped red reaches into the window."""
        picture = local_contrast(self.grey, sigma_px, spread_px, floor)
        if self.cool is not None:
            clipped_share = cv2.GaussianBlur(self.red_clipped.astype(np.float32), (0, 0), spread_px)
            spoilt = self.red_clipped | (clipped_share > SPOILT_SHARE)
            np.copyto(picture, local_contrast(self.cool, sigma_px, spread_px, floor), where=spoilt)
        return picture
