"""What tracking looks at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from shared.tracking.tracks import local_contrast, unusable_pixels

DETAIL_SIGMA_PX = 1.2
"""The finest texture moves least with the light: it halves the pose error against a scale four times as wide."""


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
