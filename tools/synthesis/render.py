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
from functools import partial

import numpy as np

from shared.geometry.mesh import Mesh
from tools.synthesis.camera import PictureQuality, PinholeCamera, take_picture
from tools.synthesis.chart import PlacedChart, add_chart
from tools.synthesis.irradiance import GroupResult, IrradianceQuality, SyntheticShot, assemble_atlas, group_irradiance
from tools.synthesis.light import EnvironmentLight, LampSphere
from tools.synthesis.surface import Materials, SyntheticSurface

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Scene:
    """A textured mesh, the environments [H, 2 H, 3] that its shots choose from, and a colour chart in all of them;
    lamps_at: where the lamps of the first environment stand in world space, None: far away."""

    mesh: Mesh
    materials: Materials
    lights: tuple[np.ndarray, ...]
    chart: PlacedChart | None = None
    lamps_at: LampSphere | None = None

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
        self.surface = SyntheticSurface(scene.mesh, scene.materials)
        self.lights = scene.environments()
        self.chart = scene.chart
        self.shots, self.camera, self.quality = shots, camera, quality

    def irradiance(self, group: int) -> GroupResult:
        """One group of texels, all shots."""
        return group_irradiance(self.surface, self.lights, self.shots, group, self.quality.irradiance,
                                self.quality.seed)

    def picture(self, task: tuple[int, np.ndarray, bool]) -> dict[str, np.ndarray]:
        """Shot index, its irradiance [size, size, 3], and whether all buffers are wanted or radiance alone."""
        index, irradiance, with_buffers = task
        shot = self.shots[index]
        light, quality = self.lights[shot.light], self.quality.picture
        images = take_picture(self.surface, light, irradiance, shot, self.camera, quality)
        if self.chart is not None:
            add_chart(images["radiance"], self.chart, self.surface, light, irradiance, shot, self.camera.intrinsics,
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
        surface = SyntheticSurface(scene.mesh, scene.materials)
        atlas = assemble_atlas(surface, groups, quality.irradiance.size, quality.irradiance.bounces)
        del groups
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
