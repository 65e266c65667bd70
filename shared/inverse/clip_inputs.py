"""What the appearance stages read: sampled frames with the poses and the mesh that belong to them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shared.capture.chart import ChartObservation
from shared.errors import InputError
from shared.geometry.mesh import Mesh
from shared.imaging.color import decode_transfer
from shared.imaging.image_sampling import Picture, prepare_picture
from shared.inverse.texture_match import ClipTexture
from shared.io.arrays import load_arrays, read_json
from shared.io.frames import FrameSet
from shared.io.images import read_exr
from shared.io.meshes import load_mesh, read_obj


@dataclass(frozen=True)
class ClipInputs:
    """F frames with poses: camera_from_head [F, 4, 4]; intrinsics [3, 3] and size (width, height) of the pictures;
    moves: "head" or "camera"; face_segment [faces] index into segment_names, or None where the mesh has none.

    place [F]: each frame's place in frames; tracks: points [N, 3] on the skin and their errors [N] in depth, mm, where
    mesh and poses are the tracked ones.
    """

    mesh: Mesh
    camera_from_head: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    moves: str
    frames: FrameSet
    place: np.ndarray
    face_segment: np.ndarray | None
    segment_names: tuple[str, ...]
    tracks: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def frame_index(self) -> np.ndarray:
        """[F] int64: the frames' numbers in the source."""
        return self.frames.frame_index[self.place].astype(np.int64)

    @property
    def light_index(self) -> np.ndarray:
        """[F]: all frames stand in one light."""
        return np.zeros(len(self.camera_from_head), int)

    def picture(self, f: int) -> Picture:
        """Frame f, decoded and ready for sampling."""
        i = int(self.place[f])
        codes = self.frames.read_codes(i)
        steps = np.iinfo(codes.dtype).max
        table = decode_transfer(np.arange(steps + 1) / steps, self.frames.transfer)
        return prepare_picture(codes, table[codes], self.mask(f))

    def mask(self, f: int) -> np.ndarray:
        """Frame f's mask [H, W] uint8, 0: background."""
        return self.frames.read_mask(int(self.place[f]))

    def chart_observations(self) -> tuple[ChartObservation, ...]:
        """The colour chart in the frames where one was found."""
        return tuple(
            ChartObservation.from_record(record, self.frames.crop, self.frame_index) for record in self.frames.chart
        )


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
    names = tuple(read_json(tracked / "tracking.json")["segments"])
    poses = load_arrays(Path(pose_path)) if pose_path else tracked_poses
    points = None if mesh_path or pose_path else load_arrays(tracked / "tracks.npz")
    tracks = None if points is None else (points["points_head"], points["sigma_mm"])
    pose, place = _match(frames, poses, pose_path or str(tracked / "poses.npz"))
    return ClipInputs(mesh, pose, frames.intrinsics, frames.size, frames.moves, frames, place, segment, names, tracks)


def read_mean_texture(folder: Path, mesh: Mesh) -> ClipTexture:
    """What init_albedo averaged on a mesh, from its folder."""
    return ClipTexture(mesh, read_exr(folder / "mean_texture.exr"), read_exr(folder / "weight.exr"))


def _match(frames: FrameSet, poses: dict, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Poses of sampled frames [F, 4, 4] and their place in the frame set [F]."""
    if "camera_from_head" not in poses:
        raise InputError("no camera_from_head", where=where, got=", ".join(sorted(poses)))
    pose = poses["camera_from_head"].astype(np.float64)
    index = poses.get("frame_index", np.arange(len(pose)))
    place = {int(frame): i for i, frame in enumerate(frames.frame_index)}
    kept = [i for i, frame in enumerate(index) if int(frame) in place]
    if len(kept) < 3:
        raise InputError("too few poses belong to sampled frames", where=where, got=len(kept), expected="3 or more")
    return pose[kept], np.array([place[int(index[i])] for i in kept])
