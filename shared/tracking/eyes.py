"""What a clip shows of the eyes: lids and gaze of each frame, and how sure they are, as records say it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from shared.capture.iris import SeenEyes
from shared.geometry.eyeballs import SIDES, eyeballs_of
from shared.geometry.surface import Surface
from shared.tracking.fit_lids import LidContours
from shared.tracking.gaze import CENTRE_SIGMA_MM, Gaze, iris_distance, solve_gaze
from shared.tracking.head_scale import BY_MODEL, HeadScale, scale_by_iris, scale_by_length
from shared.tracking.iris_texture import follow_irises, lay_on_rims
from shared.tracking.lid_openings import lid_openings
from shared.tracking.lids import Lids, closures, lids_of

FOLLOWED = 3
"""Times that irises are followed by their texture, and gaze and the eyeballs' centres solved from them anew."""


@dataclass(frozen=True)
class TrackedEyes:
    """gaze: None where too few frames show open eyes; openings: what the lids leave open of the eyeballs, in head
    space, None where pictures do not tell."""

    seen: SeenEyes
    lids: Lids
    gaze: Gaze | None
    openings: LidContours | None = None

    @property
    def pose_arrays(self) -> dict[str, np.ndarray]:
        """gaze and gaze_sigma [F, 2, 2] radians."""
        nowhere = np.full((len(self.lids.shut), 2, 2), np.nan)
        found = self.gaze
        return {"gaze": nowhere if found is None else found.gaze,
                "gaze_sigma": nowhere if found is None else found.sigma}

    @property
    def landmark_arrays(self) -> dict[str, np.ndarray]:
        """iris_px [F, 2, 5, 2], lids_px [F, 2, 16, 2], eye_openness [F, 2]."""
        return {"iris_px": self.seen.iris_px, "lids_px": self.seen.lids_px, "eye_openness": self.lids.openness}

    def record(self, frame_index: np.ndarray) -> dict:
        """For tracking.json; frame_index [F]."""
        shut = self.lids.shut
        said = {
            "blinks": [int(i) for i in frame_index[shut.all(1)]],
            **{f"shut_{name}": [int(i) for i in frame_index[shut[:, side]]] for side, name in enumerate(SIDES)},
            "open_mm": _rounded(self.lids.open_mm, 3),
        }
        if self.gaze is not None:
            said |= _gaze_record(self.gaze)
        return said


def _gaze_record(found: Gaze) -> dict:
    own_deg = np.degrees(np.nanmedian(found.own_sigma))
    return {
        "gaze": found.kind,
        "gaze_deviation_deg": round(float(np.degrees(np.nanmedian(found.sigma))), 3),
        "gaze_deviation_of_frame_deg": round(float(own_deg), 3),
        "centres_mm": [_rounded(centre, 3) for centre in found.centres],
        "centres_deviation_mm": [_rounded(deviation, 3) for deviation in found.centre_sigma],
        "iris_distance_mm": round(found.iris_distance_mm, 3),
        "iris_radius_mm": round(found.iris_radius_mm, 4),
        "iris_radius_deviation_mm": round(found.iris_radius_sigma_mm, 4),
        "iris_error_px": {
            "median": round(float(np.nanmedian(found.error_px)), 4),
            "p95": round(float(np.nanpercentile(found.error_px, 95)), 4),
        },
    }


def _rounded(values: np.ndarray, digits: int) -> list[float | None]:
    return [round(float(value), digits) if np.isfinite(value) else None for value in values]


def track_eyes(
    surface: Surface, seen: SeenEyes, camera_from_head: np.ndarray, intrinsics: np.ndarray, time_s: np.ndarray
) -> TrackedEyes | None:
    """Lids and gaze of the F frames in which the head has a pose; None where the mesh has no eyeballs. Where `seen` has
    pictures its irises are followed by their texture, and what is returned has these and no pictures.

    camera_from_head [F, 4, 4] mm; intrinsics [3, 3]; time_s [F].
    """
    eyeballs = eyeballs_of(surface)
    if eyeballs is None:
        return None
    centres = np.stack([ball.centre for ball in eyeballs])
    lids = lids_of(seen.lids_px, centres, camera_from_head, intrinsics)
    distance_mm = iris_distance(eyeballs)

    def solved(iris_px: np.ndarray) -> Gaze | None:
        return solve_gaze(iris_px, ~lids.shut, centres, distance_mm, camera_from_head, intrinsics, time_s)

    gaze = solved(seen.iris_px)
    if gaze is not None and seen.pictures:
        for _ in range(FOLLOWED):
            iris_px = follow_irises(seen, gaze.gaze, gaze.centres, gaze.iris_distance_mm, camera_from_head, intrinsics)
            seen = replace(seen, iris_px=iris_px)
            gaze = solved(iris_px)
        if np.isfinite(gaze.iris_radius_mm):
            iris_px = lay_on_rims(
                seen, gaze.gaze, gaze.centres, gaze.iris_distance_mm, gaze.iris_radius_mm, camera_from_head, intrinsics
            )
            seen = replace(seen, iris_px=iris_px)
            gaze = solved(iris_px)
    openings = None
    if gaze is not None and seen.pictures:
        openings = lid_openings(surface, seen, lids, gaze, camera_from_head, intrinsics)
    return TrackedEyes(replace(seen, pictures=()), lids, gaze, openings)


def lids_in_frames(landmarks: Mapping[str, np.ndarray], record: Mapping, frame_index: np.ndarray) -> np.ndarray | None:
    """How far each eye is shut, [F, 2] as closures has it, in frames frame_index [F] of those tracked; None where the
    eyes were not. landmarks: of landmarks.npz; record: tracking.json."""
    if "eye_openness" not in landmarks:
        return None
    said = record.get("eyes", {})
    shut = np.stack([np.isin(frame_index, said.get(f"shut_{name}", ())) for name in SIDES], axis=1)
    return closures(landmarks["eye_openness"][np.searchsorted(landmarks["frame_index"], frame_index)], shut)


def head_scale(surface: Surface, eyes: TrackedEyes | None, pupil_distance_mm: float | None) -> HeadScale:
    """The head's size: by the pupil_distance_mm where it is given, or else by irises and head model, or by the latter
    alone where no iris is seen. surface, eyes: under the size of the model."""
    found, eyeballs = None if eyes is None else eyes.gaze, eyeballs_of(surface)
    if pupil_distance_mm is not None and eyeballs is not None:
        if found is not None:
            return scale_by_length(pupil_distance_mm, found.centres, found.centre_sigma)
        centres = np.stack([ball.centre for ball in eyeballs])
        return scale_by_length(pupil_distance_mm, centres, np.tile(CENTRE_SIGMA_MM, (2, 1)))
    if found is None or not np.isfinite(found.iris_radius_mm):
        return BY_MODEL
    return scale_by_iris(found.iris_radius_mm, found.iris_radius_sigma_mm)
