"""What tracking looks at.

Loads nothing but OpenCV and numpy: frames are looked at while the solver's libraries are still being loaded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

DETAIL_SIGMA_PX = 1.2
"""The finest texture moves least with the light: it halves the pose error against a scale four times as wide."""


CRUSHED_CODE, CLIPPED_CODE = 8, 250
"""8-bit code values at and beyond which a pixel says nothing of the skin's texture."""


def local_contrast(grey: np.ndarray, sigma_px: float, spread_px: float, floor: float) -> np.ndarray:
    """Log image minus its local mean over its local spread: [H, W] uint8 -> [H, W] uint8, 128 is the mean.

    sigma_px and spread_px: reach of the mean and of the spread; floor: spread of log radiance below which is noise.
    """
    log = np.log(np.arange(256) + 8.0).astype(np.float32)[grey]  # of doubles: single ones differ by the processor
    detail = log - cv2.GaussianBlur(log, (0, 0), sigma_px)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), spread_px)) + floor
    return np.clip(np.rint(detail / spread * 45.0 + 128.0), 0, 255).astype(np.uint8)


def unusable_pixels(rgb: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8 -> [H, W] uint8, 1 where a channel is clipped or all are crushed, grown by two pixels."""
    red, green, blue = cv2.split(rgb)
    brightest = cv2.max(cv2.max(red, green), blue)
    bad = (brightest >= CLIPPED_CODE) | (brightest <= CRUSHED_CODE)
    return cv2.dilate(bad.astype(np.uint8), np.ones((5, 5), np.uint8))


@dataclass(frozen=True)
class TrackedClip:
    """F frames: contrast and detail pictures [H, W] uint8, unusable pixels, landmarks [F, 468, 2] px, time [F] s.

    intrinsics [3, 3] and size (width, height) belong to the pictures. given_poses [F, 4, 4]: where to start instead of
    the landmarks; hold_poses: keep them as they are.
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

    @property
    def count(self) -> int:
        """F"""
        return len(self.contrast)

    def subset(self, frames: np.ndarray) -> TrackedClip:
        """Chosen frames [K], indices."""
        given = None if self.given_poses is None else self.given_poses[frames]
        pictures = {name: [getattr(self, name)[i] for i in frames] for name in ("contrast", "detail", "unusable")}
        return replace(
            self,
            landmarks_px=self.landmarks_px[frames],
            time_s=self.time_s[frames],
            given_poses=given,
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
    """What the pictures of a frame are made of: grey [H, W] uint8, and 1 where a pixel says nothing, [H, W] uint8."""

    grey: np.ndarray
    unusable: np.ndarray

    @classmethod
    def of(cls, rgb: np.ndarray, background: np.ndarray) -> GreyFrame:
        """From [H, W, 3] uint8 and background [H, W] bool."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        return cls(grey, unusable_pixels(rgb) | background.astype(np.uint8))

    def contrast(self, face_width_px: float) -> tuple[np.ndarray, np.ndarray]:
        """The wide contrast of the skin and its finest detail, [H, W] uint8 each."""
        sigma = float(np.clip(face_width_px / 55.0, 2.5, 12.0))
        wide = local_contrast(self.grey, sigma, 1.5 * sigma, 0.02)
        return wide, local_contrast(self.grey, DETAIL_SIGMA_PX, 2.25 * DETAIL_SIGMA_PX, 0.05)
