"""Whether the camera stood still: corners of the background, followed through the clip beside the head's turns.

From one key frame to the next, corners outside the person are followed by optical flow, always against the key frame,
so that a still background cannot drift. What stands still while the head turns shows a still camera, even where
somebody walks past; where hardly anything stands still and most corners move alike, the camera moved. A plain wall has
no corners and says nothing.

References: [Shi1994] (corners); [Bouguet2000] (flow in pyramids); [Kalal2010] (forward-backward error).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from shared.geometry.transforms import similarity_from_points, vector_from_rotation

WIDTH_PX = 480
CORNERS, CORNER_DISTANCE_PX = 200, 9
LEAST_CONTRAST = 2.0
"""Root mean square gradient along a corner's weaker direction, code values per px: above compression's blocks."""
WINDOW = {"winSize": (21, 21), "maxLevel": 3}
BACKWARD_PX, STILL_PX = 1.0, 0.6
PERSON_MARGIN = 0.05
"""The person's mask grows by this share of its window before corners are looked for."""
FEWEST_CORNERS, FEWEST_SHARE = 10, 0.3
"""A stretch says nothing with fewer corners left at its end, or a smaller share of those it began with."""
FEWEST_STRETCHES = 4
MOVED_STILL_SHARE, ALIKE_SHARE = 0.25, 0.5
STOOD_STILL_SHARE, STOOD_TRAVEL = 0.5, 0.02
MOVED_TRAVEL, TRAVEL_PER_TURN = 0.05, 0.35
"""The camera moved if the background travels more than this share of the picture's width, and more than this much for
each radian of the head's turn (a carried camera: about 1.3, the focal length in widths)."""
LEAST_TURN_RAD = np.radians(5.0)
CORRELATED = 0.5
FEWEST_TO_CORRELATE = 8


@dataclass(frozen=True)
class Stretch:
    """From one key frame (position `start`) to the next (`end`): shift [2], the median motion of the background in
    widths of the picture; still: share of corners that stood still; alike: share that moved as the median does; turn
    [3]: rotation vector of the face, rad."""

    start: int
    end: int
    shift: np.ndarray
    still: float
    alike: float
    turn: np.ndarray


class BackgroundMotion:
    """Feed it the clip's frames in order: `follow` each of them, and `set_key` where the person's mask is known."""

    def __init__(self) -> None:
        self.stretches: list[Stretch] = []
        self._key: np.ndarray | None = None
        self._corners = self._places = np.zeros((0, 1, 2), np.float32)
        self._start, self._face = 0, None

    def follow(self, luma: np.ndarray) -> None:
        """The next frame, luma [H, W] uint8: where the key frame's corners are now."""
        if len(self._corners):
            guess = self._places.copy()
            places, found, _ = cv2.calcOpticalFlowPyrLK(self._key, _small(luma), self._corners, guess,
                                                        flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **WINDOW)
            self._places = np.where(found[..., None] > 0, places, self._places)

    def set_key(self, position: int, luma: np.ndarray, background: np.ndarray, face: np.ndarray) -> None:
        """Ends the stretch at this frame, which was followed already, and begins the next.

        background: bool [H, W], where no person is. face: landmarks [468, 3] px. luma [H, W] uint8.
        """
        small = _small(luma)
        if len(self._corners):
            self._end_stretch(position, small, face)
        mask = cv2.resize(background.astype(np.uint8), small.shape[::-1], interpolation=cv2.INTER_NEAREST)
        strength = cv2.cornerMinEigenVal(small.astype(np.float32), 7, ksize=3)  # four times the mean squared gradient
        mask[strength < 4.0 * LEAST_CONTRAST**2] = 0
        corners = cv2.goodFeaturesToTrack(small, CORNERS, 1e-4, CORNER_DISTANCE_PX, mask=mask, blockSize=7)
        self._corners = np.zeros((0, 1, 2), np.float32) if corners is None else corners
        self._places, self._key, self._start, self._face = self._corners.copy(), small, position, face

    def _end_stretch(self, position: int, small: np.ndarray, face: np.ndarray) -> None:
        back, found, _ = cv2.calcOpticalFlowPyrLK(small, self._key, self._places, self._corners.copy(),
                                                  flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **WINDOW)
        returned = (found[:, 0] > 0) & (np.linalg.norm(back - self._corners, axis=2)[:, 0] < BACKWARD_PX)
        if returned.sum() < max(FEWEST_CORNERS, FEWEST_SHARE * len(returned)):
            return
        motion = (self._places - self._corners)[returned, 0]
        length, middle = np.linalg.norm(motion, axis=1), np.median(motion, axis=0)
        near = np.linalg.norm(motion - middle, axis=1) < max(1.0, 0.4 * float(np.linalg.norm(middle)))
        _, turn, _ = similarity_from_points(self._face, face)
        self.stretches.append(Stretch(self._start, position, middle / small.shape[1], float((length < STILL_PX).mean()),
                                      float(near.mean()), vector_from_rotation(turn)))


def background_of(shape: tuple[int, int], person: np.ndarray, window: tuple[int, int, int, int]) -> np.ndarray:
    """bool [H, W]: where no person is. person: mask [h, w] in 0 .. 1 in the window x0, y0, x1, y1 around head and
    shoulders; below the window is the body."""
    x0, y0, x1, y1 = window
    reach = max(1, round(PERSON_MARGIN * (x1 - x0)))
    background = np.ones(shape, bool)
    background[y0:y1, x0:x1] = cv2.distanceTransform((person <= 0.3).astype(np.uint8), cv2.DIST_L2, 5) > reach
    background[y1:, x0:x1] = False
    return background


def _small(luma: np.ndarray) -> np.ndarray:
    scale = min(1.0, WIDTH_PX / luma.shape[1])
    return cv2.resize(luma, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else luma


def contradiction(stretches: list[Stretch], moves: str) -> str:
    """What contradicts `capture.moves` ("head" or "camera"), as a warning that says how to mend it; "" if nothing does.

    Stretches in which the face turns less than usual say little and are left out; a clip in which it turns less than 5
    degrees in all, or whose background shows too little, is believed.
    """
    if len(stretches) < FEWEST_STRETCHES:
        return ""
    turns, shifts = (np.stack([getattr(s, name) for s in stretches]) for name in ("turn", "shift"))
    turned = float(np.linalg.norm(np.diff(np.quantile(_summed(turns[:, :2]), (0.05, 0.95), axis=0), axis=0)))
    if turned < LEAST_TURN_RAD:
        return ""
    amount = np.linalg.norm(turns[:, :2], axis=1)
    telling = [s for s, large in zip(stretches, amount >= np.median(amount), strict=True) if large]
    still = float(np.median([s.still for s in telling]))
    moved = float(np.mean([s.still < MOVED_STILL_SHARE and s.alike > ALIKE_SHARE for s in telling]))
    standing = np.array([s.still >= MOVED_STILL_SHARE for s in stretches])
    travel = float(np.linalg.norm(np.ptp(_summed(np.where(standing[:, None], 0.0, shifts)), axis=0)))
    if moves == "head":
        if moved > 0.5 and travel > max(MOVED_TRAVEL, TRAVEL_PER_TURN * turned):
            return (f"the background moves by {travel:.0%} of the picture's width while the head turns, so the camera "
                    "moved: set capture.moves to camera if the head kept still, else film again from a tripod")
        return ""
    if still >= STOOD_STILL_SHARE and travel < STOOD_TRAVEL:
        return (f"the background stands still while the head turns by {np.degrees(turned):.0f} degrees, so the head "
                "moved: set capture.moves to head")
    if moved > 0.5 and len(stretches) >= FEWEST_TO_CORRELATE and _explained(turns[:, :2], shifts) < CORRELATED:
        return ("the head's turns do not follow the background's motion, so the head moved while the camera was "
                "carried around: film again with the head still, or the camera on a tripod (capture.moves: head)")
    return ""


def _summed(steps: np.ndarray) -> np.ndarray:
    """[S, K] -> [S + 1, K] places from 0."""
    return np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])


def _explained(turns: np.ndarray, shifts: np.ndarray) -> float:
    """Share of the variance of the head's direction over the clip that a linear function of the background's place
    explains, from turns and shifts [S, 2]. Both are summed first: noise of the landmarks then stays one frame's."""
    direction, place = (_summed(steps) - _summed(steps).mean(0) for steps in (turns, shifts))
    residual = direction - place @ np.linalg.lstsq(place, direction, rcond=None)[0]
    return 1.0 - float((residual**2).sum() / max((direction**2).sum(), 1e-12))
