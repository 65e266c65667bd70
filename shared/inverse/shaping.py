"""Shape and poses under a solved light: the mesh refined, the frames tracked again on it, and the light anew.

What can be judged by itself is: the refined mesh by frames that were held out of light and shape, new poses by tracks
that were held out of the poses. Residuals of the skin do not tell poses apart that differ by some hundredths of a
degree, since texture and shape take up most of what a pose leaves over.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from shared.appearance.chart_scale import ChartStatement
from shared.appearance.fit import Solution, fit_appearance
from shared.compute.run_context import RunContext
from shared.geometry.mesh import Mesh
from shared.geometry.surface import Surface
from shared.imaging.views import Views
from shared.inverse.clip_inputs import TrackedPoses
from shared.inverse.lit_surface import LitSurface, report_to, suited_directions
from shared.inverse.pose_rounds import repeat_poses
from shared.inverse.problem import InverseSettings, some_views
from shared.shape.gauss_newton import Reflectance
from shared.shape.refine import refine_shape

CHANCE = 0.05
"""Share by which errors at other points of the same skin differ."""


@dataclass(frozen=True, eq=False)
class Shaped:
    """The views with their poses, covariance [F, 6, 6] of poses that were tracked again (None: they stay), the lit
    surface with its solution, and what is worth recording of mesh and poses."""

    views: Views
    lit: LitSurface
    solution: Solution
    covariance: np.ndarray | None = None
    shape_record: dict = field(default_factory=dict)
    pose_record: dict = field(default_factory=dict)


def shape_and_turn(
    views: Views,
    lit: LitSurface,
    solution: Solution,
    settings: InverseSettings,
    chart: ChartStatement | None,
    tracked: TrackedPoses | None,
    context: RunContext,
) -> Shaped:
    """All of it, from the light that was solved on the tracked mesh; tracked: what the poses can be tracked from again.
    """
    directions, start = suited_directions(lit, solution), lit.surface
    context.note(f"light is summed along {len(directions)} directions")

    def refined_from(views: Views, lit: LitSurface, solution: Solution, begun: Mesh | None = None) -> RefinedMesh:
        return refine_and_light(views, start, lit, solution, settings, chart, context, directions, begun)

    shaped = Shaped(views, lit, solution)
    if settings.shape is not None and start.face_segment is not None:
        refined = refined_from(views, lit, solution)
        record = judge_shape(solution, refined.solution) | {"stopped_vertices": refined.stopped}
        context.note(f"refined mesh: {record}")
        shaped = replace(shaped, shape_record=record)
        if record["refined"]:
            shaped = replace(shaped, lit=refined.lit, solution=refined.solution)
            if tracked is not None and settings.pose_rounds:
                mesh_so_far, poses = refined.lit.surface, views.camera_from_head
                again = repeat_poses(tracked, mesh_so_far, poses, settings.pose_rounds, context)
                shaped = replace(shaped, pose_record=again.record)
                if again.serves:
                    views = replace(views, camera_from_head=again.camera_from_head)
                    refined = refined_from(views, refined.lit, refined.solution, mesh_so_far.mesh)
                    record = judge_shape(solution, refined.solution) | {"stopped_vertices": refined.stopped}
                    context.note(f"refined mesh, poses anew: {record}")
                    if record["refined"]:
                        shaped = Shaped(views, refined.lit, refined.solution, again.covariance, record, again.record)
    if len(directions) > len(shaped.lit.precomputed.directions):
        light_views = some_views(shaped.views, settings, settings.light_frames)
        lit = LitSurface.of(start, light_views, settings, chart, context, directions=directions)
        then = fit_appearance(lit.coarse, settings.appearance, report_to(context), start=solution)
        shaped = replace(shaped, lit=lit, solution=then)
    return shaped


@dataclass(frozen=True, eq=False)
class RefinedMesh:
    """A refined mesh with its light solved anew; stopped: vertices that moved less than wanted."""

    lit: LitSurface
    solution: Solution
    stopped: int


def judge_shape(before: Solution, after: Solution) -> dict:
    """Is the refined mesh kept, and why: held-out residuals, fitted ones where no frame could be held out.

    Steps of the shape are kept only where held-out frames fit better at the shape's own points. Those of the light are
    few, and others than before: some that hair spoils can turn the mean square. Where it rises the mesh is kept if the
    mean absolute error, which they hardly rule, does not rise by more than CHANCE.
    """
    name = "held_out" if before.held_out > 0 else "fitted"
    residuals = {"before": getattr(before, name), "after": getattr(after, name)}
    typical = [float(np.mean(solution.frame_errors)) for solution in (before, after)]
    kept = residuals["after"] < residuals["before"] or typical[1] < (1.0 + CHANCE) * typical[0]
    return {"refined": kept, name: residuals}


def refine_and_light(
    views: Views,
    surface: Surface,
    lit: LitSurface,
    solution: Solution,
    settings: InverseSettings,
    chart: ChartStatement | None,
    context: RunContext,
    directions: np.ndarray,
    begun: Mesh | None = None,
) -> RefinedMesh:
    """A surface's mesh refined under a solved light, and the light anew; lit: what the light was solved on; directions
    [J, 3] that light is summed along; begun: the mesh as it was refined before."""
    refined = refine_shape(
        some_views(views, settings, settings.shape.frames),
        surface,
        reflectance=Reflectance.of(solution, lit.precomputed, directions),
        appearance=settings.appearance,
        sizes=settings.sizes,
        settings=settings.shape,
        context=context,
        begun=begun,
    )
    light_views = some_views(views, settings, settings.light_frames)
    lit = LitSurface.of(refined.surface, light_views, settings, chart, context, surface.mesh, directions, solution.lamp)
    # Highlights that led astray on a mesh that was wrong are tried again on a better one.
    again = settings.appearance.specular and not solution.highlights_count
    start = replace(solution, highlights_count=True) if again else solution
    then = fit_appearance(lit.coarse, settings.appearance, report_to(context), start=start, shapes=again)
    return RefinedMesh(lit, then, refined.stopped)
