"""A first look at a clip, frame by frame in constant memory: whose face, how sharp, which frames to leave out, where
the head is. Frames come in as small 8-bit pictures; what stays of each is a few numbers and 468 landmarks.
"""

from __future__ import annotations

import cv2
import numpy as np

from shared.capture.background_motion import BackgroundMotion, background_of, contradiction
from shared.capture.face_tracker import FaceTrack, FaceTracker
from shared.capture.frame_quality import (
    PROXY_HEIGHT,
    PROXY_WIDTH,
    background_drift,
    find_duplicates,
    find_empty,
    find_shots,
    proxy,
    relative_sharpness,
    sharpness,
)
from shared.capture.framing import head_box, head_window, interpolate_offsets, landmark_box
from shared.capture.landmarks import FaceNetworks

OTHER_FACE_SHARE = 0.25
SAMPLES, MASKS_PER_SAMPLE = 6, 6
TURNED_BY_SCORE = 0.1


class ClipSurvey:
    """Feed it a clip's frames in order with `add`, then ask. Positions count the frames fed, from 0."""

    def __init__(self, networks: FaceNetworks, mask_every: int) -> None:
        """mask_every: the person mask, which shows the hair, is looked at in every so many frames."""
        self._networks = networks
        self._mask_every = mask_every
        self._tracker = FaceTracker(networks)
        self._motion = BackgroundMotion()
        self._last_luma: np.ndarray | None = None
        self._proxies: list[np.ndarray] = []
        self._difference: list[float] = []
        self._samples: list[np.ndarray] = []
        self.frame_index: list[int] = []
        self.time_s: list[float] = []
        self.faults: list[str] = []

    def add(self, frame_index: int, time_s: float, rgb: np.ndarray | None, fault: str = "") -> None:
        """The next frame: uint8 [H, W, 3] sRGB-encoded, of one size throughout; None where it cannot be used."""
        self.frame_index.append(frame_index)
        self.time_s.append(time_s)
        self.faults.append(fault)
        if rgb is None:
            self._tracker.skip()
            self._proxies.append(np.zeros((PROXY_HEIGHT, PROXY_WIDTH, 3), np.uint8))
            self._difference.append(np.nan)
            return
        luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        known = self._last_luma is not None
        self._difference.append(float(cv2.absdiff(luma, self._last_luma).mean()) if known else np.nan)
        self._last_luma = luma
        self._proxies.append(proxy(rgb))
        self._look_at_faces(rgb, luma)

    def _look_at_faces(self, rgb: np.ndarray, luma: np.ndarray) -> None:
        position = self.count - 1
        largest = self._tracker.update(rgb)
        for track in self._tracker.tracks:
            if track.last is not None:
                track.sharpness[position] = sharpness(luma, landmark_box(track.last))
        self._motion.follow(luma)
        if position % (self._mask_every * MASKS_PER_SAMPLE) == 0 and len(self._samples) < SAMPLES:
            self._samples.append(rgb)
        if largest is not None and (position % self._mask_every == 0 or not largest.head_boxes):
            x0, y0, x1, y1 = head_window(largest.last, rgb.shape[1], rgb.shape[0])
            mask = self._networks.person_mask(rgb[y0:y1, x0:x1])
            largest.head_boxes[position] = head_box(largest.last, mask, (x0, y0))
            background = background_of(luma.shape, mask, (x0, y0, x1, y1))
            self._motion.set_key(position, luma, background, largest.last)

    @property
    def count(self) -> int:
        """Number of frames fed so far."""
        return len(self.frame_index)

    @property
    def proxies(self) -> np.ndarray:
        """uint8 [N, 18, 32, 3]."""
        return np.stack(self._proxies)

    @property
    def main_face(self) -> FaceTrack | None:
        """The face that covers most area over the clip; None where there is none."""
        return max(self._tracker.tracks, key=lambda track: track.weight, default=None)

    @property
    def other_faces(self) -> int:
        """How many more people cover a quarter of the main face's area or more."""
        weights = sorted((track.weight for track in self._tracker.tracks), reverse=True)
        return sum(weight > OTHER_FACE_SHARE * weights[0] for weight in weights[1:])

    def quarter_turns(self) -> int:
        """How often the pictures must be turned by 90 degrees counter-clockwise for faces to be upright: 0 to 3.

        The networks find a face at any angle, yet with wrong features: the detector's score says which way is up
        (0.9 or more upright, 0.5 to 0.85 else).
        """
        turned = [[np.ascontiguousarray(np.rot90(rgb, turns)) for rgb in self._samples] for turns in range(4)]
        scores = [np.mean([max((d.score for d in self._networks.detect(rgb)), default=0.0) for rgb in pictures])
                  for pictures in turned]
        best = int(np.argmax(scores))
        return best if scores[best] > scores[0] + TURNED_BY_SCORE else 0

    def verdicts(self, blurred_below: float) -> tuple[list[str], np.ndarray]:
        """Per frame the reason to drop it ("" to keep it), and its sharpness relative to its neighbours [N].

        blurred_below: relative sharpness under which a frame counts as blurred. The shot that shows the main face
        longest stays, other shots go.
        """
        face = self.main_face
        seen = np.array([face is not None and i in face.observations for i in range(self.count)])
        sound = np.array([not fault for fault in self.faults]) & ~find_empty(self.proxies)
        shots = np.full(self.count, -1)
        shots[sound] = find_shots(self.proxies[sound])
        main_shot = np.bincount(shots[sound & seen]).argmax() if (sound & seen).any() else -1
        fine = np.full((self.count, 2), np.nan)
        for i in np.nonzero(seen & (shots == main_shot))[0]:
            fine[i] = face.sharpness[int(i)]
        relative = relative_sharpness(fine)
        repeats = find_duplicates(np.array(self._difference))
        reasons = [
            self.faults[i]
            or ("black, or all of one colour" if not sound[i] else "")
            or ("no face found" if not seen[i] else "")
            or ("outside the main shot" if shots[i] != main_shot else "")
            or ("repeats the frame before" if repeats[i] else "")
            or (f"blurred: {relative[i]:.2f} of its neighbours' sharpness" if relative[i] < blurred_below else "")
            for i in range(self.count)
        ]
        return reasons, relative

    def head_boxes(self, positions: np.ndarray) -> np.ndarray:
        """[N, 4] px: the whole head at positions where the main face was seen.

        Between the frames with a person mask, hair is taken to move with the face. positions [N] int: of the frames
        fed.
        """
        face = self.main_face
        faces = np.stack([landmark_box(face.observations[int(i)]) for i in positions])
        if not face.head_boxes:
            return np.stack([head_box(face.observations[int(i)]) for i in positions])
        known = np.array(sorted(face.head_boxes))
        offsets = np.stack([face.head_boxes[int(i)] - landmark_box(face.observations[int(i)]) for i in known])
        return faces + interpolate_offsets(positions, known, offsets)

    def motion_contradicts(self, moves: str, reasons: list[str]) -> str:
        """See background_motion.contradiction. reasons: of `verdicts`; frames that are damaged or show something else
        do not count."""
        sound = [not reason or reason.startswith(("blurred", "repeats")) for reason in reasons]
        return contradiction([s for s in self._motion.stretches if all(sound[s.start:s.end + 1])], moves)

    def background_drift(self, positions: np.ndarray, width: int, height: int) -> float:
        """See frame_quality.background_drift; background is what no head or body ever covers at `positions`.
        positions [N] int: of the frames fed."""
        still, face = np.ones((PROXY_HEIGHT, PROXY_WIDTH), bool), self.main_face
        for i in positions:
            x0, y0, x1, _ = head_window(face.observations[int(i)], width, height)
            left, right = int(x0 / width * PROXY_WIDTH), int(np.ceil(x1 / width * PROXY_WIDTH))
            still[int(y0 / height * PROXY_HEIGHT):, left:right] = False
        return background_drift(self.proxies[positions], still)
