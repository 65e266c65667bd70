"""A pass of tracking: all frames against their own mean texture on the fitted head, then one rigid adjustment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from shared.compute.parallel import in_order
from shared.compute.robust import ROBUST_SCALE
from shared.geometry.atlas import Atlas, PlacedFrame, build_atlas, place_frame, sample
from shared.geometry.mesh import Mesh, vertex_normals
from shared.geometry.raycast import RayScene
from shared.tracking.bundle import Tracks, resect
from shared.tracking.first_poses import (
    LOSS,
    Adjusted,
    adjust_clip,
    enough_observations,
    spread_over_frames,
    trackable_faces,
)
from shared.tracking.head_model import HeadModel
from shared.tracking.texture_tracks import MeanContrast, Windows, mean_texture, track_frame
from shared.tracking.tracked_clip import TrackedClip
from shared.tracking.tracks import visible_vertices

LEAST_COSINE = 0.25
"""Skin seen more obliquely is not tracked."""


@dataclass(frozen=True)
class TrackingPass:
    """texel_px: texels per picture pixel; detail: track the finest texture, else the wide contrast; count of tracks."""

    texel_px: float
    detail: bool
    count: int
    windows: Windows
    prior_mm: float


COARSE_FACE_TEXELS = 280.0


def coarse_pass(face_width_px: float) -> TrackingPass:
    """The pass that takes in frames whose pose is only interpolated; a large face is seen in larger texels."""
    texel_px = float(np.clip(round(face_width_px / COARSE_FACE_TEXELS), 1.0, 4.0))
    return TrackingPass(texel_px, False, 1500, Windows(sigma=4.0, search=6.0, steps=4), 10.0)


COARSER = ((8.0, 3), (4.0, 2), (2.0, 2))
"""How much larger than the coarse pass's the texels are in which guessed frames are looked for first, and how often:
windows of half the face, then of ever less."""
AFAR_SPREAD = 15.0
"""Code values, a third of what contrast varies by: where all frames agree to less, one that is off is all outliers."""
LEAST_FACE_TEXELS = 30.0
"""Windows as wide as the face tell nothing of its turn."""


class AtlasTracker:
    """The frames of a clip over one surface."""

    def __init__(
        self, clip: TrackedClip, mesh: Mesh, usable_face: np.ndarray, depth_mm: float, settings: TrackingPass
    ):
        """mesh: of V vertices; usable_face [faces] bool: which are tracked; depth_mm: the head's distance from the
        camera."""
        self._clip, self._vertices, self._settings = clip, mesh.vertices, settings
        texel_mm = settings.texel_px * depth_mm / clip.intrinsics[0, 0]
        self.atlas: Atlas = build_atlas(mesh, usable_face, texel_mm, settings.count)
        self._scene = RayScene(mesh.vertices, mesh.faces)
        self._normals = vertex_normals(mesh.vertices, mesh.faces)
        self._pictures = clip.detail if settings.detail else clip.contrast
        self._shrink = max(1, round(settings.texel_px))
        self._visible: dict[bytes, np.ndarray] = {}

    def _visible_from(self, camera_from_head: np.ndarray) -> np.ndarray:
        """[V] bool, traced once for each pose."""
        key = camera_from_head.tobytes()
        if key not in self._visible:
            self._visible[key] = visible_vertices(
                self._scene, self._vertices, self._normals, camera_from_head, LEAST_COSINE
            )
        return self._visible[key]

    def place(self, frame: int, camera_from_head: np.ndarray) -> PlacedFrame:
        """Where a frame shows the atlas, for a believed pose."""
        visible, unusable = self._visible_from(camera_from_head), self._clip.unusable[frame]
        return place_frame(self.atlas, self._vertices, camera_from_head, self._clip.intrinsics, visible, unusable)

    def _picture(self, frame: int) -> np.ndarray:
        """A frame's picture with pixels about as large as the texels: larger texels would only sample it."""
        picture = self._pictures[frame]
        if self._shrink == 1:
            return picture
        height, width = (-(-n // self._shrink) * self._shrink for n in picture.shape)
        padded = cv2.copyMakeBorder(
            picture, 0, height - picture.shape[0], 0, width - picture.shape[1], cv2.BORDER_REPLICATE
        )
        return cv2.resize(padded, None, fx=1 / self._shrink, fy=1 / self._shrink, interpolation=cv2.INTER_AREA)

    def mean(self, frames: np.ndarray, poses: np.ndarray, progress: Callable) -> MeanContrast:
        """Mean texture of chosen frames [K] with poses [F, 4, 4]."""
        placed: dict[int, tuple[np.ndarray, np.ndarray]] = {}

        def picture(frame: int) -> tuple[np.ndarray, np.ndarray]:
            if frame not in placed:
                where = self.place(frame, poses[frame])
                image = sample(self._picture(frame), where.layout / self._shrink, cv2.INTER_CUBIC)
                placed[frame] = image, where.shown.astype(np.uint8)
            image, shown = placed[frame]
            return image.astype(np.float32), shown.astype(np.float32)

        return mean_texture(lambda: in_order(picture, progress(frames, "mean texture")))

    def track(self, texture: MeanContrast, frames: np.ndarray, poses: np.ndarray, progress: Callable) -> Tracks:
        """Tracks of all frames [F]; those that are not among the chosen [K] see nothing."""
        count = len(self.atlas.rows)
        pixels = np.full((len(poses), count, 2), np.nan)
        whitening = np.zeros((len(poses), count, 2, 2))

        def observe(frame: int):
            where = self.place(frame, poses[frame])
            shrunk = PlacedFrame(where.layout / self._shrink, where.shown)
            found, whitening = track_frame(self.atlas, texture, self._picture(frame), shrunk, self._settings.windows)
            return found * self._shrink, whitening / self._shrink

        label = "fine tracks" if self._settings.detail else "tracks"
        for frame, found in zip(frames, in_order(observe, progress(frames, label)), strict=True):
            pixels[frame], whitening[frame] = found
        return Tracks(pixels, whitening)


def track_texture(
    clip: TrackedClip,
    model: HeadModel,
    vertices: np.ndarray,
    poses: np.ndarray,
    known: np.ndarray,
    tracked: np.ndarray,
    settings: TrackingPass,
    progress: Callable,
) -> tuple[Tracks, np.ndarray, np.ndarray]:
    """Tracks of the frames `tracked` against the mean of the frames `known` ([F] bool), then each frame's own pose.

    poses [F, 4, 4] of the fitted head. -> tracks, their points [N, 3] on the head and the poses found.
    """
    tracker = _tracker_on_head(clip, model, vertices, poses[known], settings)
    texture = tracker.mean(np.nonzero(known)[0], poses, progress)
    tracks = tracker.track(texture, np.nonzero(tracked)[0], poses, progress)
    points = tracker.atlas.points(vertices)
    return tracks, points, poses if clip.hold_poses else drawn_to(tracks, points, poses, clip.intrinsics)


def look_from_afar(
    clip: TrackedClip,
    model: HeadModel,
    vertices: np.ndarray,
    starts: Sequence[np.ndarray],
    known: np.ndarray,
    guessed: np.ndarray,
    settings: TrackingPass,
    progress: Callable,
) -> list[np.ndarray]:
    """Poses [F, 4, 4] like each of the starts, in which the guessed frames [F] bool lie where the mean of the known
    ones [F] bool is found in ever smaller texels, down to twice those of the settings. vertices [V, 3] mm.

    A window that misses by half its width sees nothing that it knows, takes all of it for highlights and stays where
    it is: tracks then agree with a pose that is off by several pixels.
    """
    starts, wanted = list(starts), np.nonzero(guessed)[0]
    for larger, rounds in COARSER:
        if clip.face_width_px < LEAST_FACE_TEXELS * larger * settings.texel_px:
            continue
        windows = replace(settings.windows, least_spread=AFAR_SPREAD)
        coarser = replace(settings, texel_px=larger * settings.texel_px, windows=windows)
        tracker = _tracker_on_head(clip, model, vertices, starts[0][known], coarser)
        texture, points = tracker.mean(np.nonzero(known)[0], starts[0], progress), tracker.atlas.points(vertices)
        for k, poses in enumerate(starts):
            for _ in range(rounds):
                poses = drawn_to(tracker.track(texture, wanted, poses, progress), points, poses, clip.intrinsics)
            starts[k] = poses
    return starts


def drawn_to(tracks: Tracks, points: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Each frame's pose [F, 4, 4] by its own tracks of points [N, 3] mm, from far off at first."""
    for loss in (15.0, 5.0):
        poses, _ = resect(tracks, poses, points, intrinsics, loss_scale=loss * LOSS)
    return poses


def _tracker_on_head(clip, model, vertices, poses, settings) -> AtlasTracker:
    mesh = Mesh(vertices, model.faces, model.uvs, model.face_uvs)
    return AtlasTracker(clip, mesh, trackable_faces(model), float(np.median(poses[:, 2, 3])), settings)


def solve_texture(
    clip: TrackedClip, tracks: Tracks, points: np.ndarray, poses: np.ndarray, prior_mm: float
) -> Adjusted:
    """Rigid adjustment; then the noise is set to what was left over: tracks and frames that fit badly weigh less.
    points [N, 3] mm."""
    tracks, points, reliable = enough_observations(tracks, points)
    for _ in range(2):
        solved = adjust_clip(clip, tracks.subset(reliable), poses[reliable], points, prior_mm)
        whitened = np.einsum("fnij,fnj->fni", tracks.whitening[reliable], solved.residuals_px)
        of_track = ROBUST_SCALE * np.nanmedian(np.abs(whitened), axis=(0, 2))
        of_frame = np.ones(len(reliable))
        of_frame[reliable] = ROBUST_SCALE * np.nanmedian(np.abs(whitened), axis=(1, 2))
        worse = np.maximum(of_frame / np.median(of_frame[reliable]), 1.0)
        noise = np.maximum(of_track, 0.3) * worse[:, None]
        tracks = Tracks(tracks.pixels, tracks.whitening / noise[..., None, None])
        poses = np.array(poses)
        poses[reliable], points = solved.camera_from_points, solved.points
    error = np.nanmedian(solved.error_px, axis=0)
    return spread_over_frames(solved, tracks, reliable, poses, error <= np.nanpercentile(error, 92))
