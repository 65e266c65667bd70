"""Inverse rendering of a clip: what a solver is given, and what all solvers need of a clip."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from shared.appearance.fit import Solution
from shared.appearance.observations import face_front
from shared.appearance.problem import AppearanceSettings
from shared.compute.run_context import RunContext
from shared.geometry.surface import Surface
from shared.imaging.frame_index import hold_out, spread_frames
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.views import Views
from shared.inverse.frame_choice import covering_frames
from shared.published.settings import ReferenceSettings
from shared.rendering.precomputed_transfer import PrecomputedTransfer, Sizes
from shared.rendering.shading import Material, VertexShading
from shared.rendering.transfer import mesh_points
from shared.shape.gauss_newton import ShapeSettings

FACE_SKIN = ("forehead", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "chin", "jaw")
"""Segments whose skin the light is solved from; hair, brows, lips, lids, eyes and what clothes may cover are left out.
"""


@dataclass(frozen=True)
class InverseSettings:
    """sizes of the light's problem, its settings, frames it is solved from, edge of the maps, hold-out period.

    shape: how the mesh is refined, None: it stays as it is; fit_frames: how many frames to fit, chosen to cover the
    face, 0: all but those held out; reference: solve by the published algorithm instead; selection: choose the model,
    up to what the settings say, and leave only the named parts of it as they say; pose_rounds: how often, at
    most, the frames are tracked again on the refined mesh; lamp_distance: of the light's main lamp, mm, FAR or, None,
    where held-out frames have it; smooth_rim: let a mesh with segments, which the head model made, end on a smooth
    curve."""

    sizes: Sizes = field(default_factory=Sizes)
    appearance: AppearanceSettings = field(default_factory=AppearanceSettings)
    light_frames: int = 48
    map_size: int = 1024
    hold_out_every: int = 8
    shape: ShapeSettings | None = field(default_factory=ShapeSettings)
    fit_frames: int = 0
    reference: ReferenceSettings | None = None
    normal_map: bool = True
    selection: frozenset[str] | None = None
    pose_rounds: int = 3
    lamp_distance: float | None = None
    smooth_rim: bool = False


def some_views(views: Views, settings: InverseSettings, wanted: int) -> Views:
    """At most wanted views, evenly spread; all that are fitted where these are few and chosen."""
    chosen = spread_frames(len(views), wanted, views.light_index)
    if settings.fit_frames:
        chosen = np.union1d(chosen, np.nonzero(views.fitted)[0])
    if (~views.fitted[chosen]).sum() >= 2:
        return views.take(chosen)
    # Every part of the solve needs held-out frames too: where thinning left too few, hold out among the thinned.
    return views.take(chosen, hold_out(len(chosen), settings.hold_out_every, views.light_index[chosen]))


def frames_to_fit(views: Views, surface: Surface, settings: InverseSettings, viewer: SurfaceViewer) -> np.ndarray:
    """[F] bool: all frames but those held out, or the few that cover the face. viewer: of the surface's mesh."""
    if not settings.fit_frames:
        return hold_out(len(views), settings.hold_out_every, views.light_index)
    chosen = covering_frames(viewer, surface.vertices_of(FACE_SKIN), views, settings.fit_frames)
    return np.isin(np.arange(len(views)), chosen)


def shade_vertices(
    views: Views,
    viewer: SurfaceViewer,
    precomputed: PrecomputedTransfer,
    appearance: AppearanceSettings,
    solution: Solution,
    context: RunContext,
) -> VertexShading:
    """Shading of all vertices that some view faces, in all views."""
    index = np.nonzero(face_front(viewer, views.camera_from_head, -0.1))[0]
    points = mesh_points(viewer.mesh, index)
    transfer = precomputed.trace(points, lambda batches: context.progress(batches, "tracing the surface"))
    state = solution.state
    local = None if solution.local_roughness_fit is None else solution.local_roughness_fit.roughness(points.positions)
    return VertexShading(
        index,
        viewer.mesh.vertices,
        points,
        transfer,
        precomputed.node_transfer,
        Material(state.node_albedo, state.specular, state.roughness, local),
        state.light,
        precomputed.directions,
        views.camera_from_head,
        appearance.light_moves(views.moves),
        bounce=appearance.bounce,
        light_index=views.light_index,
        lamp=solution.lamp,
        node_points=precomputed.nodes.points,
    )
