"""Several clips of one head as one: one mesh, poses in one head space, each clip's frames in a light of their own.

Each clip was tracked by itself, so that it has a head space and a size of its own: both follow from the head model's
prior. The mesh is that of the clip whose tracks know depth best. The track points of the others are laid onto it as
bodies of free size, point to plane, and their poses follow.

References: Chen and Medioni, Object modelling by registration of multiple range images, 1992.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from shared.chart import ChartSight
from shared.gather import Picture
from shared.geometry import rigid, rotation_from_vector, similarity_from_points
from shared.mesh import Mesh, interpolate, normalised, vertex_normals
from shared.raycast import RayScene
from shared.solve.reshape import faces_of, track_points

UNTRACKED = ("eyes", "eye_sockets", "inner_mouth", "scalp")
"""Segments on which no track point lies."""
REACH_MM, ITERATIONS, SETTLED_MM = 15.0, 40, 1e-4


@dataclass(frozen=True)
class Similarity:
    """target ~ scale * rotation @ source + translation: takes one head space to another."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points [N, 3]."""
        return self.scale * points @ self.rotation.T + self.translation

    def after(self, first: Similarity) -> Similarity:
        """The first one, then this one."""
        place = self.apply(first.translation[None])[0]
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, place)

    def camera_from_target(self, camera_from_source: np.ndarray) -> np.ndarray:
        """Poses [F, 4, 4] of the source's space -> of the target's. The camera's space grows with the head, so that
        pictures stay what they are."""
        rotation = camera_from_source[:, :3, :3] @ self.rotation.T
        return rigid(rotation, self.scale * camera_from_source[:, :3, 3] - rotation @ self.translation)


UNMOVED = Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class JointInputs:
    """What the solver needs of several clips (see InverseInputs): the frames of each in a row.

    clips: as they are on disk; main: which of them the mesh comes from; sizes [C]: how large each clip's own head space
    took the head to be, the main one's 1, and placed_mm [C]: median distance of its track points from the mesh, NaN
    where there are none.
    """

    clips: tuple
    main: int
    mesh: Mesh
    camera_from_head: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    moves: str
    face_segment: np.ndarray | None
    segment_names: tuple[str, ...]
    tracks: tuple[np.ndarray, np.ndarray] | None
    light_index: np.ndarray
    sizes: tuple[float, ...]
    placed_mm: tuple[float, ...]

    def picture(self, f: int) -> Picture:
        """Frame f of all."""
        clip = int(self.light_index[f])
        return self.clips[clip].picture(f - self._first(clip))

    def _first(self, clip: int) -> int:
        return int(np.searchsorted(self.light_index, clip))

    def chart_sights(self) -> tuple[ChartSight, ...]:
        """The colour chart of the first clip that shows one: one clip's scale is that of all."""
        for k, clip in enumerate(self.clips):
            if sights := clip.chart_sights():
                return tuple(replace(sight, frame=sight.frame + self._first(k)) for sight in sights)
        return ()

    def describe(self) -> list[dict]:
        """Of each clip what solve.json says: whether the mesh is its own, and how its track points lie on it."""
        facts = zip(self.sizes, self.placed_mm, strict=True)
        return [{"mesh": k == self.main, "size": round(size, 5), "tracks_to_mesh_mm": round(placed, 4)}
                for k, (size, placed) in enumerate(facts)]


def join_clips(clips: Sequence) -> JointInputs:
    """Clips (shared.io.clip_inputs.ClipInputs) in the head space of the one that knows depth best.

    Clips without tracks, whose mesh and poses were given, share a head space already.
    """
    main, placings, tracks, placed = 0, [UNMOVED] * len(clips), None, [np.nan] * len(clips)
    if all(clip.tracks is not None for clip in clips):
        main = int(np.argmin([depth_deviation(clip) for clip in clips]))
        surface = TrackedSurface(clips[main])
        placings = [UNMOVED if clip is clips[main] else surface.lay_on(clip) for clip in clips]
        points = [placing.apply(clip.tracks[0]) for placing, clip in zip(placings, clips, strict=True)]
        tracks = np.concatenate(points), np.concatenate([clip.tracks[1] for clip in clips])
        placed = [float(np.median(np.abs(surface.under(own)[2]))) for own in points]
    counts = [len(clip.camera_from_head) for clip in clips]
    poses = [placing.camera_from_target(clip.camera_from_head) for placing, clip in zip(placings, clips, strict=True)]
    return JointInputs(
        tuple(clips),
        main,
        clips[main].mesh,
        np.concatenate(poses),
        np.repeat([clip.intrinsics for clip in clips], counts, axis=0),
        clips[0].size,
        clips[0].moves,
        clips[main].face_segment,
        clips[main].segment_names,
        tracks,
        np.repeat(np.arange(len(clips)), counts),
        tuple(1.0 / placing.scale for placing in placings),
        tuple(placed),
    )


def depth_deviation(clip) -> float:
    """Median standard deviation of a clip's track points in depth, mm."""
    known = track_points(*clip.tracks, clip.camera_from_head, clip.intrinsics)
    return float(np.median(known.sigma_mm))


class TrackedSurface:
    """Where track points lie on a clip's mesh."""

    def __init__(self, clip):
        self.mesh, self.scene = clip.mesh, RayScene(clip.mesh.vertices, clip.mesh.faces)
        self.normals = vertex_normals(clip.mesh.vertices, clip.mesh.faces)
        untracked = np.zeros(len(clip.mesh.faces), bool) if clip.face_segment is None else faces_of(clip, UNTRACKED)
        self.skin = np.unique(clip.mesh.faces[~untracked])
        self._near = cKDTree(clip.mesh.vertices[self.skin])

    def under(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of points [N, 3] those above or below the skin: index [n], normal there [n, 3], height above it [n] mm."""
        along = self.normals[self.skin[self._near.query(points)[1]]]
        face, bary, distance = self.scene.intersect(points + REACH_MM * along, -along)
        normal = np.zeros_like(points)
        normal[face >= 0] = interpolate(self.normals, self.mesh.faces, face[face >= 0], bary[face >= 0])
        index = np.nonzero((face >= 0) & (distance < 2.0 * REACH_MM) & ((normal * along).sum(1) > 0.5))[0]
        return index, normalised(normal[index]), distance[index] - REACH_MM

    def lay_on(self, clip) -> Similarity:
        """What takes the head space of another clip of this head to the one of this mesh."""
        vertices = clip.mesh.vertices[self.skin], self.mesh.vertices[self.skin]
        found = Similarity(*similarity_from_points(*vertices))
        points = clip.tracks[0][np.isfinite(clip.tracks[1])]
        for _ in range(ITERATIONS):
            placed = found.apply(points)
            step = self._step(placed)
            found = step.after(found)
            if np.abs(step.apply(placed) - placed).max() < SETTLED_MM:
                break
        return found

    def _step(self, points: np.ndarray) -> Similarity:
        """One Gauss-Newton step of points [N, 3] towards the surface, robust (Cauchy)."""
        index, normal, height = self.under(points)
        points = points[index]
        centre = points.mean(0)
        arm = points - centre
        rows = np.concatenate([np.cross(arm, normal), normal, (arm * normal).sum(1, keepdims=True)], axis=1)
        weight = 1.0 / (1.0 + np.square(height / (3.0 * np.median(np.abs(height)) + 1e-3)))
        solved = np.linalg.lstsq(rows * np.sqrt(weight)[:, None], -height * np.sqrt(weight), rcond=None)[0]
        turn, grow = rotation_from_vector(solved[:3]), float(np.exp(solved[6]))
        return Similarity(grow, turn, centre + solved[3:6] - grow * turn @ centre)
