"""From landmarks to poses that are good to a few tenths of a degree, on a subset of the frames.

Landmarks slide over the skin, but they fit a head and a pose to each frame. Dense flow between one frame and all
others, warped by what is known so far (first the landmarks' triangulation, then the fitted head), ties them rigidly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from shared.compute.parallel import shared_out
from shared.errors import InputError
from shared.geometry.mesh import normalised, vertex_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import camera_centres, project, rigid
from shared.tracking.bundle import BundleSolution, Tracks, adjust, place_points
from shared.tracking.fit_head import HeadFit, triangulate
from shared.tracking.head_model import HeadModel
from shared.tracking.motion_prior import MotionPrior
from shared.tracking.pnp import pose_from_points
from shared.tracking.tracked_clip import TrackedClip
from shared.tracking.tracks import (
    SurfaceGrid,
    dense_tracks,
    grid_from_landmarks,
    grid_from_mesh,
    points_on_grid,
    visible_vertices,
)

UNTRACKED_SEGMENTS = ("eyes", "eye_sockets", "inner_mouth", "neck", "scalp", "ears")
"""Not rigid with the skull, or hair: no tracks from there."""

LEAST_TRACKS = 30
"""A frame with fewer tracks has no reliable pose."""

LANDMARK_NOISE_PX, FLOW_NOISE_PX = 1.0, 0.1
LANDMARK_PRIOR_MM, FLOW_PRIOR_MM = 5.0, 2.5
LANDMARK_REACH = 0.08
"""Landmarks off by more than this share of the face's width don't count."""

SAME_VIEW = 0.02
"""Views that lie as near to each other as this share of the motion are the same: the first one serves. A head that
turns and comes back passes each view twice, and which of the two is nearer by a hair is chance."""

LOSS = 2.0
"""Cauchy scale in units of the noise."""


@dataclass(frozen=True)
class FlowSettings:
    """Dense flow: reference frames, tracks from each, width of the face in the flow's pictures, px."""

    references: int = 3
    tracks_per_reference: int = 1000
    warp_width_px: float = 320.0


@dataclass(frozen=True)
class Adjusted:
    """A bundle solution, the tracks that it explains, and which of the frames are reliable [F] bool.

    solution and tracks cover all frames; poses of unreliable ones are guesses.
    """

    solution: BundleSolution
    tracks: Tracks
    reliable: np.ndarray


def start_from_landmarks(
    clip: TrackedClip, model: HeadModel, given: np.ndarray | None = None
) -> tuple[BundleSolution, np.ndarray]:
    """Poses by robust PnP on the mean head's landmarks, then a bundle adjustment of the landmarks themselves.

    given [F, 4, 4]: poses to start from instead, with landmarks triangulated from them. -> solution over all 468
    points, and which frames have a pose [F] bool. InputError when fewer than three have.
    """
    if given is not None:
        points = triangulate(clip.landmarks_px, given, clip.intrinsics)
        error = project(points, given, clip.intrinsics)[0] - clip.landmarks_px
        return BundleSolution(given, points, error), np.ones(len(given), bool)
    points = known_landmarks(model, model.template)
    known = np.isfinite(points[:, 0])
    poses, posed = _posed(clip, points)
    points[~known] = triangulate(clip.landmarks_px[posed][:, ~known], poses[posed], clip.intrinsics)
    residuals = np.full(clip.landmarks_px.shape, np.nan)
    solution = adjust(
        Tracks.of_equal_noise(clip.landmarks_px[posed], LANDMARK_NOISE_PX),
        poses[posed],
        points,
        clip.intrinsics,
        loss_scale=LOSS,
        prior_mm=LANDMARK_PRIOR_MM,
    )
    poses[posed] = solution.camera_from_points
    residuals[posed] = solution.residuals_px
    return BundleSolution(poses, solution.points, residuals), posed


def landmark_poses(clip: TrackedClip, named: np.ndarray) -> list[np.ndarray | None]:
    """Each frame's pose [4, 4] by robust PnP on its landmarks, None where there is none in front of the camera.

    named [n, 3] of the 468 landmarks on the head, NaN where the model has none.
    """
    known, reach_px = np.isfinite(named[:, 0]), LANDMARK_REACH * clip.face_width_px
    poses = shared_out(
        lambda frame: pose_from_points(named[known], frame[known], clip.intrinsics, clip.size, reach_px),
        clip.landmarks_px,
    )
    return [pose if pose is not None and pose[2, 3] > 0 else None for pose in poses]


def known_landmarks(model: HeadModel, vertices: np.ndarray) -> np.ndarray:
    """[468, 3] landmarks on the head's vertices, NaN where the model has none or none that holds still."""
    known = (model.landmark_face >= 0) & (model.landmark_weight > 0)
    return np.where(known[:, None], model.landmarks(vertices), np.nan)


def _posed(clip: TrackedClip, named: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    poses = landmark_poses(clip, named)
    posed = np.array([pose is not None for pose in poses])
    if posed.sum() < 3:
        raise InputError(
            "the landmarks fit no head in this clip", got=f"{posed.sum()} frames with a pose", expected="3 or more"
        )
    have = np.nonzero(posed)[0]
    return np.stack([poses[have[np.argmin(np.abs(have - i))]] for i in range(len(poses))]), posed


def interpolate_poses(poses: np.ndarray, time_s: np.ndarray, wanted_s: np.ndarray) -> np.ndarray:
    """[K, 4, 4] at time_s [K] (rising) -> [F, 4, 4] at wanted_s [F]; beyond the ends the nearest."""
    if len(poses) == 1:
        return np.repeat(poses, len(wanted_s), axis=0)
    at = np.clip(wanted_s, time_s[0], time_s[-1])
    rotation = Slerp(time_s, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    return rigid(rotation, np.stack([np.interp(at, time_s, poses[:, k, 3]) for k in range(3)], axis=1))


def choose_references(camera_from_points: np.ndarray, count: int) -> list[int]:
    """Frames whose view directions cover the clip: the central one, then towards both ends of the principal motion."""
    directions = normalised(camera_centres(camera_from_points))
    mean = normalised(directions.mean(0))
    spread = directions - directions @ mean[:, None] * mean
    axes = np.linalg.svd(spread - spread.mean(0), full_matrices=False)[2][:2]
    axes *= np.sign(axes[[0, 1], np.abs(axes).argmax(1)])[:, None]  # their signs are the library's choice
    along = spread @ axes.T
    middle = np.median(along, axis=0)
    targets = [middle]
    for axis in (0, 1):
        for end in (along[:, axis].max(), along[:, axis].min()):
            target = middle.copy()
            target[axis] += 0.55 * (end - middle[axis])
            targets.append(target)
    distances = [np.linalg.norm(along - target, axis=1) for target in targets[:count]]
    reach = SAME_VIEW * np.ptp(along[:, 0])
    chosen = [int(np.argmax(distance <= distance.min() + reach)) for distance in distances]
    return list(dict.fromkeys(chosen))


def flow_over_landmarks(
    clip: TrackedClip, start: BundleSolution, posed: np.ndarray, settings: FlowSettings, progress: Callable
) -> Adjusted:
    """Dense flow over the landmarks' triangulation, from the frame that stands in the middle. posed [F] bool: frames
    that have a pose."""
    index = np.nonzero(posed)[0]
    reference = int(index[choose_references(start.camera_from_points[posed], 1)[0]])
    grid = grid_from_landmarks(clip.landmarks_px[reference], reference, _scale(clip, settings))
    tracks, where = dense_tracks(
        grid,
        clip.contrast,
        clip.unusable,
        clip.landmarks_px,
        np.repeat(posed[:, None], clip.landmarks_px.shape[1], axis=1),
        count=settings.tracks_per_reference,
        search_px=0.03 * clip.face_width_px,
        progress=lambda frames: progress(frames, "first tracks"),
    )
    observed = Tracks.of_equal_noise(tracks, 2.5 * FLOW_NOISE_PX)
    points = points_on_grid(grid, where, start.points)
    return solve_tracks(clip, observed, points, start.camera_from_points, 2.0 * FLOW_PRIOR_MM)


def flow_over_head(
    clip: TrackedClip,
    model: HeadModel,
    fit: HeadFit,
    last: Adjusted,
    settings: FlowSettings,
    progress: Callable,
) -> Adjusted:
    """Dense flow over the fitted head, from several reference frames. The result is in head space."""
    poses = fit.camera_from_head(last.solution.camera_from_points)
    scene = RayScene(fit.vertices, model.faces)
    positions, _ = project(fit.vertices, poses, clip.intrinsics)
    normals = vertex_normals(fit.vertices, model.faces)
    visible = np.stack([visible_vertices(scene, fit.vertices, normals, pose, 0.3) for pose in poses])
    visible[~last.reliable] = False
    candidates = np.nonzero(last.reliable)[0]
    tracks, points = [], []
    references = choose_references(poses[candidates], settings.references)
    for number, chosen in enumerate(references, start=1):
        label = f"tracks from view {number} of {len(references)}"
        grid = _grid_on_head(clip, model, scene, fit, poses, int(candidates[chosen]), settings)
        found, where = dense_tracks(
            grid,
            clip.contrast,
            clip.unusable,
            positions,
            visible,
            count=settings.tracks_per_reference,
            search_px=0.015 * clip.face_width_px + 1.0,
            progress=lambda frames, label=label: progress(frames, label),
        )
        tracks.append(found)
        points.append(points_on_grid(grid, where, fit.vertices))
    observed = Tracks.of_equal_noise(np.concatenate(tracks, axis=1), FLOW_NOISE_PX)
    return solve_tracks(clip, observed, np.concatenate(points), poses, FLOW_PRIOR_MM)


def trackable_faces(model: HeadModel) -> np.ndarray:
    """[F] bool: faces of the model that carry skin rigid with the skull."""
    return ~model.segment(*UNTRACKED_SEGMENTS)


def _grid_on_head(clip, model, scene, fit, poses, reference, settings) -> SurfaceGrid:
    usable = trackable_faces(model)
    pixels, _ = project(fit.vertices[np.unique(model.faces[usable])], poses[reference], clip.intrinsics)
    width, height = clip.size
    low = np.clip(np.floor(pixels.min(0)), 0, [width - 2, height - 2])
    high = np.clip(np.ceil(pixels.max(0)), low + 1, [width, height])
    box, scale = np.r_[low, high], _scale(clip, settings)
    return grid_from_mesh(scene, model.faces, usable, poses[reference], clip.intrinsics, box, reference, scale)


def _scale(clip: TrackedClip, settings: FlowSettings) -> float:
    return float(np.clip(settings.warp_width_px / clip.face_width_px, 0.5, 3.0))


def solve_tracks(clip: TrackedClip, tracks: Tracks, points: np.ndarray, poses: np.ndarray, prior_mm: float) -> Adjusted:
    """Bundle adjustment of the frames and tracks that have enough observations; the worst 15 % of tracks dropped.
    points [N, 3] mm."""
    tracks, points, reliable = enough_observations(tracks, points)
    solved = adjust_clip(clip, tracks.subset(reliable), poses[reliable], points, prior_mm)
    error = np.nanmedian(solved.error_px, axis=0)
    return spread_over_frames(solved, tracks, reliable, poses, error <= np.nanpercentile(error, 85))


def adjust_clip(
    clip: TrackedClip,
    tracks: Tracks,
    poses: np.ndarray,
    points: np.ndarray,
    prior_mm: float,
    loss_scale: float = LOSS,
    motion: MotionPrior | None = None,
) -> BundleSolution:
    """Bundle adjustment from poses [F, 4, 4] and points [N, 3] mm, of the points alone where the clip's poses are held;
    the rest as for bundle.adjust."""
    if clip.hold_poses:
        return place_points(tracks, poses, points, clip.intrinsics, loss_scale=loss_scale, prior_mm=prior_mm)
    return adjust(
        tracks, poses, points, clip.intrinsics, loss_scale=loss_scale, prior_mm=prior_mm, motion=motion
    )


def enough_observations(tracks: Tracks, points: np.ndarray) -> tuple[Tracks, np.ndarray, np.ndarray]:
    """Tracks seen in an eighth of the frames and in four, and which frames show LEAST_TRACKS of them; or InputError.
    points [N, 3] mm."""
    long_enough = tracks.seen.sum(0) >= max(4, 0.12 * len(tracks.pixels))
    tracks, points = tracks.subset(points=long_enough), points[long_enough]
    reliable = tracks.seen.sum(1) >= LEAST_TRACKS
    if reliable.sum() < 3 or len(points) < LEAST_TRACKS:
        raise InputError(
            "the skin could not be tracked through this clip",
            got=f"{len(points)} tracks, {reliable.sum()} frames with {LEAST_TRACKS} or more",
            expected="3 or more frames",
            hint="film sharper, larger or slower: the face should be 200 px wide or more and free of motion blur",
        )
    return tracks, points, reliable


def spread_over_frames(
    solved: BundleSolution, tracks: Tracks, reliable: np.ndarray, poses: np.ndarray, kept: np.ndarray
) -> Adjusted:
    """The solution of the reliable frames among all frames, with the kept points [N] bool only."""
    residuals = np.full((len(poses), int(kept.sum()), 2), np.nan)
    residuals[reliable] = solved.residuals_px[:, kept]
    every = np.array(poses, np.float64)
    every[reliable] = solved.camera_from_points
    solution = BundleSolution(every, solved.points[kept], residuals, solved.focal_gain)
    return Adjusted(solution, tracks.subset(points=kept), reliable)
