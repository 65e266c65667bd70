"""Faces followed through a clip: landmarks frame to frame, with a detection now and then to find, confirm and correct.

The landmark network takes its crop from its own last answer, which is faster and steadier than detecting each time and
holds on to a face in profile, where the detector lets go.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from shared.capture.framing import landmark_box
from shared.capture.landmarks import Detection, FaceNetworks, box_overlap

MIN_PRESENCE = 0.5
# A face just lost is looked for in every frame; with the costly search in small windows only where no face is in sight,
# and then now and then.
DETECT_EVERY, SEARCH_EVERY = 8, 16
MAX_FACES = 3
SAME_FACE_OVERLAP = 0.3
# How far a face may jump and still be the same: centre distance over box size.
SAME_FACE_REACH = 0.75


@dataclass
class FaceTrack:
    """One person, by position in the sequence of frames; `last` holds the landmarks while the face is in sight.

    observations: landmarks [468, 3] px. sharpness ([2]) and head_boxes ([4] px): what is measured there besides.
    """

    observations: dict[int, np.ndarray] = field(default_factory=dict)
    sharpness: dict[int, np.ndarray] = field(default_factory=dict)
    head_boxes: dict[int, np.ndarray] = field(default_factory=dict)
    last: np.ndarray | None = None

    @property
    def weight(self) -> float:
        """Sum over frames of the face's area, px^2: large faces that stay win."""
        return float(sum(np.prod(np.ptp(points[:, :2], axis=0)) for points in self.observations.values()))

    @property
    def last_box(self) -> np.ndarray:
        """[4] px: around the most recent landmarks."""
        return landmark_box(self.observations[max(self.observations)])


class FaceTracker:
    """Feed it frames in order; read `tracks` at the end."""

    def __init__(self, networks: FaceNetworks) -> None:
        self._networks = networks
        self._position = -1
        self._blind_frames = 0
        self.tracks: list[FaceTrack] = []

    def update(self, rgb: np.ndarray) -> FaceTrack | None:
        """Follow and find faces in the next frame, uint8 [H, W, 3]; returns the largest face in sight."""
        self._position += 1
        for track in self.tracks:
            if track.last is not None:
                self._observe(track, *self._networks.track(rgb, track.last))
        in_sight = [track for track in self.tracks if track.last is not None]
        just_lost = any(track.last is None and self._position - max(track.observations) <= SEARCH_EVERY
                        for track in self.tracks)
        if not in_sight or just_lost or self._position % DETECT_EVERY == 0:
            self._find(rgb, zoom=not in_sight and self._blind_frames % SEARCH_EVERY == 0)
        self._part_twins()
        in_sight = [track for track in self.tracks if track.last is not None]
        self._blind_frames = 0 if in_sight else self._blind_frames + 1
        return max(in_sight, key=lambda track: np.ptp(track.last[:, 1]), default=None)

    def skip(self) -> None:
        """Count a frame that is not looked at."""
        self._position += 1

    def _observe(self, track: FaceTrack, presence: float, points: np.ndarray) -> None:
        track.last = points if presence >= MIN_PRESENCE else None
        if track.last is not None:
            track.observations[self._position] = points

    def _find(self, rgb: np.ndarray, zoom: bool) -> None:
        for detection in self._networks.detect(rgb, zoom=zoom)[:MAX_FACES]:
            followed = any(track.last is not None and box_overlap(landmark_box(track.last), detection.box)
                           > SAME_FACE_OVERLAP for track in self.tracks)
            if not followed:
                presence, points = self._networks.landmarks(rgb, detection)
                if presence >= MIN_PRESENCE:
                    self._observe(self._known(detection), presence, points)

    def _known(self, detection: Detection) -> FaceTrack:
        """The track out of sight that was last seen about there, or a new one."""
        size, centre = _size(detection.box), _centre(detection.box)
        lost = [track for track in self.tracks if track.last is None]
        distances = [float(np.linalg.norm(_centre(track.last_box) - centre)) / size for track in lost]
        if distances and min(distances) < SAME_FACE_REACH:
            return lost[int(np.argmin(distances))]
        self.tracks.append(FaceTrack())
        return self.tracks[-1]

    def _part_twins(self) -> None:
        """Where two tracks have come to follow one face, the shorter one lets go."""
        in_sight = sorted((t for t in self.tracks if t.last is not None), key=lambda t: -len(t.observations))
        for i, track in enumerate(in_sight):
            box = landmark_box(track.last)
            if any(o.last is not None and box_overlap(landmark_box(o.last), box) > 0.5 for o in in_sight[:i]):
                del track.observations[self._position]
                track.last = None
        self.tracks = [track for track in self.tracks if track.observations]


def _centre(box: np.ndarray) -> np.ndarray:
    return (box[:2] + box[2:]) / 2


def _size(box: np.ndarray) -> float:
    return float(np.max(box[2:] - box[:2]))
