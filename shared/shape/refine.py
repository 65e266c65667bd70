"""The shape's part of inverse rendering: what is shaped, from which frames, and whether the result is kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from shared.appearance.problem import AppearanceSettings
from shared.compute.run_context import RunContext
from shared.geometry.intersections import move_without_crossing
from shared.geometry.mesh import Mesh, subdivide
from shared.geometry.surface import Surface, TrackPoints
from shared.imaging.views import Views
from shared.rendering.precomputed_transfer import Sizes
from shared.shape.gauss_newton import HELD, SHAPED, Reflectance, ShapeSettings, ShapeSolver
from shared.shape.silhouette import ContourSettings, fit_outline

OUTLINED = ("forehead", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "lips", "chin", "jaw", "ears", "scalp")
"""Segments that may form the outline. The neck bends, and clothes cover it."""
TRACK_REACH_MM = 6.0
"""So far around a track point the tracks tell the surface better than an outline does."""
RIM_EDGES = 5
"""Lids' rims, so many edges around the sockets, stay where tracking has laid them: they are thinner than a pixel, and
shading would crumple them."""
MODEL_ERROR_MM = 2.0
"""How far a fitted head model lies from a head."""


@dataclass(frozen=True, eq=False)
class RefinedSurface:
    """A surface with its mesh refined; stopped: vertices that moved less than wanted, since the surface would have cut
    itself."""

    surface: Surface
    stopped: int


def subdivided_to(mesh: Mesh, finer: Mesh) -> Mesh:
    """The mesh, subdivided until it has the topology of a finer one that was made from it."""
    while len(mesh.faces) < len(finer.faces):
        mesh = subdivide(mesh)
    return mesh


def surface_error(tracks: TrackPoints | None) -> float:
    """How far the head's surface may be off, mm, given how far the depth of its track points may, and what the head
    model knows without them; 0: the mesh is not from tracks."""
    if tracks is None:
        return 0.0
    return float(1.0 / np.hypot(1.0 / np.median(tracks.sigma_mm), 1.0 / MODEL_ERROR_MM))


def meet_outline(
    views: Views, surface: Surface, settings: ContourSettings, context: RunContext
) -> tuple[Surface, dict]:
    """The surface with its mesh moved to meet the borders of the views' masks where no track lies, and a record."""
    mesh = surface.mesh
    if surface.tracks is None:
        known = np.isin(np.arange(len(mesh.vertices)), mesh.faces[surface.faces_of(SHAPED)])
    else:
        known = cKDTree(surface.tracks.positions).query(mesh.vertices)[0] < TRACK_REACH_MM
    fitted, record = fit_outline(mesh, surface.faces_of(OUTLINED), known, views, settings, context)
    placed = move_without_crossing(mesh.vertices, fitted.vertices, fitted.faces)
    return surface.with_mesh(fitted.replace(vertices=placed)), record


def refine_shape(
    views: Views,
    surface: Surface,
    reflectance: Reflectance,
    appearance: AppearanceSettings,
    sizes: Sizes,
    settings: ShapeSettings,
    context: RunContext,
    begun: Mesh | None = None,
) -> RefinedSurface:
    """The surface with its mesh refined under a known light; begun: its mesh as it was refined before, with as many
    subdivisions or fewer, from where this goes on."""
    solver = ShapeSolver(views, surface.tracks, reflectance, appearance, sizes, settings, context)
    held = surface.faces_of(HELD) | surface.faces_near(("eye_sockets",), RIM_EDGES)
    start, refined = solver.refine(surface.mesh, surface.faces_of(SHAPED), held, begun)
    eyes = np.repeat(surface.faces_of(("eyes",)), len(refined.faces) // len(surface.mesh.faces))
    placed = move_without_crossing(start.vertices, refined.vertices, refined.faces[~eyes])  # lids rest on eyeballs
    stopped = int((np.abs(placed - refined.vertices).max(1) > 1e-6).sum())
    if stopped:
        context.note(f"shape: {stopped} vertices moved less than wanted, so that the surface does not cut itself")
    return RefinedSurface(surface.with_mesh(refined.replace(vertices=placed)), stopped)
