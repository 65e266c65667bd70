"""Poses anew on the refined mesh: what tracking alone cannot know, since it follows the clip over a fitted head model.

A texel that lies a little off the skin slides over it as the head turns, so that the mean texture is blurred and the
tracks against it are drawn by what lies beside: a shadow's edge, a highlight. On the mesh that shading and parallax
have refined the same tracks hold still. All frames are tracked against their mean texture on it and adjusted as one
rigid head under the motion prior, until they rest, and kept where tracks kept aside fit better. That the poses are
adjusted as a whole, outside the descent, keeps them from taking up what light and texture leave over, as poses inside
one do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.compute.run_context import RunContext
from shared.geometry.surface import Surface
from shared.inverse.clip_inputs import TrackedPoses
from shared.tracking.bundle import Tracks, resect
from shared.tracking.first_poses import LOSS, UNTRACKED_SEGMENTS, Adjusted
from shared.tracking.pose_uncertainty import estimate_uncertainty, rotations_apart
from shared.tracking.texture_tracking import AtlasTracker, TrackingPass, solve_texture
from shared.tracking.texture_tracks import Windows
from shared.tracking.track_head import HELD_OUT_EVERY, held_out_px
from shared.tracking.tracked_clip import TrackedClip

WORTHWHILE, AT_REST = 0.5, 0.1
"""Poses that the first round turns by less than half of their standard deviation were right before: 0.3 was measured
in soft light, where nothing is gained, and 0.7 under a hard lamp. A round that turns them by less than a tenth is the
last."""

FINE = TrackingPass(texel_px=1.0, detail=True, count=2500, windows=Windows(sigma=5.0), prior_mm=10.0)


@dataclass(frozen=True, eq=False)
class RepeatedPoses:
    """camera_from_head [F, 4, 4] mm with covariance [F, 6, 6], and what the rounds did; where these did not serve, the
    poses as they were."""

    camera_from_head: np.ndarray
    covariance: np.ndarray
    record: dict

    @property
    def serves(self) -> bool:
        """Have the poses turned by what matters, and do tracks kept aside fit better?"""
        return self.record["kept"]


def repeat_poses(
    tracked: TrackedPoses, surface: Surface, camera_from_head: np.ndarray, rounds: int, context: RunContext
) -> RepeatedPoses:
    """Tracks a clip again on a surface refined since; camera_from_head [F, 4, 4] mm: its poses; rounds: at most."""
    clip, covariance = tracked.look(), tracked.covariance
    deviation = _rotation_deviation(covariance)
    begun, steps = camera_from_head, []
    for _ in range(rounds):
        found, aside = _track_again(clip, surface, camera_from_head, context)
        poses = found.solution.camera_from_points
        steps.append(_rms(rotations_apart(poses[:, :3, :3], camera_from_head[:, :3, :3])))
        camera_from_head = poses
        if steps[0] < WORTHWHILE * deviation or steps[-1] < AT_REST * deviation:
            break
    moved = _rms(rotations_apart(camera_from_head[:, :3, :3], begun[:, :3, :3]))
    before, after = (held_out_px(clip, aside, poses) for poses in (begun, camera_from_head))
    record = {"rounds_deg": [round(float(np.degrees(step)), 5) for step in steps],
              "turned_deg": round(float(np.degrees(moved)), 5),
              "held_out_px": {"before": round(before, 4), "after": round(after, 4)},
              "kept": bool(after < before and steps[0] >= WORTHWHILE * deviation)}
    context.note(f"poses on the refined mesh: {record}")
    if not record["kept"]:
        return RepeatedPoses(begun, covariance, record)
    estimated = estimate_uncertainty(clip, found, FINE.prior_mm, estimate_focal=False)
    context.note(f"poses on the refined mesh: noise factor {estimated.noise_factor:.2f}")
    solution, reliable = estimated.adjusted.solution, estimated.adjusted.reliable
    kept = np.where(reliable[:, None, None], estimated.covariance, covariance)
    return RepeatedPoses(solution.camera_from_points, kept, record)


def _track_again(
    clip: TrackedClip, surface: Surface, poses: np.ndarray, context: RunContext
) -> tuple[Adjusted, tuple[Tracks, np.ndarray]]:
    """One round from poses [F, 4, 4] -> the adjustment, and tracks kept aside with their points."""
    frames, depth = np.arange(clip.count), float(np.median(poses[:, 2, 3]))
    tracker = AtlasTracker(clip, surface.mesh, ~surface.faces_of(UNTRACKED_SEGMENTS), depth, FINE)
    tracks = tracker.track(tracker.mean(frames, poses, context.progress), frames, poses, context.progress)
    points, resected = tracker.atlas.points(surface.mesh.vertices), poses
    for loss in (15.0, 5.0):
        resected, _ = resect(tracks, resected, points, clip.intrinsics, loss_scale=loss * LOSS)
    aside = np.arange(len(points)) % HELD_OUT_EVERY == HELD_OUT_EVERY // 2
    found = solve_texture(clip, tracks.subset(points=~aside), points[~aside], resected, FINE.prior_mm)
    return found, (tracks.subset(points=aside), points[aside])


def _rms(vectors: np.ndarray) -> float:
    """Root of the mean squared length of vectors [F, 3]."""
    return float(np.sqrt((vectors**2).sum(1).mean()))


def _rotation_deviation(covariance: np.ndarray) -> float:
    """rms standard deviation of the rotations, radians; covariance [F, 6, 6]."""
    return float(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2).mean()))
