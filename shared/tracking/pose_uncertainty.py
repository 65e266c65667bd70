"""The poses' uncertainty: the last adjustment with its measured noise, its covariance, and the focal length.

Errors of neighbouring tracks go along with each other, so that counting tracks flatters the poses. Two halves of the
face, in patches like a chessboard, are solved for themselves: how far they disagree, against what their own covariances
promise, gives the factor by which all noise is larger.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shared.compute.parallel import shared_out
from shared.geometry.transforms import nearest_rotation, turns_from_mean, vector_from_rotation
from shared.tracking.bundle import BundleSolution, Tracks, adjust, pose_covariance, zoomed
from shared.tracking.first_poses import LOSS, Adjusted, adjust_clip
from shared.tracking.focal_search import PRIOR_MM, farther, look_elsewhere
from shared.tracking.motion_prior import motion_prior_of
from shared.tracking.tracked_clip import TrackedClip

LEAST_HALF = 10

PATCHES_MM = (40.0, 70.0)
"""Edges of the chessboard's fields; small ones see no error that a whole cheek shares."""

SHARED_ERRORS = 2.0
"""What both halves of the face get wrong together (shading, the codec), over what they disagree in: measured on
synthesised clips, 1.3 to 2.0, the largest under a hard lamp."""

SHADING_SLIP = 0.002
"""Shading slides over the skin as the head turns, for all tracks alike: error of a rotation as a share of the turn,
which more frames don't lessen. Measured on synthesised clips: 0.001 to 0.004."""

LARGEST_FOCAL_DEVIATION = 0.05
FOCAL_DEVIATIONS = 3.0
HELD_DEVIATIONS = 3.0
"""Held poses that the tracks contradict by so many deviations are doubted."""

CHI_SQUARED_MEDIAN_3 = 2.366


@dataclass(frozen=True)
class EstimatedPoses:
    """The last solution of the reliable frames: covariance [F, 6, 6] (NaN elsewhere), noise_factor, the lens's check.

    focal_gain and focal_deviation: solved over given, had it been left free, and the logarithm's standard deviation;
    focal_solved: the poses belong to the solved one. held_off: of poses that were held, rms angle by which the tracks
    turn the head otherwise, and what that is known to, radians; None: none were held.
    """

    adjusted: Adjusted
    covariance: np.ndarray
    noise_factor: float
    focal_gain: float
    focal_deviation: float
    focal_solved: bool
    held_off: tuple[float, float] | None = None


def noise_factor(tracks: Tracks, solution: BundleSolution, intrinsics: np.ndarray, prior_mm: float) -> float:
    """By how much the whitening overstates what the tracks know of the poses: at least 1.

    Two halves of the face give two whole solutions, points and all. Median over frames of the squared Mahalanobis
    distance between their rotations, over that of unit noise; the largest over several ways to halve. Frames that show
    too little of either half stay aside.
    """

    def half_solved(half: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        shown, chosen = half
        poses, points = solution.camera_from_points[shown], solution.points[chosen]
        solved = adjust(tracks.subset(shown, chosen), poses, points, intrinsics, loss_scale=LOSS, prior_mm=prior_mm)
        return solved.camera_from_points[:, :3, :3]

    covariance = pose_covariance(solution, tracks, intrinsics, loss_scale=LOSS).poses[:, :3, :3]
    halves = []
    for patch_mm in PATCHES_MM:
        odd = np.floor(solution.points / patch_mm).astype(int).sum(1) % 2 == 1
        shown = np.minimum(tracks.seen[:, odd].sum(1), tracks.seen[:, ~odd].sum(1)) >= LEAST_HALF
        if shown.sum() >= 3:
            halves += [(shown, odd), (shown, ~odd)]
    solved = shared_out(half_solved, halves)
    ratios = [1.0]
    for (shown, _), first, second in zip(halves[::2], solved[::2], solved[1::2], strict=True):
        apart = rotations_apart(first, second)
        distance = np.einsum("fi,fi->f", apart, np.linalg.solve(4.0 * covariance[shown], apart[..., None])[..., 0])
        ratios.append(float(np.sqrt(np.median(distance) / CHI_SQUARED_MEDIAN_3)))
    return max(ratios)


def rotations_apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Rotation vectors [F, 3] (camera axes) between rotations [F, 3, 3], but for a common turn of the head. first
    [F, 3, 3], second [F, 3, 3]."""
    common = nearest_rotation(np.einsum("fji,fjk->ik", second, first))
    return vector_from_rotation(first @ np.swapaxes(second @ common, 1, 2))


def focal_elsewhere(clip: TrackedClip, flow: Adjusted) -> tuple[float, float] | None:
    """Another lens that the dense flow clearly asks for, not near the given one: its gain and its log's deviation.

    The deviation is such that the given lens is as many away as the root of the fall of the cost says.
    """
    shown, solution = flow.reliable, flow.solution
    poses = solution.camera_from_points[shown]
    other = look_elsewhere(flow.tracks.subset(shown), poses, solution.points, clip.intrinsics, LOSS)
    if other is None:
        return None
    lens = zoomed(clip.intrinsics, other.gain)
    factor = SHARED_ERRORS * noise_factor(other.tracks, other.solution, lens, PRIOR_MM)
    deviations = np.sqrt(other.advantage) / factor
    return None if deviations < FOCAL_DEVIATIONS else (other.gain, float(abs(np.log(other.gain)) / deviations))


def estimate_uncertainty(
    clip: TrackedClip,
    last: Adjusted,
    prior_mm: float,
    estimate_focal: bool,
    elsewhere: tuple[float, float] | None = None,
) -> EstimatedPoses:
    """The last adjustment, with noise as measured and the motion prior, and its covariance.

    estimate_focal: the focal length is a guess, so that the solved one is taken over where the clip determines it.
    elsewhere: see focal_elsewhere; the tracks are then solved under that lens, where they alone would stay near theirs.
    """
    shown, solution = last.reliable, last.solution
    poses, time_s = solution.camera_from_points[shown], clip.time_s[shown]
    tracks = last.tracks.subset(shown)
    start = BundleSolution(poses, solution.points, solution.residuals_px[shown])
    factor = SHARED_ERRORS * noise_factor(tracks, start, clip.intrinsics, prior_mm)
    tracks, loss = tracks.with_noise(factor), LOSS / factor
    motion = motion_prior_of(poses, time_s)
    lens, points = clip.intrinsics, solution.points

    def held_lens() -> BundleSolution:
        return adjust_clip(clip, tracks, poses, points, prior_mm, loss, motion=motion)

    def free_lens() -> BundleSolution:
        if elsewhere is None:
            return adjust(
                tracks, poses, points, lens, loss_scale=loss, prior_mm=prior_mm, motion=motion, refine_focal=True
            )
        gain, away = elsewhere[0], farther(poses, points, elsewhere[0])
        free = adjust(tracks, away, points, zoomed(lens, gain), loss_scale=loss, prior_mm=PRIOR_MM, motion=motion)
        return replace(free, focal_gain=gain)

    solved, free = shared_out(lambda solve: solve(), (held_lens, free_lens))
    uncertain = pose_covariance(free, tracks, lens, loss_scale=loss, motion=motion, with_focal=True)
    if elsewhere is not None:
        uncertain = replace(uncertain, log_focal=elsewhere[1])
    solve_focal = estimate_focal and not clip.hold_poses and uncertain.log_focal < LARGEST_FOCAL_DEVIATION
    solved = free if solve_focal else solved
    known = uncertain if solve_focal else pose_covariance(solved, tracks, lens, loss_scale=loss, motion=motion)
    covariance = np.full((len(shown), 6, 6), np.nan)
    covariance[shown] = known.poses
    turn = turns_from_mean(solved.camera_from_points[:, :3, :3])
    covariance[shown, :3, :3] += SHADING_SLIP**2 * turn[:, :, None] * turn[:, None, :]
    apart = rotations_apart(solved.camera_from_points[:, :3, :3], free.camera_from_points[:, :3, :3])
    held_off = None
    if clip.hold_poses:
        known_to = np.trace(uncertain.poses[:, :3, :3], axis1=1, axis2=2)
        held_off = float(np.sqrt((apart**2).sum(1).mean())), float(np.sqrt(known_to.mean()))
    lens_is_off = not solve_focal and abs(np.log(free.focal_gain)) > FOCAL_DEVIATIONS * uncertain.log_focal
    if lens_is_off or held_off and held_off[0] > HELD_DEVIATIONS * held_off[1]:
        # the tracks contradict the lens or the poses: these are as uncertain as the two answers are apart
        covariance[shown, :3, :3] += apart[:, :, None] * apart[:, None, :]
    every = np.array(solution.camera_from_points)
    every[shown] = solved.camera_from_points
    residuals = np.full(solution.residuals_px.shape, np.nan)
    residuals[shown] = solved.residuals_px
    final = Adjusted(BundleSolution(every, solved.points, residuals, solved.focal_gain), last.tracks, shown)
    return EstimatedPoses(final, covariance, factor, free.focal_gain, uncertain.log_focal, solve_focal, held_off)
