"""The shape's part of inverse rendering: what is shaped, and in which steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from shared.appearance.problem import AppearanceSettings
from shared.compute.run_context import RunContext
from shared.geometry.intersections import move_without_crossing
from shared.geometry.mesh import Mesh, subdivide
from shared.geometry.mouth import shut_lips
from shared.geometry.surface import Surface, TrackPoints
from shared.imaging.views import Views
from shared.rendering.precomputed_transfer import Sizes
from shared.shape.gauss_newton import HELD, SHAPED, Reflectance, ShapeSettings, ShapeSolver
from shared.shape.occluding_contour import ContourSettings, Outlined, Outlines
from shared.shape.silhouette import FaceOutline, fit_outline

OUTLINED = ("forehead", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "lips", "chin", "jaw", "ears", "scalp")
"""Segments that may form the outline. The neck bends, and clothes cover it."""
EDGED = ("cheek_left", "cheek_right", "chin", "jaw")
"""Segments whose edge before hair, neck or background is a step of colour. Hair falls over the forehead."""
BARE = ("nose", "cheek_left", "cheek_right")
TRACK_REACH_MM, KNOWN_MM = 6.0, 0.2
"""So far around a track point the surface is known as well as the point is, but not better than this."""
RIM_EDGES = 5
"""Lids' rims, so many edges around the sockets, stay where tracking has laid them: they are thinner than a pixel, and
shading would crumple them."""
RESTING = ("eyes", "lips", "inner_mouth")
"""Lids lie on eyeballs and lips on each other: these may cross where they do."""
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
    """The surface with its mesh moved to meet the face's edges in the views and the borders of their masks where tracks
    do not tell better, and a record."""
    mesh = surface.mesh
    fitted, record = fit_outline(mesh, outlined_of(surface), views, settings, context)
    resting = surface.faces_of(RESTING)
    placed = move_without_crossing(mesh.vertices, fitted.vertices, fitted.faces, resting)
    return surface.with_mesh(fitted.replace(vertices=placed)), record


def outlined_of(surface: Surface) -> Outlined:
    """What of the surface may form an outline, and how well it is known: near track points as well as they are."""
    mesh = surface.mesh
    if surface.tracks is None:
        known_mm = np.where(surface.faces_of(SHAPED), KNOWN_MM, np.inf)
    else:
        distance, nearest = cKDTree(surface.tracks.positions).query(mesh.vertices[mesh.faces].mean(1))
        known_mm = np.maximum(surface.tracks.sigma_mm[nearest], KNOWN_MM)
        known_mm[distance > TRACK_REACH_MM] = np.inf
    return Outlined(*(surface.faces_of(names) for names in (OUTLINED, EDGED, BARE)), known_mm)


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
    outline = None
    if settings.contour is not None:
        outlined = replace(outlined_of(surface), usable=surface.faces_of(EDGED))
        outline = FaceOutline(outlined, views, Outlines.of(views), settings.contour)
    solver = ShapeSolver(views, surface.tracks, reflectance, appearance, sizes, settings, context, outline)
    held = surface.faces_of(HELD) | surface.faces_near(("eye_sockets",), RIM_EDGES)
    start, refined = solver.refine(surface.mesh, surface.faces_of(SHAPED), held, begun)
    resting = np.repeat(surface.faces_of(RESTING), len(refined.faces) // len(surface.mesh.faces))
    placed = move_without_crossing(start.vertices, refined.vertices, refined.faces, resting)
    stopped = int((np.abs(placed - refined.vertices).max(1) > 1e-6).sum())
    if stopped:
        context.note(f"shape: {stopped} vertices moved less than wanted, so that the surface does not cut itself")
    finer = surface.with_mesh(refined.replace(vertices=placed))
    return RefinedSurface(finer.with_mesh(refined.replace(vertices=shut_lips(finer))), stopped)
