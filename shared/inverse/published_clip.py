"""A clip through the reference solver: its start, its checkpoint, and its result in the transfer solver's terms."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from shared.appearance.albedo_scale import most_likely_irradiance
from shared.appearance.chart_scale import describe_scale
from shared.appearance.fit import Solution
from shared.appearance.light_models import LogLight
from shared.appearance.light_tint import LightTint
from shared.appearance.maps import make_maps
from shared.appearance.problem import AppearanceState
from shared.appearance.texture import TexelMaterial
from shared.compute.run_context import RunContext
from shared.errors import InputError
from shared.geometry.surface import Surface
from shared.imaging.frame_index import spread_frames
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.texels import TexelSurface
from shared.imaging.views import Views
from shared.inverse.material_map import clip_materials
from shared.inverse.problem import FACE_SKIN, InverseSettings, shade_vertices
from shared.inverse.result import InverseResult, SolvedTexels
from shared.io.arrays import load_arrays, save_arrays
from shared.published.settings import ReferenceSettings
from shared.published.solver import ReferenceSolver, Start
from shared.rendering.envmap import cube_resolution
from shared.rendering.precomputed_transfer import precompute_transfer

START_FRAMES, JUDGED_FRAMES, JUDGED_PIXELS = 32, 6, 2000
LARGEST_RESULT_LIGHT = 64
SAMPLE_SPREAD = 0.04
"""Relative standard deviation of one sample: what the confidence map counts with."""
REPORT_EVERY = 50


@dataclass(frozen=True)
class Average:
    """The frames' mean colours at a map's texels [T, 3] and the sum of their weights [T]."""

    surface: TexelSurface
    colours: np.ndarray
    weight: np.ndarray


def average_texture(views: Views, viewer: SurfaceViewer, size: int, context: RunContext) -> Average:
    """Weighted mean of what the views show of each texel of a map of that edge; unseen texels take the median colour.
    """
    surface = TexelSurface(viewer.mesh, size)
    total, weight = np.zeros((len(surface), 3)), np.zeros(len(surface))
    for f in context.progress(range(len(views)), "mean texture"):
        picture, lens = views.picture(f), views.intrinsics[f]
        view = viewer.view(views.camera_from_head[f], lens, picture.inside.shape[::-1])
        samples, _ = surface.samples(surface.frame_view(view, picture, lens))
        total[samples.rows] += samples.weight[:, None] * samples.colours
        weight[samples.rows] += samples.weight
    seen = weight > 1e-3
    if not seen.any():
        raise InputError("no frame shows the mesh", where="poses", hint="check the poses and the mesh")
    colours = np.where(
        seen[:, None], total / np.maximum(weight, 1e-9)[:, None], np.median(total[seen] / weight[seen, None], axis=0)
    )
    return Average(surface, np.maximum(colours, 1e-3), weight)


def make_start(
    average: Average,
    skin: np.ndarray,
    white_sigma: float,
    specular: bool,
    tints: Sequence[LightTint | None] = (),
) -> Start:
    """The mean texture under a uniform light of the level that the priors on skin prefer; skin [V] bool; white_sigma,
    tints: see albedo_scale.scale_prior.

    The specular intensity starts as the grey of the albedo, as published.
    """
    surface = average.surface
    on_skin = skin[surface.mesh.faces[surface.face]].all(1) & (average.weight > 1e-3)
    radiance = np.median(average.colours[on_skin] if on_skin.any() else average.colours, axis=0)
    irradiance = np.exp(most_likely_irradiance(np.log(radiance), white_sigma, tints=tints))
    albedo = np.clip(average.colours / irradiance, 0.0, 1.0)
    grey = albedo.mean(1) if specular else np.zeros(len(albedo))
    albedo, grey = (surface.dilated(surface.to_image(values.astype(np.float32))) for values in (albedo, grey))
    return Start(irradiance, albedo, grey)


def solve_by_reference(
    views: Views,
    surface: Surface,
    settings: InverseSettings,
    reference: ReferenceSettings,
    context: RunContext,
    observe: Callable[[ReferenceSolver, dict], None] = lambda solver, record: None,
) -> InverseResult:
    """As inverse.solve_clip, of the views that are fitted; observe(solver, losses) after each iteration."""
    viewer = SurfaceViewer.of(surface.mesh)
    index = np.nonzero(views.fitted)[0]
    fitted = views.take(index)
    some = views.take(index[spread_frames(len(index), START_FRAMES)])
    average = average_texture(some, viewer, settings.map_size, context)
    skin = surface.vertices_of(FACE_SKIN)
    start = make_start(average, skin, settings.appearance.white_sigma, reference.sampling.specular,
                       settings.appearance.tints)
    moving = replace(fitted, moves=settings.appearance.light_moves(views.moves))
    solver = ReferenceSolver(surface.mesh, moving, start, reference)
    checkpoint = Checkpoint(reference, start, moving)
    checkpoint.load(solver, context.note)
    records = []
    for i in context.progress(range(solver.iteration, reference.iterations), "reference iterations"):
        losses = solver.step()
        observe(solver, losses)
        records.append(losses)
        if (i + 1) % REPORT_EVERY == 0 or i + 1 == reference.iterations:
            mean = {name: float(np.mean([r[name] for r in records[-REPORT_EVERY:]])) for name in losses}
            context.note(f"iteration {i + 1}: " + ", ".join(f"{name} {value:.5f}" for name, value in mean.items()))
        checkpoint.save(solver)
    result = conclude(views, surface, settings, solver, average, records, context)
    checkpoint.remove()
    return result


class Checkpoint:
    """The solver's arrays in one file, with a key of settings and inputs: others' checkpoints are passed over."""

    def __init__(self, settings: ReferenceSettings, start: Start, views: Views):
        self.path, self.every = settings.checkpoint, settings.checkpoint_every
        same = replace(settings, checkpoint=None, checkpoint_every=0, iterations=0)
        digest = hashlib.sha256(repr(same).encode())
        for array in (start.albedo, start.specular_intensity, start.radiance, views.camera_from_head, views.intrinsics):
            digest.update(np.ascontiguousarray(array).tobytes())
        self.key = np.frombuffer(digest.digest(), np.uint8)

    def load(self, solver: ReferenceSolver, note: Callable) -> None:
        """Goes on from the file where it belongs to this work."""
        if self.path is None or not Path(self.path).is_file():
            return
        try:
            arrays = load_arrays(self.path)
        except InputError as error:
            note(f"starts anew: {error}")
            return
        if not np.array_equal(arrays.pop("key", None), self.key):
            note(f"starts anew: {self.path} is a checkpoint of other settings or inputs")
            return
        solver.restore(arrays)
        note(f"goes on from iteration {solver.iteration} of {self.path}")

    def save(self, solver: ReferenceSolver) -> None:
        """Every so many iterations, whole or not at all."""
        if self.path is None or solver.iteration % self.every:
            return
        unfinished = Path(f"{self.path}.partial")
        save_arrays(unfinished, key=self.key, **solver.arrays())
        unfinished.replace(self.path)

    def remove(self) -> None:
        """Done: nothing to go on from."""
        if self.path is not None:
            Path(self.path).unlink(missing_ok=True)


def conclude(
    views: Views,
    surface: Surface,
    settings: InverseSettings,
    solver: ReferenceSolver,
    average: Average,
    records: list[dict],
    context: RunContext,
) -> InverseResult:
    """The solver's state as maps, light and shading, for re-rendering by the shared renderer."""
    texels, material = average.surface, map_material(solver, average)
    viewer = SurfaceViewer.of(surface.mesh.replace(vertices=solver.vertices().detach().cpu().double().numpy()))
    roughness_map = solver.parameters["roughness"].detach().cpu().numpy()
    skin = average.weight > 1e-3
    roughness = float(np.median(roughness_map.reshape(-1)[texels.pixel][skin]))
    maps = make_maps(texels, material, roughness)
    maps["roughness"] = roughness_map.astype(np.float32)
    appearance = replace(settings.appearance, bounce=False, visibility=solver.settings.sampling.visibility)
    precomputed = precompute_transfer(viewer, settings.sizes, appearance.visibility)
    state = final_state(solver, material, roughness, len(precomputed.nodes.points))
    fit = residual(views, solver, np.nonzero(views.fitted)[0])
    held = fit if views.fitted.all() else residual(views, solver, np.nonzero(~views.fitted)[0])
    solution = Solution(state, tuple(_thinned(records)), fit, held)
    shading = shade_vertices(views, viewer, precomputed, appearance, solution, context)
    tints = settings.appearance.tints
    light = "the tint of a grey place" if tints else "white light"
    method = f"priors on skin and {light} where the descent starts, which nothing holds it to"
    record = {
        "texture": {"held_out": {"per texel": held}, "chosen": "per texel",
                    "contradicted": {"held_out": {}, "chosen": ""}},
        "albedo_scale": describe_scale(None, np.median(state.albedo, axis=0), tints=tints) | {"method": method},
        "warnings": [],
    }
    materials = clip_materials(viewer, shading, views, surface, state, context)
    solved = SolvedTexels(material, maps, viewer.mesh, materials, viewer, shading)
    return InverseResult(solution, solved, views, record)


def map_material(solver: ReferenceSolver, average: Average) -> TexelMaterial:
    """The maps at their texels; information: the samples' weights over the variance of one."""
    pixel = average.surface.pixel
    albedo = solver.parameters["albedo"].detach().cpu().numpy().reshape(-1, 3)[pixel]
    specular = solver.parameters["specular"].detach().cpu().numpy().reshape(-1)[pixel]
    return TexelMaterial(albedo, specular, average.weight / SAMPLE_SPREAD**2)


def final_state(solver: ReferenceSolver, material: TexelMaterial, roughness: float, nodes: int) -> AppearanceState:
    """The light, made coarse enough for the transfer's renderer, and typical material."""
    light = solver.light().detach().cpu().double().numpy()
    edge = cube_resolution(light)
    while edge > LARGEST_RESULT_LIGHT:
        light = light.reshape(6, edge // 2, 2, edge // 2, 2, 3).mean((2, 4)).reshape(-1, 3)
        edge //= 2
    specular = float(np.median(material.specular))
    typical = np.median(material.albedo[material.information > 1.0], axis=0)
    params = np.log(np.maximum(light, 1e-6))
    return AppearanceState(params, LogLight(edge), specular, roughness, material.albedo, np.tile(typical, (nodes, 1)))


@torch.no_grad()
def residual(views: Views, solver: ReferenceSolver, frames: np.ndarray) -> float:
    """Root mean square error (linear) of its own renders inside the mask, over a few of the frames. frames [n] int:
    numbers of views."""
    squared, generator, geometry = [], torch.Generator().manual_seed(0), solver.geometry()
    for f in frames[spread_frames(len(frames), JUDGED_FRAMES)]:
        picture, pose = views.picture(f), views.camera_from_head[f]
        hits = solver.raster.hits(geometry[2], pose)
        seen = np.nonzero((hits.face.ravel() >= 0) & (picture.inside.ravel() > 0))[0]
        seen = seen[spread_frames(len(seen), JUDGED_PIXELS)]
        found = solver.shade(pose, seen, hits, geometry, generator).cpu().numpy()
        squared.append(np.square(found - picture.levels[0].reshape(-1, 3)[seen]).mean())
    return float(np.sqrt(np.mean(squared)))


def _thinned(records: list[dict], most: int = 200) -> list[dict]:
    return [{"iteration": int(i) + 1, **records[i]} for i in spread_frames(len(records), most)] if records else []
