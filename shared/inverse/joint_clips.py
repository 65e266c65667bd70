"""Several clips of one head as one: one mesh, poses in one head space, each clip's frames in a light of their own.

Each clip was tracked by itself, so that it has a head space, a size and a shape of its own. The mesh is that of the
clip whose tracks know depth best. For the others their mean textures say which skin lies where on it: what a frame
showed at some pixel of its own clip's mesh, the shared mesh has to show there, too. One turn, shift and size of the
head for all frames of a clip are solved from that, in the pictures: what depth the clip got wrong does not enter, and
its own motion, which is far steadier than poses one by one, stays as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from shared.appearance.light_tint import LightTint
from shared.capture.chart import ChartObservation
from shared.errors import InputError
from shared.geometry.eyeballs import gaze_direction, gaze_towards
from shared.geometry.mesh import normalised
from shared.geometry.surface import Surface
from shared.geometry.transforms import (
    Similarity,
    camera_centres,
    project,
    projection_slope,
    rotation_from_vector,
    similarity_from_points,
)
from shared.imaging.views import Views
from shared.inverse.clip_inputs import ClipInputs
from shared.inverse.texture_match import ClipTexture, Matches, match_textures

MATCHES, LEAST_MATCHES = 2000, 300
"""Texels that a pose is solved from, and fewer than which show that the clips have no skin in common."""
FACING = 0.4
"""Cosine of the angle between normal and line of sight from which on a frame shows a texel well."""
LOSS_PX, ITERATIONS = 1.0, 30


@dataclass(frozen=True, eq=False)
class JoinedClips:
    """Several clips as one: the views of each in a row on one surface.

    clips: as they are on disk; main: which of them the mesh comes from; placed: how each one's views were placed on it.
    """

    views: Views
    surface: Surface
    clips: tuple[ClipInputs, ...]
    main: int
    placed: tuple[Placed, ...]

    def chart_observations(self) -> tuple[ChartObservation, ...]:
        """The colour chart of the first clip that shows one: one clip's scale is that of all."""
        for own, clip in zip(self.views.frames_of_lights, self.clips, strict=True):
            if observations := clip.chart_observations():
                return tuple(replace(seen, frame=seen.frame + int(own[0])) for seen in observations)
        return ()

    def light_tints(self) -> tuple[LightTint | None, ...]:
        """What a grey place in each clip says of that clip's own light, None without one; empty where none has one."""
        tints = tuple(next(iter(clip.light_tints()), None) for clip in self.clips)
        return tints if any(tints) else ()

    def describe(self) -> list[dict]:
        """Of each clip what solve.json says: whether the mesh is its own, else how its frames were placed on it."""
        return [{"mesh": True} if k == self.main else
                {"mesh": False, "matched_texels": own.matched, "match_px": round(own.match_px, 4)}
                for k, own in enumerate(self.placed)]


def join_clips(clips: Sequence[ClipInputs], textures: Sequence[ClipTexture]) -> JoinedClips:
    """Clips in the head space of the one that knows depth best; textures: theirs.

    Clips without tracks, whose mesh and poses were given, share a head space already. InputError where the clips show
    no common skin.
    """
    main, placed = 0, [Placed(clip.views.camera_from_head) for clip in clips]
    tracks = [clip.surface.tracks for clip in clips]
    if all(own is not None for own in tracks):
        main = int(np.argmin([np.median(own.sigma_mm) for own in tracks]))
        for k, clip in enumerate(clips):
            if k != main:
                matches = match_textures(textures[main], textures[k])
                placed[k] = place_on_surface(clip.views, matches, clip.frames.source_name)
    views = join_views([own.of(clip.views) for clip, own in zip(clips, placed, strict=True)])
    return JoinedClips(views, clips[main].surface, tuple(clips), main, tuple(placed))


def join_views(parts: Sequence[Views]) -> Views:
    """The views of several clips, of one head space and picture size, in a row, those of each in a light of its own."""
    counts = [len(part) for part in parts]
    owner, first = np.repeat(np.arange(len(parts)), counts), np.cumsum([0, *counts])
    return Views(
        camera_from_head=np.concatenate([part.camera_from_head for part in parts]),
        intrinsics=np.concatenate([part.intrinsics for part in parts]),
        size=parts[0].size,
        moves=parts[0].moves,
        light_index=owner,
        fitted=np.concatenate([part.fitted for part in parts]),
        read_picture=lambda f: parts[owner[f]].picture(f - first[owner[f]]),
        read_mask=lambda f: parts[owner[f]].mask(f - first[owner[f]]),
        gaze=_of_eyes([part.gaze for part in parts], counts),
        lids_px=_of_eyes([part.lids_px for part in parts], counts),
    )


def _of_eyes(parts: Sequence[np.ndarray | None], counts: Sequence[int]) -> np.ndarray | None:
    """What is known of the eyes in each clip's views [F, 2, ...], in a row; NaN where it is not, as of shut eyes; None
    where it is in no clip."""
    known = [part for part in parts if part is not None]
    if not known:
        return None
    shape = known[0].shape[1:]
    return np.concatenate([np.full((count, *shape), np.nan) if part is None else part
                           for part, count in zip(parts, counts, strict=True)])


def fit_similarity(
    points: np.ndarray, pixels: np.ndarray, camera_from_own: np.ndarray, intrinsics: np.ndarray, start: Similarity
) -> Similarity:
    """own ~ similarity(points [N, 3]) such that poses [F, 4, 4] of the own space show them at pixels [F, N, 2].

    Robust Gauss-Newton (Cauchy); NaN: not seen. camera_from_own [F, 4, 4] mm.
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


@dataclass(frozen=True, eq=False)
class Placed:
    """A clip's poses [F, 4, 4] in the shared head space; matched: texels by which they were placed there, and match_px:
    median distance of these from where the clip's own mesh put them; own_from_shared [3, 3]: turns directions."""

    camera_from_head: np.ndarray
    matched: int = 0
    match_px: float = 0.0
    own_from_shared: np.ndarray = field(default_factory=lambda: np.eye(3))

    def of(self, views: Views) -> Views:
        """The clip's views in the shared head space."""
        gaze = views.gaze
        if gaze is not None and not np.array_equal(self.own_from_shared, np.eye(3)):
            gaze = gaze_towards(gaze_direction(gaze) @ self.own_from_shared)
        return replace(views, camera_from_head=self.camera_from_head, gaze=gaze)


def place_on_surface(views: Views, matches: Matches, name: str) -> Placed:
    """The poses of a clip's views on another clip's surface; matches: from that one to the clip's own; name: of the
    clip, for messages."""
    if len(matches) < LEAST_MATCHES:
        raise InputError("the clips do not show the same skin", where=name,
                         got=f"{len(matches)} texels alike", expected=f"{LEAST_MATCHES} or more",
                         hint="film one face, the same in all clips and sharp, or solve each clip by itself")
    chosen, poses, lens = matches.thinned(MATCHES), views.camera_from_head, views.intrinsics[0]
    pixels = project(chosen.second, poses, lens)[0]
    towards = normalised(camera_centres(poses)[:, None] - chosen.second)
    pixels[(towards * chosen.normals).sum(-1) < FACING] = np.nan
    start = Similarity(*similarity_from_points(chosen.first, chosen.second))
    own = fit_similarity(chosen.first, pixels, poses, lens, start)
    back = Similarity(1.0 / own.scale, own.rotation.T, -own.rotation.T @ own.translation / own.scale)
    found = back.pose(poses)
    away = np.linalg.norm(project(chosen.first, found, lens)[0] - pixels, axis=-1)
    return Placed(found, len(matches), float(np.nanmedian(away)), own.rotation)
