"""Renders many shots of one scene in worker processes.

Numpy holds the interpreter lock between its loops, so work is spread over processes. Tasks are cut independently of
their number, each carries its own random seed, and every worker uses one thread for its matrix products: the result
does not depend on how many there are.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from shared.geometry.mesh import Mesh
from tools.synthesis.camera import PictureQuality, PinholeCamera, take_picture
from tools.synthesis.chart import PlacedChart, add_chart
from tools.synthesis.eyes import REACH_MM
from tools.synthesis.iris import EyePaint
from tools.synthesis.irradiance import (
    GroupResult,
    IrradianceQuality,
    SyntheticShot,
    assemble_atlas,
    covered_texels,
    group_irradiance,
    refresh_atlas,
)
from tools.synthesis.light import EnvironmentLight, LampSphere
from tools.synthesis.surface import Materials, SyntheticSurface

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Scene:
    """A textured mesh, the environments [H, 2 H, 3] that its shots choose from, and a colour chart in all of them;
    lamps_at: where the lamps of the first environment stand in world space, None: far away. eyes: how the head's look,
    None: as its textures say; lids: amounts by which their lids are moved in each state, the first of them 0."""

    mesh: Mesh
    materials: Materials
    lights: tuple[np.ndarray, ...]
    chart: PlacedChart | None = None
    lamps_at: LampSphere | None = None
    eyes: EyePaint | None = None
    lids: tuple[float, ...] = (0.0,)

    def surface(self, state: int) -> SyntheticSurface:
        """With the lids of a state."""
        if not state:
            return SyntheticSurface(self.mesh, self.materials)
        vertices, moved = np.array(self.mesh.vertices), self.eyes.eyes.lids(self.lids[state])
        vertices[:len(moved)] += moved
        return SyntheticSurface(self.mesh.replace(vertices=vertices), self.materials)

    def near_eyes(self, size: int) -> np.ndarray:
        """[size^2] bool: texels of the irradiance that lids move or shade."""
        surface = self.surface(0)
        texels, face, bary = covered_texels(surface, size)
        apart = surface.points(face, bary).position[:, None] - self.eyes.eyes.centres
        near = np.zeros(size * size, bool)
        near[texels] = np.linalg.norm(apart, axis=2).min(1) < REACH_MM
        return near

    def environments(self) -> list[EnvironmentLight]:
        """Of each of the lights."""
        return [EnvironmentLight(image, None if k else self.lamps_at) for k, image in enumerate(self.lights)]


@dataclass(frozen=True)
class RenderQuality:
    """How finely irradiance and pictures are sampled; seed of the irradiance."""

    irradiance: IrradianceQuality
    picture: PictureQuality
    seed: int


class _Worker:
    """What a process needs to render: built once in each."""

    def __init__(self, scene: Scene, shots: list[SyntheticShot], camera: PinholeCamera, quality: RenderQuality):
        self.scene, self.lights = scene, scene.environments()
        self.shots, self.camera, self.quality = shots, camera, quality
        self._surfaces: dict[int, SyntheticSurface] = {}

    def surface(self, state: int) -> SyntheticSurface:
        """With the lids of a state; built when first asked for."""
        if state not in self._surfaces:
            self._surfaces[state] = self.scene.surface(state)
        return self._surfaces[state]

    @cached_property
    def near_eyes(self) -> np.ndarray:
        """Of Scene.near_eyes."""
        return self.scene.near_eyes(self.quality.irradiance.size)

    def irradiance(self, group: int) -> GroupResult:
        """One group of texels, all shots, lids at rest."""
        return group_irradiance(self.surface(0), self.lights, self.shots, group, self.quality.irradiance,
                                self.quality.seed)

    def lid_irradiance(self, state: int) -> list[GroupResult]:
        """All groups of the texels near the eyes, for the shots with lids in that state."""
        shots = [shot for shot in self.shots if shot.lids == state]
        return [group_irradiance(self.surface(state), self.lights, shots, group, self.quality.irradiance,
                                 self.quality.seed, self.near_eyes) for group in range(self.quality.irradiance.groups)]

    def picture(self, task: tuple[int, np.ndarray, bool]) -> dict[str, np.ndarray]:
        """Shot index, its irradiance [size, size, 3], and whether all buffers are wanted or radiance alone."""
        index, irradiance, with_buffers = task
        shot = self.shots[index]
        light, quality, surface = self.lights[shot.light], self.quality.picture, self.surface(shot.lids)
        images = take_picture(surface, light, irradiance, shot, self.camera, quality, self.scene.eyes)
        if self.scene.chart is not None:
            add_chart(images["radiance"], self.scene.chart, surface, light, irradiance, shot, self.camera.intrinsics,
                      2 * quality.sub)
        return images if with_buffers else {"radiance": images["radiance"]}


_worker: _Worker | None = None


def _start_worker(*arguments: object) -> None:
    global _worker
    _worker = _Worker(*arguments)


def _call_worker(method: str, task: object) -> object:
    return getattr(_worker, method)(task)


def render(scene: Scene, shots: list[SyntheticShot], camera: PinholeCamera, quality: RenderQuality,
           with_buffers: list[bool],
           processes: int) -> Iterator[dict[str, np.ndarray]]:
    """The images of each shot, in order: radiance [H, W, 3], and where wanted the buffers of take_picture."""
    with _workers(processes, (scene, shots, camera, quality)) as spread:
        groups = list(spread("irradiance", range(quality.irradiance.groups)))
        if scene.eyes is not None:
            groups = [group.open_ones() for group in groups]
        size = quality.irradiance.size
        atlas = assemble_atlas(scene.surface(0), groups, size, quality.irradiance.bounces)
        del groups
        states = sorted({shot.lids for shot in shots} - {0})
        near = scene.near_eyes(size) if states else None
        for state, results in zip(states, spread("lid_irradiance", states), strict=True):
            own, results = [i for i, shot in enumerate(shots) if shot.lids == state], [r.open_ones() for r in results]
            atlas[:, :, own] = refresh_atlas(scene.surface(state), atlas[:, :, own], results, near, size)
        tasks = ((i, np.ascontiguousarray(atlas[:, :, i]), with_buffers[i]) for i in range(len(shots)))
        yield from spread("picture", tasks)


@contextmanager
def _workers(processes: int, arguments: tuple) -> Iterator[Callable[[str, Iterable], Iterator]]:
    """A function (method, tasks) -> results in order, served by that many single-threaded processes."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        pool = multiprocessing.get_context("spawn").Pool(processes, _start_worker, arguments)
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    with pool:
        yield lambda method, tasks: pool.imap(partial(_call_worker, method), tasks)
