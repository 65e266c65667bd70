"""Irradiance of every texel for every shot at once.

The head is rigid, so the visibility of a surface point is the same in each shot; only the light turns. Each texel
traces one set of directions, and the irradiance of all shots is a matrix product of its cosines with their light.
Lamps, which such a set would miss, get shadow rays of their own in each shot, towards where each texel sees them if
they stand near. Light that arrives over one bounce is
the irradiance of the texels that the blocked rays hit, times their albedo / pi; the second surface reflects
diffusely only.

Texels are dealt to groups at random; each group has its own rotation of the directions and its own lamp samples, so
that what error remains is noise between neighbours, never a band. Results do not depend on the number of processes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.ndimage import distance_transform_edt

from shared.geometry.mesh import rasterize_uv
from shared.geometry.transforms import WORLD_FROM_CAMERA, fibonacci_sphere
from tools.synthesis.light import EnvironmentLight, LampSphere
from tools.synthesis.sampling import random_rotation, shifted_hammersley
from tools.synthesis.surface import ShadingPoints, SyntheticSurface, nearest_texel

BATCH = 1024
REFRESHED_BOUNCES = 3


@dataclass(frozen=True)
class SyntheticShot:
    """One picture to take: camera_from_head [4, 4], world_from_head [3, 3], which light and the random seed; of living
    eyes the gaze [2, 2] and which of the scene's states their lids are in."""

    camera_from_head: np.ndarray
    world_from_head: np.ndarray
    light: int
    seed: int
    gaze: np.ndarray | None = None
    lids: int = 0

    @property
    def place(self) -> np.ndarray:
        """[3] mm: the head's origin in world space, whose own origin is the camera."""
        return WORLD_FROM_CAMERA @ self.camera_from_head[:3, 3]

    def in_head_space(self, lamps: LampSphere) -> LampSphere:
        """Lamps of world space."""
        return LampSphere((lamps.centre - self.place) @ self.world_from_head, lamps.distance_mm)


@dataclass(frozen=True)
class IrradianceQuality:
    """Texels across the texture, directions per texel, lamp samples per texel and shot, groups of texels, and how often
    light bounces: each bounce between eye socket and nose leaves a quarter of the one before, so that of what reaches
    skin in the shadow of a lamp one bounce alone lacks a third."""

    size: int = 320
    directions: int = 1024
    lamp_samples: int = 24
    groups: int = 16
    bounces: int = 5


@dataclass(frozen=True)
class GroupResult:
    """Direct irradiance [T, S, 3] of a group's texels and the sparse matrix [T, size^2] of their one-bounce weights."""

    texels: np.ndarray
    direct: np.ndarray
    bounce: sparse.csr_matrix

    def open_ones(self) -> GroupResult:
        """Without texels that see nothing: they lie within the surface, as an eyeball does behind its lids, and must
        not darken what is beside them."""
        seeing = self.direct.any((1, 2)) | (np.diff(self.bounce.indptr) > 0)
        return GroupResult(self.texels[seeing], self.direct[seeing], self.bounce[seeing])


def covered_texels(surface: SyntheticSurface, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat texel indices [T] that the UV layout covers, their face [T] and corner weights [T, 3]."""
    face, bary = rasterize_uv(surface.mesh, size)
    texels = np.nonzero(face.ravel() >= 0)[0]
    return texels, face.ravel()[texels], bary.reshape(-1, 3)[texels]


def group_irradiance(surface: SyntheticSurface, lights: list[EnvironmentLight], shots: list[SyntheticShot], group: int,
                     quality: IrradianceQuality, seed: int, only: np.ndarray | None = None) -> GroupResult:
    """Traces one of `quality.groups` groups of texels; independent of all others. only [size^2] bool: the texels that
    are asked for, all if None."""
    rng = np.random.default_rng([seed, group])
    texels, face, bary = covered_texels(surface, quality.size)
    chosen = np.random.default_rng(seed).integers(quality.groups, size=len(texels)) == group
    if only is not None:
        chosen &= only[texels]
    points = surface.points(face[chosen], bary[chosen])
    directions = (fibonacci_sphere(quality.directions) @ random_rotation(rng).T).astype(np.float32)
    incident = np.stack([lights[shot.light].smooth_radiance(directions @ shot.world_from_head.T.astype(np.float32))
                         for shot in shots], 1)
    incident = (incident * (4 * np.pi / quality.directions)).reshape(quality.directions, -1)
    lamps = _lamp_samples(lights, shots, quality.lamp_samples, rng)
    direct, rows = [], []
    for start in range(0, len(points.position), BATCH):
        batch = points.select(slice(start, start + BATCH))
        visible, bounce = _trace_directions(surface, batch, directions, quality.size)
        smooth = (visible @ incident).reshape(len(visible), len(shots), 3)
        direct.append(smooth + _lamp_irradiance(surface, lights, shots, batch, *lamps))
        rows.append(bounce)
    return GroupResult(texels[chosen], np.concatenate(direct), sparse.vstack(rows, format="csr"))


def _trace_directions(surface: SyntheticSurface, points: ShadingPoints, directions: np.ndarray,
                      size: int) -> tuple[np.ndarray, sparse.csr_matrix]:
    """Cosines of unblocked directions [T, D] (0 where blocked), and form factors [T, size^2] to the texels hit."""
    cosine = points.normal @ directions.T
    row, column = np.nonzero((cosine > 0) & (points.geometric_normal @ directions.T > 0))
    index, uv, free = surface.hits(points.origins[row], directions[column])
    visible = np.zeros_like(cosine)
    visible[row[free], column[free]] = cosine[row[free], column[free]]
    weight = cosine[row[index], column[index]] * np.float32(4.0 / len(directions))
    entries = (weight, (row[index], nearest_texel(uv, size)))
    return visible, sparse.coo_matrix(entries, shape=(len(cosine), size * size)).tocsr()


def _lamp_samples(lights: list[EnvironmentLight], shots: list[SyntheticShot], count: int,
                  rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Head-space directions [S, K, 3] and weights [S, K, 3] (1 / K included) of each shot's lamps."""
    points = shifted_hammersley(count, len(shots), rng)
    samples = [lights[shot.light].sample_lamps(points[i]) for i, shot in enumerate(shots)]
    directions = np.stack([world @ shot.world_from_head for (world, _), shot in zip(samples, shots, strict=True)])
    return directions.astype(np.float32), np.stack([weight / count for _, weight in samples]).astype(np.float32)


def _lamp_irradiance(surface: SyntheticSurface, lights: list[EnvironmentLight], shots: list[SyntheticShot],
                     points: ShadingPoints, directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[T, S, 3] irradiance of the shots' lamps, from their samples [S, K, 3]."""
    near = np.array([lights[shot.light].lamps_at is not None for shot in shots])
    far = [shot for shot, is_near in zip(shots, near, strict=True) if not is_near]
    total = np.zeros((len(points.position), len(shots), 3), np.float32)
    if far:
        share = _visible_lamp_share(surface, points, directions[~near], weights[~near])
        total[:, ~near] = share * _unblocked_lamps(lights, far, points.normal)
    for s in np.nonzero(near)[0]:
        lamps = shots[s].in_head_space(lights[shots[s].light].lamps_at)
        total[:, s] = _near_lamp_irradiance(surface, points, lamps, directions[s], weights[s])
    return total


def _near_lamp_irradiance(surface: SyntheticSurface, points: ShadingPoints, lamps: LampSphere, directions: np.ndarray,
                          weights: np.ndarray) -> np.ndarray:
    """[T, 3] irradiance of near lamps in one shot, from samples [K, 3] of them as their centre sees them."""
    towards, gain = lamps.seen_from(points.position, directions)
    cosine = np.einsum("tkc,tc->tk", towards, points.normal)
    above = np.einsum("tkc,tc->tk", towards, points.geometric_normal) > 0
    row, column = np.nonzero((cosine > 0) & above)
    free = ~surface.scene.occluded(points.origins[row], towards[row, column])
    lit = np.zeros_like(cosine)
    lit[row[free], column[free]] = (cosine * gain)[row[free], column[free]]
    return lit @ weights


def _unblocked_lamps(lights: list[EnvironmentLight], shots: list[SyntheticShot], normals: np.ndarray) -> np.ndarray:
    """[T, S, 3] irradiance of each shot's lamps on normals [T, 3] when nothing is in the way."""
    turned = (normals @ shot.world_from_head.T.astype(np.float32) for shot in shots)
    return np.stack([lights[shot.light].lamp_irradiance(world) for shot, world in zip(shots, turned, strict=True)], 1)


def _visible_lamp_share(surface: SyntheticSurface, points: ShadingPoints, directions: np.ndarray,
                        weights: np.ndarray) -> np.ndarray:
    """[T, S, 3] which share of the lamps' irradiance arrives, from the lamp samples [S, K, 3].

    A share times the exact irradiance has no noise where all or nothing arrives, only in half shadows.
    """
    shots, count, _ = directions.shape
    flat = directions.reshape(-1, 3)
    cosine = points.normal @ flat.T
    useful = (cosine > 0) & (points.geometric_normal @ flat.T > 0) & (weights.sum(-1).ravel() > 0)
    row, column = np.nonzero(useful)
    blocked = surface.scene.occluded(points.origins[row], flat[column])
    lit = np.zeros_like(cosine)
    lit[row[~blocked], column[~blocked]] = cosine[row[~blocked], column[~blocked]]
    arriving, sent = (
        np.einsum("tsk,skc->tsc", part.reshape(-1, shots, count), weights, optimize=True)
        for part in (lit, np.maximum(cosine, 0))
    )
    return arriving / np.maximum(sent, 1e-12)


def assemble_atlas(
    surface: SyntheticSurface, results: list[GroupResult], size: int, bounces: int = IrradianceQuality.bounces
) -> np.ndarray:
    """[size, size, S, 3] float32: direct light plus bounces, borders of the UV islands continued outwards."""
    texels = np.concatenate([result.texels for result in results])
    shape = results[0].direct.shape[1:]
    direct = np.zeros((size * size, *shape), np.float32)
    direct[texels] = np.concatenate([result.direct for result in results])
    source = _nearest_covered(texels, size)
    albedo = _texel_albedo(surface, size)
    total = direct
    for _ in range(bounces):
        radiosity = (albedo[:, None] * total)[source].reshape(size * size, -1)
        total = direct.copy()
        for result in results:
            total[result.texels] += (result.bounce @ radiosity).reshape(-1, *shape)
    return total[source].reshape(size, size, *shape)


def refresh_atlas(surface: SyntheticSurface, atlas: np.ndarray, results: list[GroupResult], near: np.ndarray,
                  size: int) -> np.ndarray:
    """Atlas [size, size, S, 3] of S shots with the texels near [size^2] bool traced anew, where the surface has moved a
    little since: what all others send there is as it was."""
    shape = results[0].direct.shape[1:]
    total = atlas.reshape(size * size, *shape).copy()
    kept = covered_texels(surface, size)[0]
    texels = np.concatenate([kept[~near[kept]], *(result.texels for result in results)])
    source = _nearest_covered(texels, size)
    albedo = _texel_albedo(surface, size)
    for _ in range(REFRESHED_BOUNCES):
        radiosity = (albedo[:, None] * total[source]).reshape(size * size, -1)
        for result in results:
            total[result.texels] = result.direct + (result.bounce @ radiosity).reshape(-1, *shape)
    return total[source].reshape(size, size, *shape)


def _texel_albedo(surface: SyntheticSurface, size: int) -> np.ndarray:
    """[size^2, 3]."""
    centres = (np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2) + 0.5) / size
    return surface.albedo(centres * [1, -1] + [0, 1]).astype(np.float32)


def _nearest_covered(texels: np.ndarray, size: int) -> np.ndarray:
    """[size^2] flat index of the covered texel nearest to each texel."""
    empty = np.ones(size * size, bool)
    empty[texels] = False
    row, column = distance_transform_edt(empty.reshape(size, size), return_distances=False, return_indices=True)
    return (row * size + column).ravel()
