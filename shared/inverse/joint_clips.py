"""Several clips of one head as one: one mesh, poses in one head space, each clip's frames in a light of their own.

Each clip was tracked by itself, so that it has a head space, a size and a shape of its own. The mesh is that of the
clip whose tracks know depth best. For the others their mean textures say which skin lies where on it: what a frame
showed at some pixel of its own clip's mesh, the shared mesh has to show there, too. One turn, shift and size of the
head for all frames of a clip are solved from that, in the pictures: what depth the clip got wrong does not enter, and
its own motion, which is far steadier than poses one by one, stays as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shared.capture.chart import ChartObservation
from shared.errors import InputError
from shared.geometry.mesh import Mesh, normalised
from shared.geometry.transforms import (
    Similarity,
    camera_centres,
    project,
    projection_slope,
    rotation_from_vector,
    similarity_from_points,
)
from shared.imaging.image_sampling import Picture
from shared.inverse.texture_match import ClipTexture, Matches, match_textures
from shared.shape.refine import track_points

MATCHES, LEAST_MATCHES = 2000, 300
"""Texels that a pose is solved from, and fewer than which show that the clips have no skin in common."""
FACING = 0.4
"""Cosine of the angle between normal and line of sight from which on a frame shows a texel well."""
LOSS_PX, ITERATIONS = 1.0, 30


@dataclass(frozen=True)
class JointInputs:
    """What the solver needs of several clips (see InverseInputs): the frames of each in a row.

    clips: as they are on disk; main: which of them the mesh comes from; matched [C]: texels by which each other clip
    was placed, and match_px [C]: median distance of these from where the clip's own mesh put them.
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
    matched: tuple[int, ...]
    match_px: tuple[float, ...]

    def picture(self, f: int) -> Picture:
        """Frame f of all."""
        clip = int(self.light_index[f])
        return self.clips[clip].picture(f - self._first(clip))

    def mask(self, f: int) -> np.ndarray:
        """Its mask [H, W], 0: background."""
        clip = int(self.light_index[f])
        return self.clips[clip].mask(f - self._first(clip))

    def _first(self, clip: int) -> int:
        return int(np.searchsorted(self.light_index, clip))

    def chart_observations(self) -> tuple[ChartObservation, ...]:
        """The colour chart of the first clip that shows one: one clip's scale is that of all."""
        for k, clip in enumerate(self.clips):
            if observations := clip.chart_observations():
                return tuple(replace(observation,
                                     frame=observation.frame + self._first(k)) for observation in observations)
        return ()

    def describe(self) -> list[dict]:
        """Of each clip what solve.json says: whether the mesh is its own, else how its frames were placed on it."""
        facts = zip(self.matched, self.match_px, strict=True)
        return [{"mesh": True} if k == self.main else {"mesh": False, "matched_texels": count, "match_px": round(px, 4)}
                for k, (count, px) in enumerate(facts)]


def join_clips(clips: Sequence, textures: Sequence[ClipTexture]) -> JointInputs:
    """Clips (shared.inverse.clip_inputs.ClipInputs) in the head space of the one that knows depth best; textures:
    theirs.

    Clips without tracks, whose mesh and poses were given, share a head space already. InputError where the clips show
    no common skin.
    """
    main, placed = 0, [Placed(clip.camera_from_head) for clip in clips]
    if all(clip.tracks is not None for clip in clips):
        main = int(np.argmin([depth_deviation(clip) for clip in clips]))
        for k, clip in enumerate(clips):
            if k != main:
                placed[k] = place(clips[main], clip, match_textures(textures[main], textures[k]))
    counts = [len(clip.camera_from_head) for clip in clips]
    return JointInputs(
        tuple(clips),
        main,
        clips[main].mesh,
        np.concatenate([own.camera_from_head for own in placed]),
        np.repeat([clip.intrinsics for clip in clips], counts, axis=0),
        clips[0].size,
        clips[0].moves,
        clips[main].face_segment,
        clips[main].segment_names,
        clips[main].tracks,
        np.repeat(np.arange(len(clips)), counts),
        tuple(own.matched for own in placed),
        tuple(own.match_px for own in placed),
    )


def fit_similarity(
    points: np.ndarray, pixels: np.ndarray, camera_from_own: np.ndarray, intrinsics: np.ndarray, start: Similarity
) -> Similarity:
    """own ~ similarity(points [N, 3]) such that poses [F, 4, 4] of the own space show them at pixels [F, N, 2].

    Robust Gauss-Newton (Cauchy); NaN: not seen.
    """
    found = start
    for _ in range(ITERATIONS):
        own = found.points(points)
        centre, matrix, right = own.mean(0), np.zeros((7, 7)), np.zeros(7)
        arm = own - centre
        turns = np.stack([np.cross(axis, arm) for axis in np.eye(3)], axis=-1)
        motion = np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape), arm[..., None]], axis=2)
        for pose, seen in zip(camera_from_own, pixels, strict=True):
            error = seen - project(own, pose, intrinsics)[0]
            known = np.isfinite(error[:, 0])
            error, rows = error[known], projection_slope(own[known], pose, intrinsics) @ motion[known]
            weight = 1.0 / (1.0 + np.square(error / LOSS_PX).sum(1))
            matrix += np.einsum("n,nki,nkj->ij", weight, rows, rows)
            right += np.einsum("n,nki,nk->i", weight, rows, error)
        step = np.linalg.solve(matrix, right)
        turn, grow = rotation_from_vector(step[:3]), float(np.exp(step[6]))
        place = centre + step[3:6] + grow * turn @ (found.translation - centre)
        found = Similarity(grow * found.scale, turn @ found.rotation, place)
        if np.abs(step[:3]).max() < 1e-6:
            break
    return found


def depth_deviation(clip) -> float:
    """Median standard deviation of a clip's track points in depth, mm."""
    return float(np.median(track_points(*clip.tracks).sigma_mm))


@dataclass(frozen=True)
class Placed:
    """A clip's poses [F, 4, 4] in the shared head space; matched, match_px: see JointInputs."""

    camera_from_head: np.ndarray
    matched: int = 0
    match_px: float = 0.0


def place(main, clip, matches: Matches) -> Placed:
    """The poses of a clip on the main clip's mesh; matches: from the main one's to its own."""
    if len(matches) < LEAST_MATCHES:
        raise InputError("the clips do not show the same skin", where=clip.frames.source_name,
                         got=f"{len(matches)} texels alike", expected=f"{LEAST_MATCHES} or more",
                         hint="film one face, the same in all clips and sharp, or solve each clip by itself")
    chosen, poses = matches.thinned(MATCHES), clip.camera_from_head
    pixels = project(chosen.second, poses, clip.intrinsics)[0]
    towards = normalised(camera_centres(poses)[:, None] - chosen.second)
    pixels[(towards * chosen.normals).sum(-1) < FACING] = np.nan
    start = Similarity(*similarity_from_points(chosen.first, chosen.second))
    own = fit_similarity(chosen.first, pixels, poses, clip.intrinsics, start)
    back = Similarity(1.0 / own.scale, own.rotation.T, -own.rotation.T @ own.translation / own.scale)
    found = back.pose(poses)
    away = np.linalg.norm(project(chosen.first, found, clip.intrinsics)[0] - pixels, axis=-1)
    return Placed(found, len(matches), float(np.nanmedian(away)))
