"""Irises and lids in a picture: five points of each iris, sixteen of the lids' margins.

The network is MediaPipe's Iris (Apache-2.0), run through OpenCV's dnn module. It sees a square between the eye's
corners, turned level and 2.3 times as wide as they are apart, as MediaPipe's graph cuts it out; it was made for one
eye, so that the other is mirrored.

Reference: [Ablavatski2020].
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from shared.capture.landmarks import EYE_CORNERS_LEFT, EYE_CORNERS_RIGHT, crop_under, load_network, run_network

EYE_SIZE = 64
EYE_ENLARGEMENT = 2.3
LEAST_WIDTH_PX = 6.0
"""Between the corners of an eye: what is seen from so far to the side, or so small, shows no iris."""
BESIDE_LIDS_PX = 8
"""Kept of the picture around an eye's lids."""

CONTOUR_COUNT, LID_COUNT = 71, 16
LOWER_LID, UPPER_LID = tuple(range(9)), (0, 9, 10, 11, 12, 13, 14, 15, 8)
"""Positions among the points of the lids, each from the outer to the inner corner; both lids end in the corners."""

FACE_MESH_LIDS = (
    (33, 7, 163, 144, 145, 153, 154, 155, 133, 246, 161, 160, 159, 158, 157, 173),
    (263, 249, 390, 373, 374, 380, 381, 382, 362, 466, 388, 387, 386, 385, 384, 398),
)
"""The same points among the 468 landmarks of the face, of the right and the left eye."""


class EyePicture(NamedTuple):
    """grey [h, w] uint8 of what lies about an eye's lids; corner [2] px: where it begins in the picture."""

    grey: np.ndarray
    corner: np.ndarray

    @classmethod
    def of(cls, rgb: np.ndarray, lids_px: np.ndarray) -> EyePicture:
        """Cut from rgb [H, W, 3] uint8 about lids_px [16, 2] px."""
        height, width = rgb.shape[:2]
        first = np.clip(np.floor(lids_px.min(0)).astype(int) - BESIDE_LIDS_PX, 0, (width - 1, height - 1))
        last = np.clip(np.ceil(lids_px.max(0)).astype(int) + BESIDE_LIDS_PX, first + 1, (width, height))
        cut = np.ascontiguousarray(rgb[first[1] : last[1], first[0] : last[0]])
        return cls(cv2.cvtColor(cut, cv2.COLOR_RGB2GRAY), first)


class EyePoints(NamedTuple):
    """iris [5, 2] px: centre, then the rim towards the inner corner, above, towards the outer corner and below; lids
    [16, 2] px, see LOWER_LID and UPPER_LID. Pixel centres at +0.5. picture: of the eye."""

    iris: np.ndarray
    lids: np.ndarray
    picture: EyePicture


@dataclass(frozen=True)
class SeenEyes:
    """iris_px [F, 2, 5, 2] and lids_px [F, 2, 16, 2] px of the right and left eye, see EyePoints; NaN where an eye is
    not seen. pictures [F][2]: of both eyes, None there; empty where nobody needs them any more."""

    iris_px: np.ndarray
    lids_px: np.ndarray
    pictures: tuple[tuple[EyePicture | None, EyePicture | None], ...]

    @classmethod
    def of(cls, frames: list[tuple[EyePoints | None, EyePoints | None] | None]) -> SeenEyes:
        """From what the network says of each frame; None where the frame shows no face."""
        iris_px, lids_px = np.full((len(frames), 2, 5, 2), np.nan), np.full((len(frames), 2, 16, 2), np.nan)
        pictures = []
        for f, eyes in enumerate(frames):
            eyes = eyes or (None, None)
            for side, eye in enumerate(eyes):
                if eye is not None:
                    iris_px[f, side], lids_px[f, side] = eye.iris, eye.lids
            pictures.append(tuple(None if eye is None else eye.picture for eye in eyes))
        return cls(iris_px, lids_px, tuple(pictures))

    def subset(self, frames: np.ndarray) -> SeenEyes:
        """Chosen frames [K], indices."""
        return SeenEyes(self.iris_px[frames], self.lids_px[frames], tuple(self.pictures[f] for f in frames))


class IrisNetwork:
    """The network, loaded once; pictures are uint8 [H, W, 3] RGB, points are px with centres at +0.5."""

    def __init__(self, path: Path) -> None:
        """Load the .tflite file; InputError where OpenCV cannot read it."""
        self._network = load_network(path)

    def eyes(self, rgb: np.ndarray, landmarks_px: np.ndarray) -> tuple[EyePoints | None, EyePoints | None]:
        """The subject's right and left eye, each None where the face hides it; landmarks_px [468, >=2] px of the
        face."""
        right, left = (landmarks_px[list(corners), :2] for corners in (EYE_CORNERS_RIGHT, EYE_CORNERS_LEFT))
        return self.eye(rgb, right), self.eye(rgb, left, left=True)

    def eye(self, rgb: np.ndarray, corners: np.ndarray, left: bool = False) -> EyePoints | None:
        """Points of the eye with the corners [2, 2] px, outer then inner; None where they are hardly apart. left: of
        the subject."""
        image_from_crop = crop_of_eye(corners, left)
        if image_from_crop is None:
            return None
        crop = crop_under(rgb, image_from_crop, EYE_SIZE)
        iris, contours = run_network(self._network, crop, (15, 3 * CONTOUR_COUNT))
        points = np.concatenate([iris.reshape(5, 3), contours.reshape(CONTOUR_COUNT, 3)[:LID_COUNT]])[:, :2]
        points = points.astype(np.float64) @ image_from_crop[:, :2].T + image_from_crop[:, 2]
        return EyePoints(points[:5], points[5:], EyePicture.of(rgb, points[5:]))


def crop_of_eye(corners: np.ndarray, left: bool = False) -> np.ndarray | None:
    """Affine map [2, 3] from the 64 px crop to the picture, px: the crop's +x runs from the outer to the inner corner
    [2, 2], as it does in a right eye, its +y down the face: a left eye is mirrored. None where the corners are hardly
    apart. corners [2, 2] px: outer, then inner; left: of the subject."""
    inward = corners[1] - corners[0]
    width = float(np.hypot(*inward))
    if not width >= LEAST_WIDTH_PX:
        return None
    down = np.array([-inward[1], inward[0]]) * (-1.0 if left else 1.0)
    linear = np.column_stack([inward, down]) * (EYE_ENLARGEMENT / EYE_SIZE)
    return np.column_stack([linear, corners.mean(0) - linear @ np.full(2, EYE_SIZE / 2)])
