"""Our shading against a path tracer that is not ours (Mitsuba 3): diffuse light, one bounce, highlights by roughness.

    python -m tools.bench shading --out DIR [--samples 256] [--pixels 96] [--only head statue] [--light window]

Writes   DIR/shading.csv (one row per mesh, quantity and roughness), DIR/specular.svg (errors of the highlights over
         the roughness, all meshes), and one EXR of ours, theirs and their ratio per row under DIR/pictures. split_sum
         and direction_sum are the transfer solver's two ways of making a lobe, published_* the reference solver's
         renderer.
Compares radiance of the pixels that the mesh fills. mean: ratio of the sums, minus one. rms: root mean square error
         over the mean radiance; two renders with seeds of their own take the path tracer's noise out of it.
Needs    pip install mitsuba.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec

import cv2
import numpy as np
import torch

from shared.appearance.observations import face_front
from shared.errors import InputError
from shared.geometry.mesh import Mesh, normalised, subdivide
from shared.geometry.transforms import camera_centres
from shared.imaging.image_sampling import SurfaceViewer
from shared.io.images import write_exr
from shared.published.raster import Raster
from shared.published.shading import Sampling, Shader, TorchMaterial
from shared.rendering.envmap import cube_from_latlong, latlong_from_cube
from shared.rendering.lobes import SpecularTransfer, specular_reflection
from shared.rendering.precomputed_transfer import PrecomputedTransfer, Sizes, precompute_transfer
from shared.rendering.render import SurfaceMaps, render_frame
from shared.rendering.shading import light_along
from shared.rendering.studio_lights import STUDIO_LIGHTS, studio_light
from shared.rendering.transfer import Transfer, irradiance, mesh_points, node_radiosity
from shared.rendering.views import ViewCamera, orbit_camera
from shared.tracking.models import load_head_model
from tools.bench.drawing import line_chart
from tools.bench.peers.mitsuba import ALL_BOUNCES, DIRECT, ONE_BOUNCE, Coat, path_trace
from tools.bench.runner import Bench, Entry, Table
from tools.bench.statue import statue

SKIN = (0.60, 0.38, 0.28)
ROUGHNESSES = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
YAW_DEG, PITCH_DEG = -20.0, 8.0
LIGHT_RESOLUTION, LATLONG_ROWS = 16, 512
SIZES = Sizes(directions=768, nodes=1000)
PUBLISHED_RESOLUTION, PUBLISHED_SAMPLES, SPLIT_SAMPLES = 64, 1024, 256
SPECULAR_SHARE = 8
"""The path tracer's paths with our lobe, which runs in Python, are so much fewer."""
LARGEST_SHOWN = 60.0
"""Percent: where lobes slip between the directions, the sum over them says nothing."""


@dataclass
class _Frame:
    """What render_frame asks of a shading: values at the vertices [V, 3]."""

    diffuse: np.ndarray
    specular: np.ndarray

    def irradiance(self, frame: int) -> np.ndarray:
        return self.diffuse

    def reflection(self, frame: int) -> np.ndarray:
        return self.specular


@dataclass(frozen=True)
class TracedView:
    """A mesh before one camera under one light, traced once: what the transfer solver shades with."""

    viewer: SurfaceViewer
    camera: ViewCamera
    precomputed: PrecomputedTransfer
    index: np.ndarray
    transfer: Transfer
    along: np.ndarray
    latlong: np.ndarray

    @classmethod
    def of(cls, mesh: Mesh, light: np.ndarray, pixels: int, sizes: Sizes = SIZES) -> TracedView:
        """light: lat-long [H, 2 H, 3] in the mesh's space; both renderers see it through the same coarse cubemap."""
        viewer, camera = (
            SurfaceViewer.of(mesh),
            orbit_camera(mesh, YAW_DEG, PITCH_DEG, pixels),
        )
        precomputed = precompute_transfer(viewer, sizes)
        index = np.nonzero(face_front(viewer, camera.camera_from_head[None], -0.2))[0]
        cube = np.maximum(cube_from_latlong(light, LIGHT_RESOLUTION), 0.0)
        along = light_along(cube, precomputed.directions, np.eye(3)[None])[:, 0]
        transfer = precomputed.trace(mesh_points(mesh, index))
        return cls(viewer, camera, precomputed, index, transfer, along, latlong_from_cube(cube, LATLONG_ROWS, 1))

    def diffuse(self, albedo: Sequence[float], bounces: int) -> np.ndarray:
        """Picture [h, w, 3] of a matte surface: no bounce, one, or all of them (bounces 0, 1, 2)."""
        nodes, colour = self.precomputed.node_transfer, np.array(albedo)
        direct = nodes.direct.astype(np.float64) @ self.along
        radiosity = [None, colour * direct, None][bounces]
        if bounces == 2:
            radiosity = node_radiosity(nodes, np.tile(colour, (len(direct), 1)), direct)
        return self._picture(irradiance(self.transfer, self.along, radiosity), None, albedo)

    def specular(self, roughness: float, split: bool) -> np.ndarray:
        """Picture of the lobe alone at intensity 1: by the split sum or by the sum over directions."""
        points = mesh_points(self.viewer.mesh, self.index)
        table = SpecularTransfer(points.normals, self.transfer.visibility(), self.precomputed.directions)
        table.narrowest = 2.0 if split else 0.0
        camera = self.camera.camera_from_head
        towards = normalised(camera_centres(camera) - points.positions)
        return self._picture(None, specular_reflection(table, towards, roughness, self.along), (0.0, 0.0, 0.0))

    def published(self, coat: Coat, samples: int, seed: int = 0) -> np.ndarray:
        """Picture by the reference solver's renderer: pixel centres, rays of its own for V and V~."""
        mesh, camera, view = self.viewer.mesh, self.camera, torch.from_numpy
        raster = Raster(mesh, camera.intrinsics, camera.size)
        hits = raster.hits(self.viewer.scene, camera.camera_from_head)
        pixels = np.nonzero(hits.face.ravel() >= 0)[0]
        vertices, normals = (view(x.astype(np.float32)) for x in (mesh.vertices, self.viewer.normals))
        points = raster.points(vertices, normals, camera.camera_from_head, pixels, hits.face.ravel()[pixels])
        shader = Shader(PUBLISHED_RESOLUTION, Sampling(samples, samples, SPLIT_SAMPLES))
        even = torch.ones(len(pixels))
        texture = TorchMaterial(
            torch.tensor(coat.albedo).expand(len(pixels), 3), coat.specular_intensity * even, coat.roughness * even
        )
        light = view(cube_from_latlong(self.latlong, PUBLISHED_RESOLUTION))
        picture = np.zeros((camera.size[0] * camera.size[1], 3), np.float32)
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            picture[pixels] = shader(light, points, texture, self.viewer.scene, np.eye(3), generator).numpy()
        return picture.reshape(*camera.size[::-1], 3)

    def _picture(self, diffuse: np.ndarray | None, specular: np.ndarray | None, albedo: Sequence[float]) -> np.ndarray:
        values = [np.zeros((len(self.viewer.mesh.vertices), 3), np.float32) for _ in range(2)]
        for target, found in zip(values, (diffuse, specular), strict=True):
            if found is not None:
                target[self.index] = found
        return self.shoot(_Frame(*values), albedo)[0]

    def shoot(self, frame: _Frame, albedo: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Radiance and coverage of vertex values by the shared renderer, nine rays a pixel."""
        maps = SurfaceMaps(np.broadcast_to(np.float32(albedo), (2, 2, 3)), np.ones((2, 2), np.float32))
        camera = self.camera
        return render_frame(
            self.viewer, frame, maps, 0, camera.camera_from_head, camera.intrinsics, camera.size, samples=3
        )

    def filled(self) -> np.ndarray:
        """[h, w] bool: pixels that the mesh fills, and their neighbours too."""
        nothing = np.zeros((len(self.viewer.mesh.vertices), 3), np.float32)
        _, coverage = self.shoot(_Frame(nothing, nothing), (0.0, 0.0, 0.0))
        return cv2.erode((coverage > 0.999).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0

    def truth(self, coat: Coat, depth: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
        """Two independent path-traced pictures of half the samples each."""
        return tuple(
            path_trace(self.viewer.mesh, self.latlong, self.camera, coat, depth, max(1, samples // 2), seed)
            for seed in (1, 2)
        )


def compare(ours: np.ndarray, theirs: tuple[np.ndarray, np.ndarray], filled: np.ndarray) -> dict[str, float]:
    """{mean, rms, noise}: relative to the mean radiance; noise: standard error of the path tracer's mean."""
    found, first, second = (picture[filled].astype(np.float64) for picture in (ours, *theirs))
    scale = 0.5 * (first + second).mean()
    squared = ((found - first) * (found - second)).mean()
    noise = (first - second).std() / 2.0 / np.sqrt(first.size)
    return {
        "mean": float(found.mean() / scale - 1.0),
        "rms": float(np.sign(squared) * np.sqrt(abs(squared)) / scale),
        "noise": float(noise / scale),
    }


def head() -> Mesh:
    """The head model's neutral head, subdivided once: 18 000 vertices."""
    model = load_head_model()
    return subdivide(model.mesh(np.zeros(len(model.identity_basis)), np.zeros(len(model.expression_basis))))


MESHES: dict[str, Callable[[], Mesh]] = {"head": head, "statue": statue}


def measure(
    name: str,
    stage: TracedView,
    samples: int,
    keep: Callable[[str, np.ndarray, np.ndarray], None],
    roughnesses: Sequence[float] = ROUGHNESSES,
) -> list[dict]:
    """Rows of one mesh; keep(label, ours, theirs) may save the pictures."""
    rows, filled = [], stage.filled()

    def row(quantity: str, ours: np.ndarray, theirs: tuple, roughness: float | None = None) -> None:
        label = quantity if roughness is None else f"{quantity}_{roughness:g}"
        keep(f"{name}_{label}", ours, 0.5 * (theirs[0] + theirs[1]))
        errors = compare(ours, theirs, filled)
        rows.append({"mesh": name, "quantity": quantity, "roughness": roughness, "pixels": int(filled.sum())} | errors)

    direct = stage.truth(Coat(SKIN), DIRECT, samples)
    row("diffuse_direct", stage.diffuse(SKIN, 0), direct)
    published = [stage.published(Coat(SKIN), PUBLISHED_SAMPLES, seed) for seed in (1, 2)]
    row("published_diffuse", published[0], direct)
    row("diffuse_direct_against_published", stage.diffuse(SKIN, 0), tuple(published))
    row("diffuse_one_bounce", stage.diffuse(SKIN, 1), stage.truth(Coat(SKIN), ONE_BOUNCE, samples))
    row("diffuse_all_bounces", stage.diffuse(SKIN, 2), stage.truth(Coat(SKIN), ALL_BOUNCES, samples))
    for roughness in roughnesses:
        coat = Coat((0.0, 0.0, 0.0), 1.0, roughness)
        theirs = stage.truth(coat, DIRECT, max(2, samples // SPECULAR_SHARE))
        row("split_sum", stage.specular(roughness, True), theirs, roughness)
        row("direction_sum", stage.specular(roughness, False), theirs, roughness)
        row("published_split_sum", stage.published(coat, 1), theirs, roughness)
    return rows


def chart(rows: Sequence[dict]) -> str:
    """Root mean square error of the highlights over roughness, one curve per mesh and way; 0: lost in the noise."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if row["quantity"] in ("split_sum", "direction_sum", "published_split_sum"):
            percent = 100.0 * max(0.0, row["rms"])
            place = row["roughness"], percent if percent < LARGEST_SHOWN else float("nan")
            curves.setdefault(f"{row['mesh']}: {row['quantity'].replace('_', ' ')}", []).append(place)
    return line_chart(curves, "roughness", "rms error of the highlight, %")


class ShadingBench(Bench):
    """Every mesh."""

    name, columns = "shading", ("mesh", "quantity", "roughness", "pixels", "mean", "rms", "noise")

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--samples", type=int, default=256, help="paths per pixel")
        parser.add_argument("--pixels", type=int, default=96, help="edge of the pictures")
        parser.add_argument("--directions", type=int, default=SIZES.directions, help="directions of the transfer")
        parser.add_argument("--light", default="window", choices=STUDIO_LIGHTS)

    def facts(self) -> dict[str, object]:
        return {name: getattr(self.options, name) for name in ("samples", "pixels", "directions", "light")}

    def cases(self) -> dict[str, Callable[[], Mesh]]:
        return MESHES

    def measure(self, case: Callable[[], Mesh], entry: Entry) -> None:
        if find_spec("mitsuba") is None:
            raise InputError("Mitsuba is not installed", where="shading", hint="pip install mitsuba")
        sizes = replace(SIZES, directions=self.options.directions)
        stage = TracedView.of(case(), studio_light(self.options.light), self.options.pixels, sizes)
        entry.add(*measure(entry.name, stage, self.options.samples, self.keep))

    def keep(self, label: str, ours: np.ndarray, theirs: np.ndarray) -> None:
        """Writes the picture of ours, theirs and their ratio."""
        folder = self.options.out / "pictures"
        folder.mkdir(parents=True, exist_ok=True)
        ratio = np.where(theirs > 1e-4, ours / np.maximum(theirs, 1e-4), 1.0)
        picture = np.hstack([ours, theirs, ratio]).astype(np.float32)
        write_exr(folder / f"{label}.exr", picture, colour_space="lin_rec709_scene")

    def conclude(self, table: Table) -> int:
        if table.rows:
            (self.options.out / "specular.svg").write_text(chart(table.rows), encoding="utf-8")
        return 0
