"""A lamp that stands near: each point of the head sees it in another direction and at another strength.

The light is a cubemap as the head's mean place sees it. Those of its texels that lie within a cone about the lamp stand
at a distance D from that place c, all others are far away. A source in direction w of the cube is seen from a point x

    in direction u / |u|, 1 / |u|^2 times as bright as from c,        u = w + (c - x) / D

which is parallax and the inverse square of the distance; a source is small and shines alike to all sides. Far away
1 / D is 0 and u is w. As the head moves, c moves through head space, and the lamp against the head.

Texels are split into sources about two degrees apart, with radiances interpolated bilinearly as envmap does. Whether a
point sees a source is what it knows of the direction of its set that lies nearest. Other than in transfer, where all
points see the same light along one set of directions, there is a row of texels for each point in each frame; these are
few, so that the rows cost less than the directions that a far lamp is split into.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from shared.compute.compiled import compiled, compiled_part
from shared.compute.threads import share_out, thread_count
from shared.geometry.mesh import normalised
from shared.geometry.transforms import places_in_world, world_from_head
from shared.rendering.envmap import (
    cube_directions,
    cube_lookup,
    cube_resolution,
    cube_solid_angles,
    latlong_directions,
    latlong_from_cube,
)
from shared.rendering.lobes import weigh_directions
from shared.rendering.transfer import Points

FAR = np.inf
FINE = 40
"""Sources along an edge of a cubemap's face, at least."""
_TABLE = 256
_POINTS_PER_BLOCK = 256


@dataclass(frozen=True)
class NearLamp:
    """Where it stands: distance_mm (FAR: far away) along axis, a unit vector, from centre, mm, in world space; texels
    within radius, radians, of the axis belong to it."""

    distance_mm: float
    centre: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float

    @classmethod
    def of_record(cls, record: Mapping[str, object]) -> NearLamp | None:
        """The lamp that solve.json and run.json tell of (`lamp`); None where it is far."""
        if "centre_mm" not in record:
            return None
        away = np.subtract(record["position_mm"], record["centre_mm"])
        distance = float(np.linalg.norm(away))
        return cls(distance, tuple(record["centre_mm"]), tuple((away / distance).tolist()), record["reach"])

    @property
    def position(self) -> np.ndarray:
        """[3] mm, world space."""
        return np.array(self.centre) + self.distance_mm * np.array(self.axis)

    def seen_from(self, place: np.ndarray, resolution: int) -> NearLamp:
        """The same lamp as belongs to the light that latlong_at sees from another place [3] mm of world space;
        resolution: of the light here."""
        sources = self.centre + self.distance_mm * cube_directions(resolution)[self.texels(resolution)] - place
        away = self.position - place
        distance = float(np.linalg.norm(away))
        cosine = (normalised(sources) @ away / distance).min()
        radius = float(np.arccos(np.clip(cosine, -1.0, 1.0)) + 1.0 / resolution)
        return NearLamp(distance, tuple(place.tolist()), tuple((away / distance).tolist()), radius)

    def texels(self, resolution: int) -> np.ndarray:
        """[K] int: texels of a cubemap that belong to it; at least the nearest."""
        cosine = cube_directions(resolution) @ np.array(self.axis)
        return np.union1d(np.nonzero(cosine >= np.cos(self.radius))[0], cosine.argmax())


@dataclass(frozen=True)
class SeenLamp:
    """A lamp as F frames have it: world_from_head [F, 3, 3], and its centre in head space, centres [F, 3] mm."""

    lamp: NearLamp
    world_from_head: np.ndarray
    centres: np.ndarray

    @classmethod
    def of(cls, lamp: NearLamp, camera_from_head: np.ndarray, moves: str) -> SeenLamp:
        """In frames with poses [F, 4, 4], of a head or a camera that moves."""
        turns = world_from_head(camera_from_head, moves)
        away = np.array(lamp.centre) - places_in_world(camera_from_head, moves)
        return cls(lamp, turns, np.einsum("fji,fj->fi", turns, away))


def without_lamp(light: np.ndarray, lamp: NearLamp) -> np.ndarray:
    """A light [6 n^2, 3] with its lamp dark: what is far away."""
    far = np.array(light)
    far[lamp.texels(cube_resolution(light))] = 0.0
    return far


def latlong_at(light: np.ndarray, lamp: NearLamp, place: np.ndarray, height: int, samples: int = 2) -> np.ndarray:
    """[height, 2 height, 3] float32: a light [6 n^2, 3] as another place [3] mm of world space sees it; each pixel the
    mean of samples^2 directions.

    Along d it sees the source in direction w = e + s d, with e from the centre to the place in units of the distance.
    It shines alike to all sides, so that its radiance grows as the cosine between w and d falls.
    """
    far = without_lamp(light, lamp)
    resolution = cube_resolution(light)
    directions = latlong_directions(height, samples).reshape(-1, 3)
    offset = (np.asarray(place) - lamp.centre) / lamp.distance_mm
    along = directions @ offset
    source = offset + (np.sqrt(along**2 - offset @ offset + 1.0) - along)[:, None] * directions
    near = (cube_lookup(source, resolution) @ (light - far)) / (source * directions).sum(1, keepdims=True)
    blocks = near.reshape(height, samples, 2 * height, samples, 3)
    return latlong_from_cube(far, height, samples) + blocks.mean((1, 3)).astype(np.float32)


class LampView:
    """What points see of a lamp in F frames: sources of a cubemap of a resolution, and where visibility is looked up.

    directions [J, 3]: a direction_set, along which the points' visibility is known. texels [K]: of the lamp; share
    [M, K]: irradiance over pi that source m gives at the centre, seen head-on, per radiance of texel k.
    """

    def __init__(self, seen: SeenLamp, resolution: int, directions: np.ndarray):
        self.texels = seen.lamp.texels(resolution)
        parts = -(-FINE // resolution)
        sources = cube_directions(parts * resolution)
        reach = seen.lamp.radius + 3.0 / resolution
        near = np.nonzero(sources @ np.array(seen.lamp.axis) >= np.cos(min(reach, np.pi)))[0]
        share = cube_lookup(sources[near], resolution)[:, self.texels]
        lit = np.diff(share.indptr) > 0
        solid = cube_solid_angles(parts * resolution)[near[lit]]
        self.share = (sparse.diags(solid / np.pi) @ share[lit]).tocsr().astype(np.float32)
        self.nearness = 1.0 / seen.lamp.distance_mm
        in_head = np.einsum("fij,mi->fmj", seen.world_from_head, sources[near[lit]])
        # u = w + c / D - x / D: the first two are the same for all points.
        self.sources = np.ascontiguousarray(in_head + self.nearness * seen.centres[:, None], np.float32)
        self._directions = np.ascontiguousarray(normalised(directions), np.float32)

    @cached_property
    def _nearest(self) -> np.ndarray:
        """[_TABLE^2] the direction of the set nearest to each cell of an octahedral map."""
        centres = (np.arange(_TABLE) + 0.5) / _TABLE * 2.0 - 1.0
        b, a = np.meshgrid(centres, centres, indexing="ij")
        z = 1.0 - np.abs(a) - np.abs(b)
        x = np.where(z < 0, (1.0 - np.abs(b)) * np.sign(a), a)
        y = np.where(z < 0, (1.0 - np.abs(a)) * np.sign(b), b)
        cells = normalised(np.stack([x, y, z], -1).reshape(-1, 3))
        return cKDTree(self._directions).query(cells, workers=thread_count())[1].astype(np.int32)

    def radiance(self, light: np.ndarray) -> np.ndarray:
        """A cubemap's radiance [6 n^2, 3] -> [M, 3]: irradiance over pi of each source at the centre, seen head-on."""
        return np.ascontiguousarray(self.share @ light[self.texels].astype(np.float32))

    def irradiance_rows(self, points: Points, visible: np.ndarray) -> np.ndarray:
        """[P, F, K] float32: irradiance over pi of the points by the texels' radiance; visible [P, J] bool."""
        rows = np.zeros((len(points), len(self.sources), len(self.texels)), np.float32)
        place, normals = self._place(points)
        share = self.share
        self._in_blocks(len(points), lambda part: _irradiance_rows(
            place[part], normals[part], visible[part], self.sources, self._directions, self._nearest, share.indptr,
            share.indices, share.data, rows[part]))
        return rows

    def lobe_rows(self, points: Points, visible: np.ndarray, towards: np.ndarray, alpha2: np.ndarray) -> np.ndarray:
        """[P, F, K] float32: reflection at specular intensity 1 by the texels' radiance, to cameras in unit directions
        towards [P, F, 3]; alpha2 [P]: GGX alpha^2; visible [P, J] bool."""
        rows = np.zeros((len(points), len(self.sources), len(self.texels)), np.float32)
        (place, normals), towards = self._place(points), np.ascontiguousarray(towards, np.float32)
        share = self.share
        self._in_blocks(len(points), lambda part: _lobe_rows(
            place[part], normals[part], visible[part], self.sources, self._directions, self._nearest, towards[part],
            alpha2[part], share.indptr, share.indices, share.data, rows[part]))
        return rows

    def vectors(self, points: Points, visible: np.ndarray, radiance: np.ndarray) -> np.ndarray:
        """[P, F, 3 channels, 3] float32: W of the sources, so that n . W is the irradiance over pi; radiance [M, 3];
        visible [P, J] bool."""
        result = np.zeros((len(points), len(self.sources), 3, 3), np.float32)
        place, normals = self._place(points)
        self._in_blocks(len(points), lambda part: _vectors(
            place[part], normals[part], visible[part], self.sources, self._directions, self._nearest, radiance,
            result[part]))
        return result

    def irradiance(self, points: Points, visible: np.ndarray, radiance: np.ndarray) -> np.ndarray:
        """[P, F, 3] float32: irradiance over pi of points by sources of radiance [M, 3]; visible [P, J] bool."""
        normals = points.normals.astype(np.float32)
        return np.einsum("pfcx,px->pfc", self.vectors(points, visible, radiance), normals)

    def reflection(
        self, points: Points, visible: np.ndarray, towards: np.ndarray, alpha2: np.ndarray, radiance: np.ndarray,
        frame: int,
    ) -> np.ndarray:
        """[P, 3] float32: reflection at specular intensity 1 in one frame; towards [P, 3] unit, alpha2 [P], radiance
        [M, 3]; visible [P, J] bool."""
        result = np.zeros((len(points), 3), np.float32)
        place, normals = self._place(points)
        _reflection(place, normals, visible, self.sources[frame], self._directions, self._nearest,
                    np.ascontiguousarray(towards, np.float32), alpha2, radiance, result)
        return result

    def take(self, frames: np.ndarray | slice) -> LampView:
        """In some of the frames."""
        other = object.__new__(LampView)
        other.__dict__.update(self.__dict__, sources=self.sources[frames], _nearest=self._nearest)
        return other

    def _place(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """x / D and the normals, [P, 3] float32."""
        return (self.nearness * points.positions).astype(np.float32), np.ascontiguousarray(points.normals, np.float32)

    @staticmethod
    def _in_blocks(count: int, work) -> None:
        blocks = [slice(first, first + _POINTS_PER_BLOCK) for first in range(0, count, _POINTS_PER_BLOCK)]
        share_out(len(blocks), lambda k: work(blocks[k]))


@compiled_part
def _see(place, normal, visible, sources, directions, nearest, seen):
    """The sources [M, 3] as one point sees them -> seen [4, M]: unit directions, and the inverse square of the
    distance, 0 where the point does not see it."""
    one, half, size = np.float32(1.0), np.float32(0.5), np.float32(_TABLE)
    for m in range(len(sources)):
        x, y, z = sources[m, 0] - place[0], sources[m, 1] - place[1], sources[m, 2] - place[2]
        gain = one / (x * x + y * y + z * z)
        scale = np.sqrt(gain)
        x, y, z = x * scale, y * scale, z * scale
        seen[0, m], seen[1, m], seen[2, m], seen[3, m] = x, y, z, np.float32(0.0)
        if normal[0] * x + normal[1] * y + normal[2] * z > 0:
            scale = one / (abs(x) + abs(y) + abs(z))
            a, b = x * scale, y * scale
            if z < 0:
                a, b = (one - abs(b)) * (one if a >= 0 else -one), (one - abs(a)) * (one if b >= 0 else -one)
            column, row = int((a * half + half) * size), int((b * half + half) * size)
            j = nearest[min(row, _TABLE - 1) * _TABLE + min(column, _TABLE - 1)]
            below = normal[0] * directions[j, 0] + normal[1] * directions[j, 1] + normal[2] * directions[j, 2] <= 0
            if visible[j] or below:  # of a direction below the horizon nothing is known
                seen[3, m] = gain


@compiled
def _irradiance_rows(place, normals, visible, sources, directions, nearest, first, texel, share, rows):
    seen = np.empty((4, sources.shape[1]), np.float32)
    for p in range(len(place)):
        for f in range(len(sources)):
            _see(place[p], normals[p], visible[p], sources[f], directions, nearest, seen)
            for m in range(seen.shape[1]):
                cosine = normals[p, 0] * seen[0, m] + normals[p, 1] * seen[1, m] + normals[p, 2] * seen[2, m]
                weight = seen[3, m] * cosine
                if weight > 0:
                    for k in range(first[m], first[m + 1]):
                        rows[p, f, texel[k]] += weight * share[k]


@compiled
def _lobe_rows(place, normals, visible, sources, directions, nearest, towards, alpha2, first, texel, share, rows):
    count = sources.shape[1]
    seen, weights = np.empty((4, count), np.float32), np.empty(count, np.float32)
    scale = np.float32(0.25 * count)  # weigh_directions counts 4 pi / M of solid angle, share is over pi
    for p in range(len(place)):
        for f in range(len(sources)):
            _see(place[p], normals[p], visible[p], sources[f], directions, nearest, seen)
            weigh_directions(normals[p], towards[p, f], alpha2[p], seen, weights)
            for m in range(count):
                weight = scale * weights[m]
                if weight > 0:
                    for k in range(first[m], first[m + 1]):
                        rows[p, f, texel[k]] += weight * share[k]


@compiled
def _vectors(place, normals, visible, sources, directions, nearest, radiance, result):
    seen = np.empty((4, sources.shape[1]), np.float32)
    for p in range(len(place)):
        for f in range(len(sources)):
            _see(place[p], normals[p], visible[p], sources[f], directions, nearest, seen)
            for m in range(seen.shape[1]):
                if seen[3, m] > 0:
                    for c in range(3):
                        value = seen[3, m] * radiance[m, c]
                        for x in range(3):
                            result[p, f, c, x] += value * seen[x, m]


@compiled
def _reflection(place, normals, visible, sources, directions, nearest, towards, alpha2, radiance, result):
    count = len(sources)
    seen, weights = np.empty((4, count), np.float32), np.empty(count, np.float32)
    scale = np.float32(0.25 * count)
    for p in range(len(place)):
        _see(place[p], normals[p], visible[p], sources, directions, nearest, seen)
        weigh_directions(normals[p], towards[p], alpha2[p], seen, weights)
        for m in range(count):
            for c in range(3):
                result[p, c] += scale * weights[m] * radiance[m, c]
