"""What the tracking says of itself: frames that don't fit, numbers, and warnings that tell what to film instead."""

from __future__ import annotations

import numpy as np

from shared.geometry.transforms import rotation_range_deg
from shared.tracking.pose_uncertainty import FOCAL_DEVIATIONS, HELD_DEVIATIONS
from shared.tracking.track_head import HeadTrack

SMALL_ROTATION_DEG = 15.0
FOCAL_TOLERANCE = 0.03
HELD_TOLERANCE_DEG = 0.3
"""Poses of another tracker may differ from ours by so much: either may be the wrong ones."""
UNSURE_DEG = 0.5
"""Median deviation of the rotations: 0.2 to 0.4 in clips of a face 115 px high, less in larger ones."""
MOUTH_RATIO = 2.0
"""Tracks around the mouth that fit so many times worse than the rest mean talk or a smile that comes and goes."""

LEAST_OUTLIER_PX = 0.25


def frames_that_fit(track: HeadTrack, outlier_factor: float) -> tuple[np.ndarray, list[str]]:
    """Which of the tracked frames fit [U] bool, and why each of the others does not ('' where it fits).

    A frame whose median track error is outlier_factor times the clip's, and LEAST_OUTLIER_PX at least, does not.
    """
    error = np.full(len(track.reliable), np.nan)
    error[track.reliable] = np.nanmedian(track.error_px[track.reliable], axis=1)
    limit = max(outlier_factor * float(np.nanmedian(error)), LEAST_OUTLIER_PX)
    reasons = []
    for reliable, frame_error in zip(track.reliable, error, strict=True):
        if not reliable:
            reasons.append("too little skin could be tracked")
        elif not frame_error <= limit:
            reasons.append(f"track error {frame_error:.2f} px: blur, talk or a hand before the face")
        else:
            reasons.append("")
    return np.array([not reason for reason in reasons]), reasons


def rotation_deviation_deg(track: HeadTrack, fits: np.ndarray) -> np.ndarray:
    """Standard deviation of the rotation, in degrees, of each frame that fits [F] bool."""
    return np.degrees(np.sqrt(np.trace(track.covariance[fits][:, :3, :3], axis1=1, axis2=2)))


def mouth_ratio(track: HeadTrack, fits: np.ndarray, lips_head: np.ndarray) -> float:
    """Spread of the tracks near the lips [L, 3] over that of all others; 1 where too few are near. fits [F] bool:
    frames that fit; lips_head [L, 3] mm."""
    near = (np.abs(track.points_head[:, None] - lips_head[None]).max(-1).min(1)) < 12.0
    if near.sum() < 10 or (~near).sum() < 10:
        return 1.0
    spread = np.sqrt(np.nanmean(np.minimum(track.error_px[fits], 3.0) ** 2, axis=0))
    return float(np.nanmedian(spread[near]) / np.nanmedian(spread[~near]))


def warnings_of(
    track: HeadTrack, fits: np.ndarray, frame_count: int, focal_known: bool, lips_head: np.ndarray
) -> list[str]:
    """Everything that a person should know before the poses are used. fits [F] bool: frames that fit; lips_head [L,
    3] mm."""
    warnings = []
    turned = rotation_range_deg(track.camera_from_head[fits])
    if turned < SMALL_ROTATION_DEG:
        warnings.append(
            f"the view of the head changes by only {turned:.0f} degrees: depth rests on the head model; "
            "film a turn of 25 degrees to each side"
        )
    gain, deviation = track.focal_gain, track.focal_deviation
    if not focal_known:
        how = f"known to {100 * deviation:.1f} %" if track.focal_solved else "a guess: the clip does not determine it"
        warnings.append(f"the focal length is {how}; depth and scale follow it; give camera.focal_length_mm")
    elif abs(np.log(gain)) > max(FOCAL_DEVIATIONS * deviation, FOCAL_TOLERANCE):
        warnings.append(
            f"the tracks ask for a focal length {100 * (gain - 1):+.0f} % off the given one (deviation "
            f"{100 * deviation:.1f} %): check focal length and sensor width in subject.yaml, and digital zoom"
        )
    if track.held_off is not None:
        off_deg, known_deg = np.degrees(track.held_off)
        if off_deg > max(HELD_DEVIATIONS * known_deg, HELD_TOLERANCE_DEG):
            warnings.append(
                f"the poses given turn the head {off_deg:.1f} degrees otherwise than its skin moves (known to "
                f"{known_deg:.1f}): check them, or let them be refined (tracking.hold_poses: false)"
            )
    deviation = rotation_deviation_deg(track, fits)
    if np.median(deviation) > UNSURE_DEG:
        warnings.append(
            f"the head's rotation is known to {np.median(deviation):.1f} degrees only: too few pixels, blur, noise or "
            "compression hide how the skin moves; light and shape follow it"
        )
    ratio = mouth_ratio(track, fits, lips_head)
    if ratio > MOUTH_RATIO:
        warnings.append(
            f"the skin around the mouth moves {ratio:.1f} times as much as the rest: the expression changes; "
            "film a neutral face, lips closed, without talking"
        )
    missing = frame_count - int(fits.sum())
    if missing > 0.2 * frame_count:
        warnings.append(f"{missing} of {frame_count} frames do not fit and were left out")
    return warnings
