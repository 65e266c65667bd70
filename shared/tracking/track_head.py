"""From landmarks to poses that hold still: landmark start, dense flow, tracks against the mean texture, head fit.

The first poses come from a subset of the frames. The fitted head then carries the mean texture of the clip, all frames
are tracked against it twice, first widely, then in the finest detail, and each time adjusted as one rigid body.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from shared.errors import InputError
from shared.geometry.mouth import shut_lips
from shared.geometry.transforms import project, rigid, rotation_range_deg
from shared.tracking.bundle import Tracks, place_points, zoomed
from shared.tracking.depth_noise import DepthNoise, depth_noise
from shared.tracking.first_poses import (
    LOSS,
    Adjusted,
    FlowSettings,
    flow_over_head,
    flow_over_landmarks,
    interpolate_poses,
    known_landmarks,
    landmark_poses,
    start_from_landmarks,
)
from shared.tracking.fit_eyeballs import eye_centres, set_eyeballs
from shared.tracking.fit_head import FitWeights, HeadFit, fit_codes, landmarks_on_points, most_central
from shared.tracking.fit_lids import LidContours, LidMargins, lay_lids, lid_contours, lid_pins
from shared.tracking.fit_surface import ThinPlate, fit_surface
from shared.tracking.head_model import HeadModel
from shared.tracking.lids import lids_of
from shared.tracking.pose_uncertainty import estimate_uncertainty, focal_elsewhere
from shared.tracking.texture_tracking import TrackingPass, coarse_pass, look_from_afar, solve_texture, track_texture
from shared.tracking.texture_tracks import Windows
from shared.tracking.tracked_clip import TrackedClip

LANDMARK_FRAMES = 15
"""Landmarks are taken from so many frames around the middle of the motion."""

FOLLOW_TEXELS = 3.0
"""Half of what the coarse pass searches; landmarks jitter by less."""

SAME_PLACE_TEXELS = 1.0
"""Of the coarse pass: places of a frame that are nearer to each other are one."""

CLEARLY_MORE = 1.1
"""So many times the tracks must agree with the other place of a frame before its landmarks are not believed: between
two wrong ones, or where the mean texture is poor, it is chance."""

LEAST_ROTATION_DEG = 3.0
"""Between the views that lie farthest apart: a still face has hundredths, the smallest turn that gives a result that is
right 13."""

HELD_OUT_EVERY = 8
"""One fine track in so many is held out to judge the poses."""


@dataclass(frozen=True)
class TrackSettings:
    """start_frames: frames that the first poses come from; tracks: in a fine pass; texel_px: texels of its atlas."""

    flow: FlowSettings = field(default_factory=FlowSettings)
    start_frames: int = 60
    fine_passes: int = 1
    tracks: int = 2500
    texel_px: float = 1.0
    window_sigma: float = 5.0
    prior_mm: float = 10.0
    estimate_focal: bool = False
    fit: FitWeights = field(default_factory=FitWeights)


@dataclass(frozen=True)
class HeadTrack:
    """The result: poses [F, 4, 4] and covariance [F, 6, 6] of all F frames given, the fitted head, the track points.

    sigma_mm [N]: how far each may be off in depth, see shared.tracking.depth_noise. error_px [F, N]: reprojection error
    of each track point, NaN where not seen; reliable [F]: enough tracks.
    noise_factor: see shared.tracking.pose_uncertainty. focal_gain, focal_deviation: the focal length over the given one
    had it been solved, and the deviation of its logarithm; focal_solved: the result belongs to the solved one.
    held_out_px: median error of tracks kept aside, under the poses before and after the last fine pass. held_off: see
    shared.tracking.pose_uncertainty.
    """

    camera_from_head: np.ndarray
    covariance: np.ndarray
    fit: HeadFit
    points_head: np.ndarray
    sigma_mm: np.ndarray
    error_px: np.ndarray
    reliable: np.ndarray
    noise_factor: float
    focal_gain: float
    focal_deviation: float
    focal_solved: bool
    held_out_px: tuple[float, float]
    held_off: tuple[float, float] | None = None

    def scaled(self, factor: float) -> HeadTrack:
        """The same head, larger by a factor (of its lengths) and as much farther away: every picture of it stays."""
        poses = self.camera_from_head.copy()
        poses[:, :3, 3] *= factor
        unit = np.r_[1.0, 1.0, 1.0, np.full(3, factor)]
        fit = replace(self.fit, scale=factor * self.fit.scale, translation=factor * self.fit.translation,
                      vertices=factor * self.fit.vertices)
        return replace(self, camera_from_head=poses, covariance=self.covariance * np.outer(unit, unit), fit=fit,
                       points_head=factor * self.points_head, sigma_mm=factor * self.sigma_mm)


def track_head(
    clip: TrackedClip, model: HeadModel, settings: TrackSettings, progress: Callable, note: Callable[[str], None]
) -> HeadTrack:
    """The whole solution. model: subdivided once; progress(iterable, label) wraps the long loops; note(text) logs."""
    chosen = np.unique(np.linspace(0, clip.count - 1, min(settings.start_frames, clip.count)).round().astype(int))
    few = clip.subset(chosen)
    start, posed = start_from_landmarks(few, model, few.given_poses)
    note(f"landmarks: {posed.sum()} of {len(posed)} frames with a pose, {np.nanmedian(start.error_px):.2f} px")
    found = flow_over_landmarks(few, start, posed, settings.flow, progress)
    note(_summary("flow over landmarks", found))
    heads = _HeadFits(model, settings.fit)
    fit, _ = heads.fit(few, found, rough=True)
    found = flow_over_head(few, model, fit, found, settings.flow, progress)
    note(_summary("flow over the head", found))
    refuse_still_head(found.solution.camera_from_points[found.reliable])
    with ThreadPoolExecutor(1) as beside:
        searching = beside.submit(focal_elsewhere, few, found)
        fit, _ = heads.fit(few, found, rough=True)
        elsewhere = searching.result()
    poses, between, known = _onto_all(clip, model, chosen, fit, found)
    found = _coarse_pass(clip, model, fit, poses, between, known, progress)
    note(_summary("tracks", found))
    refuse_still_head(found.solution.camera_from_points[found.reliable])
    fine = TrackingPass(
        settings.texel_px, True, settings.tracks, Windows(sigma=settings.window_sigma), settings.prior_mm
    )
    for _ in range(settings.fine_passes):
        fit, _ = heads.fit(clip, found, rough=True)
        before = fit.camera_from_head(found.solution.camera_from_points)
        finer, aside = _fine_pass(clip, model, fit, before, found.reliable, fine, progress)
        note(_summary("fine tracks", finer))
        held_out = tuple(held_out_px(clip, aside, poses) for poses in (before, finer.solution.camera_from_points))
        if held_out[1] > held_out[0]:
            note(f"dropped: tracks kept aside went from {held_out[0]:.3f} to {held_out[1]:.3f} px")
            break
        found = finer
    estimated = estimate_uncertainty(clip, found, settings.prior_mm, settings.estimate_focal, elsewhere)
    found = estimated.adjusted
    note(f"noise factor {estimated.noise_factor:.2f}, focal length {estimated.focal_gain:.4f} of the given one")
    lens = zoomed(clip.intrinsics, estimated.focal_gain if estimated.focal_solved else 1.0)
    fit, noise = heads.fit(replace(clip, intrinsics=lens), found, rough=False)
    note(f"depth of a track point: {fit.scale * noise.single:.2f} mm, with what neighbours share "
         f"{fit.scale * np.median(noise.sigma):.2f} mm")
    unit = np.r_[1.0, 1.0, 1.0, np.full(3, fit.scale)]
    return HeadTrack(
        camera_from_head=fit.camera_from_head(found.solution.camera_from_points),
        covariance=estimated.covariance * np.outer(unit, unit),
        fit=fit,
        points_head=fit.to_head(found.solution.points),
        sigma_mm=fit.scale * noise.sigma,
        error_px=found.solution.error_px,
        reliable=found.reliable,
        noise_factor=estimated.noise_factor,
        focal_gain=estimated.focal_gain,
        focal_deviation=estimated.focal_deviation,
        focal_solved=estimated.focal_solved,
        held_out_px=held_out,
        held_off=estimated.held_off,
    )


def refuse_still_head(camera_from_head: np.ndarray) -> None:
    """InputError for poses [F, 4, 4] that show the head from one side only: nothing then tells depth, lens or light."""
    turned = rotation_range_deg(camera_from_head)
    if not turned >= LEAST_ROTATION_DEG:
        raise InputError(
            "the head does not turn",
            got=f"views that are {turned:.2f} degrees apart at most",
            expected=f"{LEAST_ROTATION_DEG:g} degrees or more, better 50",
            hint="film a head that turns 25 degrees to each side; where a poster, a screen or somebody else shows a "
            "larger face than the person's, cover it or cut it off",
        )


def _onto_all(clip, model, chosen, fit, found) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses of all frames from those of the chosen, with what their landmarks say and as interpolation alone has them,
    and which are known [F] bool."""
    poses = fit.camera_from_head(found.solution.camera_from_points)
    if clip.hold_poses:
        held = carried_poses(clip.given_poses, clip.given_poses[chosen], poses)
        return held, held, np.ones(clip.count, bool)
    known = np.zeros(clip.count, bool)
    known[chosen[found.reliable]] = True
    poses = poses[found.reliable]
    between = interpolate_poses(poses, clip.time_s[known], clip.time_s)
    return follow_landmarks(clip, known_landmarks(model, fit.vertices), poses, known), between, known


def follow_landmarks(clip: TrackedClip, named: np.ndarray, poses: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Poses [F, 4, 4] of all frames from those [K, 4, 4] of the frames `known` [F] bool.

    Between known frames motion is interpolated. Where a frame's landmarks say that the head was elsewhere by more than
    FOLLOW_TEXELS of the coarse pass, its pose is theirs instead, with their bias as it is in the known frames around:
    a head that starts or stops at once leaves the interpolation's path by more than tracks can be searched. Landmarks
    full of outliers can give any pose: most of them must lie nearer to it than to the interpolated one.
    named [468, 3]: landmarks on the head, NaN where the model has none.
    """
    between = interpolate_poses(poses, clip.time_s[known], clip.time_s)
    usable = np.isfinite(named[:, 0])
    limit_px = FOLLOW_TEXELS * coarse_pass(clip.face_width_px).texel_px
    seen = landmark_poses(clip, named)
    both = known & np.array([pose is not None for pose in seen])
    if not both.any():
        return between
    bias = np.stack([np.linalg.inv(seen[i]) @ between[i] for i in np.nonzero(both)[0]])
    bias = interpolate_poses(bias, clip.time_s[both], clip.time_s)
    for i in np.nonzero(~known)[0]:
        if seen[i] is not None:
            expected = between[i] @ np.linalg.inv(bias[i])
            pixels = project(named[usable], np.stack([expected, seen[i]]), clip.intrinsics)[0]
            apart = np.median(np.linalg.norm(pixels[0] - pixels[1], axis=1))
            misses = np.median(np.linalg.norm(pixels - clip.landmarks_px[i, usable], axis=2), axis=1)
            if apart > limit_px and misses[1] < misses[0]:
                between[i] = seen[i] @ bias[i]
    return between


def carried_poses(poses: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Poses [F, 4, 4] in the head space and scale of target, which are the poses source [K, 4, 4] in another space."""
    turn = source[0, :3, :3].T @ target[0, :3, :3]
    rows = np.concatenate([source[:, :3, 3:], source[:, :3, :3]], axis=2).reshape(-1, 4)
    scale, *shift = np.linalg.lstsq(rows, target[:, :3, 3].ravel(), rcond=None)[0]
    return rigid(poses[:, :3, :3] @ turn, scale * poses[:, :3, 3] + poses[:, :3, :3] @ shift)


def _coarse_pass(clip, model, fit, poses, between, known, progress) -> Adjusted:
    """All frames, wherever they were believed to be. A frame whose landmarks say that the head was elsewhere than
    between [F, 4, 4] is looked for from both places, from afar: a sudden start leads the one astray, half a face in the
    dark the other. Where both lead to the same place, that is it; else it is the one, or what lies near a start, with
    which most tracks agree."""
    settings, vertices = coarse_pass(clip.face_width_px), fit.vertices
    doubtful = (poses != between).any((1, 2))
    own, others = poses, []
    if doubtful.any():
        starts = poses, between
        own, other = look_from_afar(clip, model, vertices, starts, known, doubtful, settings, progress)
        doubtful &= apart_px(vertices, own, other, clip.intrinsics) > SAME_PLACE_TEXELS * settings.texel_px
        others = [other, poses, between] if doubtful.any() else []
    tracks, points, found = track_texture(clip, model, vertices, own, known, np.ones(clip.count, bool), settings,
                                          progress)
    agree = agreement(tracks, points, found, clip.intrinsics, settings.texel_px)
    for other in others:
        there, _, elsewhere = track_texture(clip, model, vertices, other, known, doubtful, settings, progress)
        there_agree = agreement(there, points, elsewhere, clip.intrinsics, settings.texel_px)
        better = doubtful & clearly_more(own=agree, other=there_agree)
        tracks.pixels[better], tracks.whitening[better] = there.pixels[better], there.whitening[better]
        found[better], agree[better] = elsewhere[better], there_agree[better]
    return solve_texture(clip, tracks, points, found, settings.prior_mm)


def apart_px(vertices: np.ndarray, poses: np.ndarray, others: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """[F] px: by how much poses [F, 4, 4] and others [F, 4, 4] show the vertices [V, 3] mm apart, in the median."""
    pixels = [project(vertices, some, intrinsics)[0] for some in (poses, others)]
    return np.median(np.linalg.norm(pixels[0] - pixels[1], axis=2), axis=1)


def agreement(
    tracks: Tracks, points: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray, scale_px: float
) -> np.ndarray:
    """[F]: how many tracks of each frame agree with its pose [4, 4], each counting less the farther it is off, half at
    scale_px; points [N, 3] mm."""
    off = np.linalg.norm(project(points, poses, intrinsics)[0] - tracks.pixels, axis=2)
    return np.nansum(1.0 / (1.0 + np.square(off / scale_px)), axis=1)


def clearly_more(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[F] bool: frames in which by far more tracks agree with the other pose; own, other [F]: see agreement."""
    return other > CLEARLY_MORE * own


def _fine_pass(clip, model, fit, poses, reliable, settings, progress) -> tuple[Adjusted, tuple[Tracks, np.ndarray]]:
    """The adjusted fine tracks, and some that were kept aside, with their points."""
    tracks, points, poses = track_texture(clip, model, fit.vertices, poses, reliable, reliable, settings, progress)
    aside = np.arange(len(points)) % HELD_OUT_EVERY == HELD_OUT_EVERY // 2
    found = solve_texture(clip, tracks.subset(points=~aside), points[~aside], poses, settings.prior_mm)
    return found, (tracks.subset(points=aside), points[aside])


def held_out_px(clip: TrackedClip, aside: tuple[Tracks, np.ndarray], poses: np.ndarray) -> float:
    """Median error, px, of tracks that no adjustment has seen, their points placed by the poses [F, 4, 4]."""
    tracks, points = aside
    solved = place_points(tracks, poses, points, clip.intrinsics, loss_scale=LOSS, prior_mm=100.0)
    return float(np.nanmedian(solved.error_px))


def _summary(label: str, found: Adjusted) -> str:
    error = np.nanmedian(found.solution.error_px)
    return f"{label}: {len(found.solution.points)} tracks, {error:.3f} px median, {found.reliable.sum()} frames"


class _HeadFits:
    """The head fitted again and again as tracks get better. A rough fit starts from the codes of the one before; the
    last starts from the mean head, so that its shape does not hang on how often the head was fitted, and has its lids
    where the clip shows them, and lips that meet."""

    def __init__(self, model: HeadModel, weights: FitWeights) -> None:
        self._model, self._weights, self._plate = model, weights, ThinPlate(model)
        self._last: HeadFit | None = None
        self._margins = LidMargins.of(model)

    def fit(self, clip: TrackedClip, found: Adjusted, rough: bool) -> tuple[HeadFit, DepthNoise]:
        """Codes, then the free correction, to track points and to the landmarks as they lie among them. rough: see
        shared.tracking.fit_surface."""
        solution, reliable = found.solution, found.reliable
        poses = solution.camera_from_points[reliable]
        central = most_central(poses)[:LANDMARK_FRAMES]
        landmarks = landmarks_on_points(
            clip.landmarks_px[reliable][central], poses[central], solution.points, clip.intrinsics
        )
        noise = depth_noise(solution, reliable, clip.intrinsics)
        weights = self._weights.for_depth_noise(noise)
        contours = None if rough else self._contours(clip, found)
        pins = None if contours is None else lid_pins(self._margins, self._last.vertices, contours)
        before = self._last if rough else None
        fit = fit_codes(self._model, solution.points, landmarks, weights, before, pins)
        fit = fit if contours is None else self._laid(fit, contours)
        fit = fit_surface(self._plate, fit, solution.points, noise, weights, rough)
        if contours is not None:
            fit = self._laid(fit, contours)
            fit = replace(fit, vertices=set_eyeballs(self._model, fit.vertices))
        if not rough:
            fit = replace(fit, vertices=shut_lips(self._model.surface(fit.vertices)))
        self._last = fit
        return fit, noise

    def _contours(self, clip: TrackedClip, found: Adjusted) -> LidContours | None:
        """Of the lids, in track space; None where model or clip has none."""
        if clip.lids_px is None or self._margins is None:
            return None
        shown, poses = clip.subset(np.nonzero(found.reliable)[0]), found.solution.camera_from_points[found.reliable]
        rough, centres = self._last, eye_centres(self._model, self._last.vertices)
        lids = lids_of(shown.lids_px, centres, rough.camera_from_head(poses), clip.intrinsics)
        down = -rough.rotation[1] / rough.scale
        return lid_contours(shown, lids, poses, found.solution.points, down)

    def _laid(self, fit: HeadFit, contours: LidContours) -> HeadFit:
        return replace(fit, vertices=lay_lids(self._plate, self._margins, fit.vertices, contours.moved(fit)))
