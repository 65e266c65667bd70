"""A surface ready for its light to be solved, and the directions that suit a light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shared.appearance.chart_scale import ChartStatement
from shared.appearance.fit import Solution
from shared.appearance.observations import Capture, build_capture
from shared.compute.run_context import RunContext
from shared.geometry.mesh import Mesh
from shared.geometry.rim import smooth_rim
from shared.geometry.surface import Surface
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.turning_eyes import TurningEyes
from shared.imaging.views import Views
from shared.inverse.problem import FACE_SKIN, InverseSettings
from shared.rendering.direction_set import concentrated, split_directions
from shared.rendering.near_lamp import NearLamp, SeenLamp
from shared.rendering.precomputed_transfer import PrecomputedTransfer, precompute_transfer
from shared.rendering.shading import light_along
from shared.shape.refine import subdivided_to


@dataclass(frozen=True, eq=False)
class LitSurface:
    """A surface ready for its light to be solved: its viewer, precomputed transfer, and what the skin's points show;
    coarse: what some of them show, on which the light comes to rest."""

    surface: Surface
    viewer: SurfaceViewer
    precomputed: PrecomputedTransfer
    capture: Capture
    coarse: Capture

    @classmethod
    def of(
        cls,
        surface: Surface,
        views: Views,
        settings: InverseSettings,
        chart: ChartStatement | None,
        context: RunContext,
        before: Mesh | None = None,
        directions: np.ndarray | None = None,
        lamp: NearLamp | None = None,
    ) -> LitSurface:
        """Of a surface in some views; before: its mesh before refinement, by which its points are spread; directions
        [J, 3] that its light is summed along, None: an even set; lamp: of its light, where it stands near."""
        layout = None if before is None else subdivided_to(before, surface.mesh).vertices
        viewer = SurfaceViewer.of(surface.mesh, layout)
        precomputed = precompute_transfer(viewer, settings.sizes, settings.appearance.visibility, directions)
        moves, skin = settings.appearance.light_moves(views.moves), surface.vertices_of(FACE_SKIN)
        eyes = None if views.gaze is None else TurningEyes.of(surface)
        capture = build_capture(viewer, precomputed, views, moves, skin, settings.sizes.points, context, eyes)
        capture = replace(capture, chart=chart)
        found = cls(surface, viewer, precomputed, capture, capture.some_points(settings.appearance.coarse_points))
        return found if lamp is None else found.with_lamp(lamp, views, moves)

    def with_lamp(self, lamp: NearLamp, views: Views, moves: str) -> LitSurface:
        """The same under a light whose lamp stands near; views: those that it was made of; moves: what moves against
        the light."""
        seen, whole = SeenLamp.of(lamp, views.camera_from_head, moves), self.coarse is self.capture
        capture = self.capture.under_lamp(seen)
        return replace(self, capture=capture, coarse=capture if whole else self.coarse.under_lamp(seen))

    def with_smooth_rim(self, settings: InverseSettings) -> LitSurface:
        """The same with a mesh that ends on a smooth curve, and light that bounces between the same vertices of it. Its
        points and what they show stay: the light is solved."""
        mesh = smooth_rim(self.surface.mesh)
        viewer = SurfaceViewer.of(mesh, self.viewer.layout)
        visibility, directions = settings.appearance.visibility, self.precomputed.directions
        precomputed = precompute_transfer(viewer, settings.sizes, visibility, directions)
        return replace(self, surface=self.surface.with_mesh(mesh), viewer=viewer, precomputed=precomputed)


def suited_directions(lit: LitSurface, solution: Solution) -> np.ndarray:
    """[J, 3]: the directions that a surface was lit along, split where a lamp shines; by a near one they are."""
    if solution.lamp is not None:
        return lit.precomputed.directions
    capture, even = lit.coarse, lit.precomputed.directions
    along = light_along(solution.state.light, even, capture.world_from_head, capture.light_index)
    return split_directions(even, concentrated(along))


def report_to(context: RunContext) -> Callable[[dict], None]:
    """A line for the log of each step's record."""
    return lambda record: context.note(
        f"{record['light']} {record['resolution']}, step {record['step']}: residual {record['fitted']:.5f} fitted, "
        f"{record['held_out']:.5f} held out; specular {record['specular_intensity']:.3f}, "
        f"roughness {record['roughness']:.3f}"
    )
