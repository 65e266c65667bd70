"""From landmarks to poses that hold still: landmark start, dense tracks in passes, bundle adjustment, head fit.

Each pass warps all frames by what the last one found (first the landmarks' triangulation, then the fitted head), tracks
the skin densely from a few reference frames, adjusts poses and points as one rigid body, and fits the head again. The
search narrows from pass to pass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from shared.bundle import BundleSolution, adjust, pose_covariance, pose_from_points
from shared.errors import InputError
from shared.geometry import camera_centres, project
from shared.head_model import HeadModel
from shared.mesh import normalised, vertex_normals
from shared.raycast import RayScene
from shared.solve.fit_head import FitWeights, HeadFit, fit_codes, fit_surface, landmarks_on_points, triangulate
from shared.tracks import (
    SurfaceGrid,
    dense_tracks,
    grid_from_landmarks,
    grid_from_mesh,
    points_on_grid,
    visible_vertices,
)

UNTRACKED_SEGMENTS = ("eyes", "eye_sockets", "inner_mouth", "neck", "scalp", "ears")
"""Not rigid with the skull, or hair: no tracks from there."""

LANDMARK_FRAMES = 15
"""Landmarks are taken from so many frames around the middle of the motion."""

LEAST_TRACKS = 30
"""A frame with fewer tracks has no reliable pose."""


@dataclass(frozen=True)
class TrackSettings:
    """passes after the first; references per pass; tracks per reference; sizes in pixels and millimetres."""

    passes: int = 2
    references: int = 3
    tracks_per_reference: int = 1500
    warp_width_px: float = 480.0
    loss_scale_px: float = 0.2
    prior_mm: float = 5.0
    fit: FitWeights = field(default_factory=FitWeights)


@dataclass(frozen=True)
class Clip:
    """What tracking looks at: F contrast images, F masks of unusable pixels, landmarks [F, 468, 2] px, the lens."""

    contrast: list[np.ndarray]
    unusable: list[np.ndarray]
    landmarks_px: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]

    @property
    def face_width_px(self) -> float:
        """Median width of the landmarks' box."""
        return float(np.median(np.ptp(self.landmarks_px[..., 0], axis=1)))


@dataclass(frozen=True)
class HeadTrack:
    """The result: poses [F, 4, 4] and covariance [F, 6, 6] of all F frames given, the fitted head, the track points.

    error_px [F, N]: reprojection error of each track point, NaN where not seen; reliable [F]: enough tracks.
    """

    camera_from_head: np.ndarray
    covariance: np.ndarray
    fit: HeadFit
    points_head: np.ndarray
    error_px: np.ndarray
    reliable: np.ndarray


def start_from_landmarks(clip: Clip, model: HeadModel) -> tuple[BundleSolution, np.ndarray]:
    """Poses by robust PnP on the mean head's landmarks, then a bundle adjustment of the landmarks themselves.

    -> solution over all 468 points, and which frames have a pose [F] bool. InputError when fewer than three have.
    """
    known = (model.landmark_face >= 0) & (model.landmark_weight > 0)
    named = model.landmarks(model.template)
    poses = [
        pose_from_points(named[known], frame[known], clip.intrinsics, clip.size, 0.08 * clip.face_width_px)
        for frame in clip.landmarks_px
    ]
    posed = np.array([pose is not None and pose[2, 3] > 0 for pose in poses])
    if posed.sum() < 3:
        raise InputError(
            "the landmarks fit no head in this clip", got=f"{posed.sum()} frames with a pose", expected="3 or more"
        )
    poses = _filled(poses, posed)
    points = np.where(known[:, None], named, 0.0)
    unknown = ~known
    points[unknown] = triangulate(clip.landmarks_px[posed][:, unknown], poses[posed], clip.intrinsics)
    observed = np.where(posed[:, None, None], clip.landmarks_px, np.nan)
    solution = adjust(
        observed[posed], poses[posed], points, clip.intrinsics, clip.size, loss_scale_px=2.0, prior_mm=10.0
    )
    poses[posed] = solution.camera_from_points
    residuals = np.full(clip.landmarks_px.shape, np.nan)
    residuals[posed] = solution.residuals_px
    return BundleSolution(poses, solution.points, residuals), posed


def _filled(poses: list, posed: np.ndarray) -> np.ndarray:
    """Frames without a pose take their nearest neighbour's as a start."""
    have = np.nonzero(posed)[0]
    return np.stack([poses[have[np.argmin(np.abs(have - i))]] for i in range(len(poses))])


def choose_references(camera_from_points: np.ndarray, count: int) -> list[int]:
    """Frames whose view directions cover the clip: the central one, then towards both ends of the principal motion."""
    directions = normalised(camera_centres(camera_from_points))
    mean = normalised(directions.mean(0))
    spread = directions - directions @ mean[:, None] * mean
    axes = np.linalg.svd(spread - spread.mean(0), full_matrices=False)[2][:2]
    along = spread @ axes.T
    middle = np.median(along, axis=0)
    targets = [middle]
    for axis in (0, 1):
        for end in (along[:, axis].max(), along[:, axis].min()):
            target = middle.copy()
            target[axis] += 0.55 * (end - middle[axis])
            targets.append(target)
    chosen = [int(np.argmin(((along - target) ** 2).sum(1))) for target in targets[:count]]
    return list(dict.fromkeys(chosen))


def track_head(
    clip: Clip, model: HeadModel, settings: TrackSettings, progress: Callable, note: Callable[[str], None]
) -> HeadTrack:
    """The whole solution. model: subdivided once; progress(iterable, label) wraps the long loops; note(text) logs."""
    start, posed = start_from_landmarks(clip, model)
    note(f"landmarks: {posed.sum()} of {len(posed)} frames with a pose, {np.nanmedian(start.error_px):.2f} px")
    solution, reliable = _first_pass(clip, start, posed, settings, progress)
    for index in range(settings.passes):
        note(_summary(f"pass {index}", solution, reliable))
        fit = _fit(clip, model, solution, reliable, settings)
        solution, reliable = _mesh_pass(clip, model, solution, reliable, fit, settings, index, progress)
    note(_summary(f"pass {settings.passes}", solution, reliable))
    fit = _fit(clip, model, solution, reliable, settings)
    covariance = np.full((len(reliable), 6, 6), np.nan)
    covariance[reliable] = _head_covariance(solution, reliable, clip.intrinsics, fit.scale)
    return HeadTrack(
        fit.camera_from_head(solution.camera_from_points),
        covariance,
        fit,
        fit.to_head(solution.points),
        solution.error_px,
        reliable,
    )


def _summary(label: str, solution: BundleSolution, reliable: np.ndarray) -> str:
    error = np.nanmedian(solution.error_px)
    return f"{label}: {solution.points.shape[0]} tracks, {error:.3f} px median, {reliable.sum()} frames"


def _head_covariance(solution, reliable, intrinsics, scale) -> np.ndarray:
    """Covariance of the reliable frames with translations in the head's millimetres."""
    subset = BundleSolution(
        solution.camera_from_points[reliable], solution.points, solution.residuals_px[reliable]
    )
    unit = np.r_[1.0, 1.0, 1.0, np.full(3, scale)]
    return pose_covariance(subset, intrinsics) * np.outer(unit, unit)


def _first_pass(clip, start, posed, settings, progress) -> tuple[BundleSolution, np.ndarray]:
    """Dense tracks over the landmarks' triangulation, from the frame that stands in the middle."""
    index = np.nonzero(posed)[0]
    reference = int(index[choose_references(start.camera_from_points[posed], 1)[0]])
    grid = grid_from_landmarks(clip.landmarks_px[reference], reference, _scale(clip, settings))
    visible = np.repeat(posed[:, None], clip.landmarks_px.shape[1], axis=1)
    tracks, where = dense_tracks(
        grid,
        clip.contrast,
        clip.unusable,
        clip.landmarks_px,
        visible,
        count=settings.tracks_per_reference,
        search_px=0.03 * clip.face_width_px,
        progress=lambda frames: progress(frames, "first tracks"),
    )
    points = points_on_grid(grid, where, start.points)
    loss, prior = 2.5 * settings.loss_scale_px, 2.0 * settings.prior_mm
    return _adjusted(clip, tracks, points, start.camera_from_points, loss, prior)


def _mesh_pass(clip, model, solution, reliable, fit, settings, index, progress) -> tuple[BundleSolution, np.ndarray]:
    """Dense tracks over the fitted head, from several reference frames."""
    poses = fit.camera_from_head(solution.camera_from_points)
    scene = RayScene(fit.vertices, model.faces)
    positions, _ = project(fit.vertices, poses, clip.intrinsics)
    normals = vertex_normals(fit.vertices, model.faces)
    visible = np.stack([visible_vertices(scene, fit.vertices, normals, pose, 0.3) for pose in poses])
    visible[~reliable] = False
    untracked = [i for i, name in enumerate(model.segment_names) if name in UNTRACKED_SEGMENTS]
    usable_face = ~np.isin(model.face_segment, untracked)
    candidates = np.nonzero(reliable)[0]
    tracks, points = [], []
    count = settings.tracks_per_reference // (1 if index == settings.passes - 1 else 2)  # the last pass decides
    references = choose_references(poses[candidates], settings.references)
    for number, chosen in enumerate(references, start=1):
        reference, label = int(candidates[chosen]), f"tracks, pass {index + 1}, view {number} of {len(references)}"
        grid = _mesh_grid(clip, model, scene, fit, usable_face, poses, reference, settings)
        found, where = dense_tracks(
            grid,
            clip.contrast,
            clip.unusable,
            positions,
            visible,
            count=count,
            search_px=(0.015, 0.01)[min(index, 1)] * clip.face_width_px + 1.0,
            progress=lambda frames, label=label: progress(frames, label),
        )
        tracks.append(found)
        points.append(points_on_grid(grid, where, fit.vertices))
    tracks, points = np.concatenate(tracks, axis=1), np.concatenate(points)
    loss = settings.loss_scale_px * (1.25, 1.0)[min(index, 1)]
    return _adjusted(clip, tracks, points, poses, loss, settings.prior_mm)


def _mesh_grid(clip, model, scene, fit, usable_face, poses, reference, settings) -> SurfaceGrid:
    tracked = fit.vertices[np.unique(model.faces[usable_face])]
    pixels, _ = project(tracked, poses[reference], clip.intrinsics)
    width, height = clip.size
    low = np.clip(np.floor(pixels.min(0)), 0, [width - 2, height - 2])
    high = np.clip(np.ceil(pixels.max(0)), low + 1, [width, height])
    return grid_from_mesh(
        scene,
        model.faces,
        usable_face,
        poses[reference],
        clip.intrinsics,
        np.r_[low, high],
        reference,
        _scale(clip, settings),
    )


def _scale(clip: Clip, settings: TrackSettings) -> float:
    return float(np.clip(settings.warp_width_px / clip.face_width_px, 1.0, 3.0))


def _adjusted(clip, tracks, points, poses, loss_scale_px, prior_mm) -> tuple[BundleSolution, np.ndarray]:
    """Bundle adjustment of the frames and tracks that have enough observations; the worst 15 % of tracks dropped."""
    long_enough = np.isfinite(tracks[..., 0]).sum(0) >= max(4, 0.12 * len(poses))
    tracks, points = tracks[:, long_enough], points[long_enough]
    reliable = np.isfinite(tracks[..., 0]).sum(1) >= LEAST_TRACKS
    if reliable.sum() < 3 or tracks.shape[1] < LEAST_TRACKS:
        raise InputError(
            "the skin could not be tracked through this clip",
            got=f"{tracks.shape[1]} tracks, {reliable.sum()} frames with {LEAST_TRACKS} or more",
            expected="3 or more frames",
            mend="film sharper, larger or slower: the face should be 200 px wide or more and free of motion blur",
        )
    solved = adjust(
        tracks[reliable],
        poses[reliable],
        points,
        clip.intrinsics,
        clip.size,
        loss_scale_px=loss_scale_px,
        prior_mm=prior_mm,
    )
    error = np.nanmedian(np.where(np.isfinite(solved.error_px), solved.error_px, np.nan), axis=0)
    good = error <= np.nanpercentile(error, 85)
    residuals = np.full((len(poses), good.sum(), 2), np.nan)
    residuals[reliable] = solved.residuals_px[:, good]
    every = np.array(poses, np.float64)
    every[reliable] = solved.camera_from_points
    return BundleSolution(every, solved.points[good], residuals), reliable


def _fit(clip, model, solution, reliable, settings) -> HeadFit:
    """Codes, then the free correction, to track points and to the landmarks as they lie among them."""
    poses = solution.camera_from_points[reliable]
    directions = normalised(camera_centres(poses))
    central = np.argsort(-(directions @ normalised(directions.mean(0))))[:LANDMARK_FRAMES]
    landmarks = landmarks_on_points(
        clip.landmarks_px[reliable][central], poses[central], solution.points, clip.intrinsics
    )
    weights = settings.fit.for_depth_noise(_depth_noise_mm(solution, poses, clip.intrinsics))
    fit = fit_codes(model, solution.points, landmarks, weights)
    return fit_surface(model, fit, solution.points, weights)


def _depth_noise_mm(solution: BundleSolution, poses: np.ndarray, intrinsics: np.ndarray) -> float:
    """How far a track's typical error moves a point in depth, given the clip's rotation (half of the widest angle)."""
    directions = normalised(camera_centres(poses))
    half_angle = 0.5 * np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0))
    error_mm = np.nanmedian(solution.error_px) * np.median(poses[:, 2, 3]) / intrinsics[0, 0]
    return float(error_mm / max(np.sin(half_angle), 0.01))
