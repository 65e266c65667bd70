"""Irradiance and reflection at a mesh's vertices in every frame, for the texture pass and for re-rendering.

Vertices that no frame faces are left out; they, and those deep in a cavity, take what the nearest shaded vertex has. A
fitted head is accurate to some tenths of a millimetre at best: between its lips or inside a nostril, where nearly all
of the sky is covered, its own visibility says nothing, and would turn a closed mouth into a black slit.

Irradiance (with bounces) of all frames is one product, kept as half floats (6 bytes per vertex and frame); lobe sums
depend on the camera and are made for key frames, a few degrees of turn apart. A lamp that stands near adds to both what
each vertex sees of it.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from threading import Lock

import numpy as np
from scipy.spatial import cKDTree

from shared.compute.threads import share_out, thread_count
from shared.geometry.mesh import normalised
from shared.geometry.transforms import camera_centres, vector_from_rotation, world_from_head
from shared.rendering.brdf import hemispherical_albedo
from shared.rendering.envmap import cube_resolution, frame_lookup
from shared.rendering.irradiance_errors import SHADOW_MM, irradiance_slope, shadow_uncertainty
from shared.rendering.lobes import SpecularTransfer, specular_reflection
from shared.rendering.near_lamp import LampView, NearLamp, SeenLamp, without_lamp
from shared.rendering.transfer import Points, Transfer, bounced_irradiance, irradiance, node_radiosity

KEY_STEP = 0.05
"""Radians between frames whose lobe sums are computed (3 degrees)."""

DEEP = 0.9
"""Cosine-weighted share of the hemisphere that the head itself covers, from which on a point counts as in a cavity."""

_POINTS_PER_BLOCK, _POINTS_PER_PRODUCT = 512, 2048

LARGEST_SHARE = 0.95
"""Of the light that arrives, what a surface can send on: were it all of it, bounces would not end."""


@dataclass(frozen=True)
class Material:
    """What shading needs to know of the surface: for bounces node_albedo [K, 3], mean specular_intensity and roughness;
    local_roughness [P] of the shaded points where it varies."""

    node_albedo: np.ndarray
    specular_intensity: float
    roughness: float
    local_roughness: np.ndarray | None = None

    def bounce_albedo(self) -> np.ndarray:
        """[K, 3] fraction of light that a node sends on, its specular share included as if it were diffuse; under 1 for
        materials that no skin has, too."""
        share = self.node_albedo + self.specular_intensity * hemispherical_albedo(round(self.roughness, 3))
        return np.minimum(share, LARGEST_SHARE)


class VertexShading:
    """E and S of V vertices under a cubemap light in F frames. light_along [J, F, 3]: the light along the directions as
    the head's mean place sees it; far_along: without what stands near.

    index [P]: the vertices that are shaded, out of all, vertices [V, 3]; points, transfer [P]: theirs; node_transfer:
    the nodes'; light [6 n^2, 3]; directions [J, 3]; camera_from_head [F, 4, 4]; moves: "head" or "camera"; bounce:
    count light that bounced; key_step: largest turn between two frames whose reflections are computed, radians; deep:
    covered share from which on a vertex takes what the nearest one in the open has; light_index [F]: which of several
    lights, one below the other, each frame stands in, frames of one light in a row; None: there is one; lamp: of the
    light, where it stands near, None: all of it is far away; node_points: where the nodes are, asked for with a lamp.
    """

    def __init__(
        self,
        index: np.ndarray,
        vertices: np.ndarray,
        points: Points,
        transfer: Transfer,
        node_transfer: Transfer,
        material: Material,
        light: np.ndarray,
        directions: np.ndarray,
        camera_from_head: np.ndarray,
        moves: str,
        bounce: bool = True,
        key_step: float = KEY_STEP,
        deep: float = DEEP,
        light_index: np.ndarray | None = None,
        lamp: NearLamp | None = None,
        node_points: Points | None = None,
    ):
        self.material, self.directions = material, directions
        self._deep, self._key_step = deep, key_step
        self._nodes, self._node_points = node_transfer if bounce else None, node_points
        self._place(index, vertices, points, transfer)
        self._light(light, camera_from_head, moves, light_index, lamp)

    @property
    def index(self) -> np.ndarray:
        """[P] int: the vertices that are shaded."""
        return self._index

    def of_points(
        self, index: np.ndarray, vertices: np.ndarray, points: Points, transfer: Transfer, material: Material
    ) -> VertexShading:
        """Other points of the same head, whose nodes and their albedo are the same, under the same light in the same
        frames; the arguments are those of the class."""
        other = copy(self)
        other.material = material
        other._place(index, vertices, points, transfer)
        other._receive()
        return other

    def under(
        self,
        light: np.ndarray,
        camera_from_head: np.ndarray,
        moves: str,
        light_index: np.ndarray | None = None,
        lamp: NearLamp | None = None,
    ) -> VertexShading:
        """The same surface under another light, or under several, in other frames; the arguments are those of the
        class."""
        other = copy(self)
        other._light(light, camera_from_head, moves, light_index, lamp)
        return other

    def _place(self, index, vertices, points, transfer) -> None:
        self._vertices, self._index, self.points, self.transfer = vertices, index, points, transfer
        self.table = SpecularTransfer(points.normals, transfer.visibility(), self.directions)
        self.__dict__.pop("stand_in", None)

    def _light(self, light, camera_from_head, moves, light_index, lamp=None) -> None:
        turns = world_from_head(camera_from_head, moves)
        self.light_along = self.far_along = light_along(light, self.directions, turns, light_index)
        self._cube, self._turns, self._light_index = light, turns, light_index
        self._lamp = None
        if lamp is not None:
            self._lamp = LampShine.of(light, SeenLamp.of(lamp, camera_from_head, moves), self.directions)
            self.far_along = light_along(self._lamp.far, self.directions, turns, light_index)
        self._node_light = None if self._nodes is None else self._sent_by_nodes()
        self._centres = camera_centres(camera_from_head)
        self._turn = turned_so_far(camera_from_head)
        if light_index is not None:  # so that no frame lies between key frames of two lights
            self._turn += 2.0 * np.pi * light_index
        self._keys = key_frames(self._turn, self._key_step)
        self._receive()

    def _receive(self) -> None:
        shape = (len(self.points), *self.light_along.shape[1:])
        lights = self.far_along.reshape(len(self.directions), -1)
        # A frame's values lie side by side, since frames are asked for one by one.
        self._irradiance, self._bounced = np.zeros((2, shape[1], shape[0], 3), np.float16).transpose(0, 2, 1, 3)

        def sum_up(block: int) -> None:
            rows = slice(block * _POINTS_PER_PRODUCT, (block + 1) * _POINTS_PER_PRODUCT)
            part = self.transfer.take(rows)
            total = irradiance(part, lights).reshape(-1, *shape[1:])
            if self._lamp is not None:
                total += self._lamp.irradiance(self.points.take(rows), self.table.visible[rows])
            if self._node_light is not None:
                bounced = bounced_irradiance(part, self._node_light).reshape(total.shape)
                self._bounced[rows] = bounced
                total += bounced
            self._irradiance[rows] = total

        share_out(-(-shape[0] // _POINTS_PER_PRODUCT), sum_up)
        self._key_reflection: dict[int, np.ndarray] = {}
        self._key_uncertainty: np.ndarray | None = None
        self._once = Lock()  # several threads ask for frames; what they share is made by the first

    def _sent_by_nodes(self) -> np.ndarray:
        """[K, F * 3]: the nodes' radiosity over pi, with all diffuse bounces."""
        flat = self.far_along.reshape(len(self.directions), -1)
        direct = irradiance(self._nodes, flat).reshape(-1, *self.light_along.shape[1:])
        if self._lamp is not None:
            direct += self._lamp.irradiance(self._node_points, self._nodes.visibility())
        return node_radiosity(self._nodes, self.material.bounce_albedo(), direct).reshape(len(direct), -1)

    def arriving(self, frame: int, directions: np.ndarray) -> np.ndarray:
        """[n, 3]: the light of a frame along unit directions [n, 3] in head space, as the head's mean place sees it,
        whatever covers it."""
        own = None if self._light_index is None else self._light_index[frame : frame + 1]
        texels = len(self._cube) if own is None else len(self._cube) // (int(self._light_index.max()) + 1)
        first = 0 if own is None else int(own[0]) * texels
        lookup = frame_lookup(directions, self._turns[frame : frame + 1], round((texels / 6) ** 0.5))
        return lookup @ np.asarray(self._cube[first : first + texels], np.float64)

    @cached_property
    def stand_in(self) -> np.ndarray:
        """[V]: for each vertex the place in index of the nearest shaded vertex in the open, its own where it is one."""
        return _stand_ins(self._vertices, self._index, self.transfer.blocked, self._deep)

    def irradiance(self, frame: int) -> np.ndarray:
        """E [V, 3] float32 over pi."""
        return self._irradiance[:, frame].astype(np.float32)[self.stand_in]

    def mean_irradiance(self, frames: slice | np.ndarray = slice(None)) -> np.ndarray:
        """[V, 3] float32: E averaged over the frames, or over some of them."""
        return self._irradiance[:, frames].mean(1, dtype=np.float32)[self.stand_in]

    def mean_slope(self, frames: slice | np.ndarray = slice(None)) -> np.ndarray:
        """[V, 3] float32: by how much the mean irradiance changes per radian that the normal turns, at most."""
        light = self.light_along[:, frames].mean(1)
        return irradiance_slope(self.transfer, self.points.normals, light, self.directions)[self.stand_in]

    def reflection(self, frame: int) -> np.ndarray:
        """S [V, 3] float32 at specular_intensity 1, between the two key frames around this one.

        Lobes of skin are 20 degrees wide and more: linear interpolation over a turn of three is exact to 1 % of them.
        """
        return self._between_keys(frame, self._at_key)

    def shadow_uncertainty(self, frame: int) -> np.ndarray:
        """[V, 3] float32: standard deviation of E, given how far off the borders of shadows may be."""
        with self._once:
            if self._key_uncertainty is None:
                light = self.light_along[:, self._keys].reshape(len(self.directions), -1)
                uncertainty = shadow_uncertainty(self.points, self.transfer, light, self.directions, SHADOW_MM)
                self._key_uncertainty = uncertainty.reshape(len(self.points), len(self._keys), 3).astype(np.float16)
        return self._between_keys(frame, lambda key: self._key_uncertainty[:, np.searchsorted(self._keys, key)])

    def _between_keys(self, frame: int, at_key: Callable[[int], np.ndarray]) -> np.ndarray:
        """[V, 3] float32 of what at_key says [P, 3] of the two key frames around a frame."""
        after = int(np.searchsorted(self._keys, frame))
        high = int(self._keys[after])
        low = high if high == frame else int(self._keys[after - 1])
        share = (self._turn[frame] - self._turn[low]) / max(self._turn[high] - self._turn[low], 1e-12)
        value = at_key(low).astype(np.float32)
        if high != low:
            value += np.float32(share) * (at_key(high).astype(np.float32) - value)
        return value[self.stand_in]

    def irradiance_of_points(self, rows: np.ndarray) -> np.ndarray:
        """E [n, F, 3] float32 of some of the P points, rows [n] int, each its own, in all frames."""
        return self._irradiance[rows].astype(np.float32)

    def roughness_of(self, rows: np.ndarray) -> float | np.ndarray:
        """Of some of the P points, rows [n] int: [n] where it varies."""
        local = self.material.local_roughness
        return self.material.roughness if local is None else np.maximum(local[rows], self.table.narrowest)

    def towards_camera(self, frame: int) -> np.ndarray:
        """[P, 3] unit vectors from the points to the camera."""
        return normalised(self._centres[frame] - self.points.positions)

    def blocked_light(self, frame: int) -> np.ndarray:
        """[P, 3] float32: mean radiance of what of the head itself stands before the points."""
        return self._bounced[:, frame].astype(np.float32) / np.maximum(self.transfer.blocked, 1e-3)[:, None]

    def _at_key(self, frame: int) -> np.ndarray:
        """S of the shaded vertices in one frame [P, 3], half floats; made once."""
        with self._once:
            if frame not in self._key_reflection:
                self._key_reflection[frame] = self._reflection_of_points(frame)
            return self._key_reflection[frame]

    def _reflection_of_points(self, frame: int) -> np.ndarray:
        towards, blocked = self.towards_camera(frame), self.blocked_light(frame)
        facing = np.nonzero((towards * self.points.normals).sum(1) > -0.1)[0]
        value = np.zeros((len(self.points), 3), np.float16)

        def reflect(k: int) -> None:
            rows = facing[k * _POINTS_PER_BLOCK : (k + 1) * _POINTS_PER_BLOCK]
            value[rows] = self.reflection_by(self.table.take(rows), rows, towards[rows], frame, blocked[rows])

        share_out(-(-len(facing) // _POINTS_PER_BLOCK), reflect)
        return value

    def reflection_by(
        self, table: SpecularTransfer, rows: np.ndarray, towards: np.ndarray, frame: int, blocked_light: np.ndarray
    ) -> np.ndarray:
        """S [n, 3] float32 of some of the P points, rows [n] int, in a frame, with the normals of a table of theirs;
        towards [n, 3] unit; blocked_light [n, 3]: see there."""
        roughness = self.roughness_of(rows)
        value = specular_reflection(table, towards, roughness, self.far_along[:, frame], blocked_light)
        if self._lamp is not None:
            points = Points(self.points.positions[rows], table.normals)
            value += self._lamp.reflection(points, table.visible, towards, table.alpha2(roughness), frame)
        return value

    def lamp_vectors(self, rows: np.ndarray, frames: np.ndarray | slice = slice(None)) -> np.ndarray | float:
        """[n, F, 3 channels, 3] float32 of some of the P points, rows [n] int, in some frames: W of the near lamp, with
        n . W its direct irradiance over pi; 0 where no lamp is near."""
        if self._lamp is None:
            return 0.0
        return self._lamp.vectors(self.points.take(rows), self.table.visible[rows], frames)


@dataclass(frozen=True)
class LampShine:
    """A near lamp of a known light: what is seen of it, its sources' radiance [M, 3], and the light without it, far
    [6 n^2, 3]."""

    view: LampView
    radiance: np.ndarray
    far: np.ndarray

    @classmethod
    def of(cls, light: np.ndarray, seen: SeenLamp, directions: np.ndarray) -> LampShine:
        """That of a cubemap light [6 n^2, 3], for points whose visibility is known along directions [J, 3]."""
        view = LampView(seen, cube_resolution(light), directions)
        return cls(view, view.radiance(light), without_lamp(light, seen.lamp))

    def vectors(self, points: Points, visible: np.ndarray, frames: np.ndarray | slice) -> np.ndarray:
        """[P, F, 3 channels, 3]: W of points in some frames; visible [P, J] bool."""
        return self.view.take(frames).vectors(points, visible, self.radiance)

    def irradiance(self, points: Points, visible: np.ndarray) -> np.ndarray:
        """[P, F, 3] over pi, without bounces; visible [P, J] bool."""
        return self.view.irradiance(points, visible, self.radiance)

    def reflection(
        self, points: Points, visible: np.ndarray, towards: np.ndarray, alpha2: np.ndarray, frame: int
    ) -> np.ndarray:
        """[P, 3] at specular intensity 1 in one frame; visible [P, J] bool, towards [P, 3] unit, alpha2 [P]."""
        return self.view.reflection(points, visible, towards, alpha2, self.radiance, frame)


def _stand_ins(vertices: np.ndarray, index: np.ndarray, blocked: np.ndarray, deep: float) -> np.ndarray:
    """What VertexShading.stand_in says."""
    open_points = np.nonzero(blocked < deep)[0]
    if len(open_points) == 0:
        open_points = np.arange(len(index))
    result = np.full(len(vertices), -1)
    result[index[open_points]] = open_points
    others = np.nonzero(result < 0)[0]
    tree = cKDTree(vertices[index[open_points]])
    result[others] = open_points[tree.query(vertices[others], workers=thread_count())[1]]
    return result


def turned_so_far(camera_from_head: np.ndarray) -> np.ndarray:
    """[F, 4, 4] -> [F] angle that the head has turned against the camera from frame to frame, added up, radians."""
    rotation = camera_from_head[:, :3, :3]
    step = vector_from_rotation(np.einsum("fij,fkj->fik", rotation[1:], rotation[:-1]))
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(step, axis=1))])


def key_frames(turn: np.ndarray, step: float) -> np.ndarray:
    """Indices of frames no more than step apart in the accumulated turn [F] where frames are dense enough; the first
    and the last are always among them."""
    keys = [0]
    for frame in range(1, len(turn)):
        if turn[frame] - turn[keys[-1]] > step and frame - 1 > keys[-1]:
            keys.append(frame - 1)
    return np.unique([*keys, len(turn) - 1])


def light_along(
    light: np.ndarray, directions: np.ndarray, world_from_head: np.ndarray, light_index: np.ndarray | None = None
) -> np.ndarray:
    """Cubemap [6 n^2, C] along head-space directions [J, 3] in F frames -> [J, F, C] float32; light_index [F]: which
    of several, one below the other. light [6 n^2, C] linear; world_from_head [F, 3, 3]."""
    lights = 1 if light_index is None else int(light_index.max()) + 1
    resolution = round((len(light) / 6 / lights) ** 0.5)
    lookup = frame_lookup(directions, world_from_head, resolution, light_index)
    values = lookup @ np.asarray(light, np.float64)
    return values.astype(np.float32).reshape(len(directions), len(world_from_head), -1)
