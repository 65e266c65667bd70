"""What the appearance stages read: sampled frames with the poses and the mesh that belong to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shared.appearance.light_tint import LightTint
from shared.capture.chart import ChartObservation
from shared.compute.parallel import in_order
from shared.errors import InputError
from shared.geometry.eyeballs import eyeballs_of, gaze_direction, gaze_shown
from shared.geometry.mesh import Mesh
from shared.geometry.surface import Surface, TrackPoints
from shared.geometry.transforms import camera_centres
from shared.imaging.color import decode_transfer, eight_bit
from shared.imaging.image_sampling import Picture, prepare_picture
from shared.imaging.views import Views
from shared.inverse.texture_match import ClipTexture
from shared.io.arrays import load_arrays, read_json
from shared.io.frames import FrameSet
from shared.io.images import read_exr
from shared.io.meshes import load_mesh, read_obj
from shared.tracking.tracked_clip import GreyFrame, TrackedClip


@dataclass(frozen=True, eq=False)
class TrackedPoses:
    """How to look at a clip's frames again, and the covariance [F, 6, 6] of the poses that it was tracked to."""

    look: Callable[[], TrackedClip]
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class ClipInputs:
    """A clip's views and surface; frames: its sampled frames on disk, place [F]: where among them each view is;
    tracked: what its poses can be tracked from again, None where they were given; gaze [F, 2, 2] radians, None where it
    is not known: that of the person, while views have what the mesh's eyeballs show."""

    views: Views
    surface: Surface
    frames: FrameSet
    place: np.ndarray
    tracked: TrackedPoses | None = None
    gaze: np.ndarray | None = None

    @property
    def frame_index(self) -> np.ndarray:
        """[F] int64: the views' frame numbers in the source."""
        return self.frames.frame_index[self.place].astype(np.int64)

    @property
    def lens(self) -> np.ndarray:
        """[3, 3] px: the one of all views."""
        return self.frames.intrinsics

    def chart_observations(self) -> tuple[ChartObservation, ...]:
        """The colour chart in the frames where one was found."""
        return tuple(
            ChartObservation.from_record(record, self.frames.crop, self.frame_index) for record in self.frames.chart
        )

    def light_tints(self) -> tuple[LightTint | None, ...]:
        """What a grey place says of the clip's one light; empty without one. A white balance that drifts about its mean
        leaves the tint as it is: exposure's gains have a mean of 1, and the place is looked at in the whole clip."""
        return () if self.frames.grey is None else (LightTint.from_record(self.frames.grey),)


def read_inputs(sampled: Path, tracked: Path, mesh_path: str = "", pose_path: str = "") -> ClipInputs:
    """From the folders of sample_frames and track_landmarks.

    The intrinsics are those of track_landmarks, which may have solved the focal length.

    mesh_path (.npz or .obj) and pose_path (.npz) replace the tracked ones when not empty. InputError when fewer than
    three poses belong to sampled frames.
    """
    tracked_poses = load_arrays(tracked / "poses.npz")
    frames = replace(
        FrameSet.open(sampled), intrinsics=tracked_poses["intrinsics_crop"],
        intrinsics_source=tracked_poses["intrinsics"]
    )
    path = Path(mesh_path) if mesh_path else tracked / "mesh.npz"
    mesh = read_obj(path) if path.suffix == ".obj" else load_mesh(path)
    segment = load_arrays(path).get("face_segment") if path.suffix == ".npz" else None
    tracking = read_json(tracked / "tracking.json")
    poses = load_arrays(Path(pose_path)) if pose_path else tracked_poses
    points = None if mesh_path or pose_path else load_arrays(tracked / "tracks.npz")
    tracks = None if points is None else TrackPoints.tracked(points["points_head"], points["sigma_mm"])
    camera_from_head, place, kept = _match(frames, poses, pose_path or str(tracked / "poses.npz"))
    surface = Surface(mesh, segment, tuple(tracking["segments"]), tracks)
    gaze = poses["gaze"][kept] if "gaze" in poses else None
    shown = None if gaze is None else _shown_gaze(surface, gaze, camera_from_head, tracking.get("eyes", {}))
    lids_px = None if shown is None or pose_path else _lids(load_arrays(tracked / "landmarks.npz"), kept)
    views = Views.in_one_light(
        camera_from_head=camera_from_head,
        lens=frames.intrinsics,
        size=frames.size,
        moves=frames.moves,
        read_picture=lambda f: read_picture(frames, int(place[f])),
        read_mask=lambda f: frames.read_mask(int(place[f])),
        gaze=shown,
        lids_px=lids_px,
    )
    if tracks is None or tracking["held"]:
        return ClipInputs(views, surface, frames, place, gaze=gaze)
    again = TrackedPoses(lambda: look_again(frames, place), tracked_poses["covariance"])
    return ClipInputs(views, surface, frames, place, again, gaze)


def look_again(frames: FrameSet, place: np.ndarray) -> TrackedClip:
    """The frames place [F] as fine tracking sees them."""

    def look(i: int) -> tuple[np.ndarray, np.ndarray]:
        grey = GreyFrame.of(eight_bit(frames.read_codes(i)), frames.read_mask(i) == 0)
        return grey.detail(), grey.unusable

    detail, unusable = (list(kind) for kind in zip(*in_order(look, place), strict=True))
    no_landmarks = np.empty((len(place), 0, 2))
    return TrackedClip(
        detail, detail, unusable, no_landmarks, frames.time_s[place], frames.intrinsics, frames.size
    )


def read_picture(frames: FrameSet, i: int) -> Picture:
    """Frame i of a frame set, decoded and ready for sampling."""
    codes = frames.read_codes(i)
    steps = np.iinfo(codes.dtype).max
    table = decode_transfer(np.arange(steps + 1) / steps, frames.transfer)
    return prepare_picture(codes, table[codes], frames.read_mask(i))


def read_mean_texture(folder: Path, mesh: Mesh) -> ClipTexture:
    """What init_albedo averaged on a mesh, from its folder."""
    return ClipTexture(mesh, read_exr(folder / "mean_texture.exr"), read_exr(folder / "weight.exr"))


def _shown_gaze(surface: Surface, gaze: np.ndarray, camera_from_head: np.ndarray, said: dict) -> np.ndarray | None:
    """Gaze [F, 2, 2] with which the mesh's eyeballs show the irises where the frames do.

    None where the mesh has none, or where all frames show shut eyes: then the lids are seen on its eyeballs.
    said: of the eyes in tracking.json, where irises turn about centres of their own; without it, about the mesh's.
    """
    balls = eyeballs_of(surface)
    if balls is None or not np.isfinite(gaze).any():
        return None
    if "centres_mm" not in said:
        return gaze
    cameras = camera_centres(camera_from_head)
    irises = np.array(said["centres_mm"]) + said["iris_distance_mm"] * gaze_direction(gaze)
    return np.stack([gaze_shown(ball, irises[:, k], cameras) for k, ball in enumerate(balls)], axis=1)


def _lids(landmarks: dict, kept: list[int]) -> np.ndarray | None:
    """Polygons [F, 2, 16, 2] px of the eyes' openings: the lower lid from the outer to the inner corner, then the upper
    one back."""
    order = [*range(9), *range(15, 8, -1)]
    return landmarks["lids_px"][kept][:, :, order] if "lids_px" in landmarks else None


def _match(frames: FrameSet, poses: dict, where: str) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Poses of sampled frames [F, 4, 4], their place in the frame set [F], and which of the poses they are."""
    if "camera_from_head" not in poses:
        raise InputError("no camera_from_head", where=where, got=", ".join(sorted(poses)))
    pose = poses["camera_from_head"]
    if pose.dtype.kind not in "fiu" or pose.ndim != 3 or pose.shape[1:] != (4, 4) or not np.isfinite(pose).all():
        raise InputError("camera_from_head is no poses", where=where, got=f"{pose.dtype} {pose.shape}",
                         expected="finite numbers [F, 4, 4]")
    pose = pose.astype(np.float64)
    index = poses.get("frame_index", np.arange(len(pose)))
    whole = index.dtype.kind in "fiu" and np.isfinite(index).all() and (index == np.floor(index)).all()
    if index.shape != pose.shape[:1] or not whole or len(np.unique(index)) < len(index):
        raise InputError("frame_index names no frames", where=where, got=f"{index.dtype} {index.shape}",
                         expected=f"a number of a frame for each of {len(pose)} poses, none twice")
    place = {int(frame): i for i, frame in enumerate(frames.frame_index)}
    kept = [i for i, frame in enumerate(index) if int(frame) in place]
    if len(kept) < 3:
        raise InputError("too few poses belong to sampled frames", where=where, got=len(kept), expected="3 or more")
    return pose[kept], np.array([place[int(index[i])] for i in kept]), kept
