"""How far away the main lamp stands: solved by trying distances, judged by the errors of all frames.

A lamp at a distance between half a metre and two lights forehead and chin differently, and more or less as the head
turns and moves towards it. That is one number more than a far light has. The light is fitted anew with the lamp at each
of a few distances, far among them, and a parabola through the residuals of held-out frames finds what lies between. The
lamp is near where the mean absolute error falls by more than its standard error over all frames: one number does not
follow the noise of those it is fitted to, and the few that are held out decide by chance. Only light with a lamp in it
is tried.

Reference: [Breiman1984], section 3.4.3 (the one-standard-error rule).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shared.appearance.chart_scale import ChartStatement
from shared.appearance.fit import Solution, fit_appearance
from shared.appearance.observations import Capture
from shared.appearance.problem import AppearanceSettings
from shared.compute.run_context import RunContext
from shared.geometry.mesh import normalised
from shared.geometry.transforms import places_in_world
from shared.imaging.views import Views
from shared.inverse.lit_surface import LitSurface, report_to
from shared.inverse.problem import InverseSettings
from shared.rendering.direction_set import PARTS, concentrated, split_directions, widest_spacing
from shared.rendering.envmap import cube_directions, cube_resolution, cube_solid_angles, lamp_solid_angle, lamp_texels
from shared.rendering.near_lamp import FAR, NearLamp, SeenLamp
from shared.rendering.shading import light_along
from shared.rendering.transfer import spread_vertices
from shared.selection.candidates import gain

TRIED_MM = (1500.0, 1000.0, 700.0, 500.0, 400.0)
"""From far away on to nearer ones, as long as these serve, each from the light at the one before: a far lamp costs two
fits."""
NEAREST_MM = 300.0
"""Nearer, a lamp would stand among hair and shoulders."""
POINTS, FIRST_STEPS, STEPS = 400, 8, 3
"""Surface points that distances are judged on, and steps of the light at the first and at each other distance."""
LEAST_LAMP_SHARE = 0.25
"""Of the light, along directions that a lamp shines from: of one that gives less, the distance hardly shows."""
PASSING_POINTS = 64
ACROSS = 3.0
"""Directions over the radius of a lamp: a broad one needs none between those of an even set."""


@dataclass(frozen=True, eq=False)
class LitByLamp:
    """A surface lit by a near lamp, or as it was before where none is near, its solution, and a record of the distances
    that were tried, empty where there were none."""

    lit: LitSurface
    solution: Solution
    record: dict


def find_lamp(
    lit: LitSurface,
    solution: Solution,
    views: Views,
    settings: InverseSettings,
    chart: ChartStatement | None,
    context: RunContext,
) -> LitByLamp:
    """Lets the main lamp of a solved light stand near where settings.lamp_distance says so, or the frames; views:
    those that the light was solved from; lit: what it was solved on, along an even set of directions."""
    wanted, nothing = settings.lamp_distance, LitByLamp(lit, solution, {})
    if wanted == FAR or len(views.frames_of_lights) > 1 or not lit_by_lamp(lit.coarse, solution):
        return nothing
    moves = settings.appearance.light_moves(views.moves)
    nearest = main_lamp(solution.state.light, lit.coarse, views, moves, wanted or NEAREST_MM)

    def lit_along(lamp: NearLamp) -> LitSurface:
        directions = directions_towards(lamp, lit, views, moves)
        return LitSurface.of(lit.surface, views, settings, chart, context, directions=directions)

    fine = lit_along(nearest)
    start, record = fresh_highlights(solution, settings.appearance), {}
    if wanted is None:
        start, record = solve_distance(fine.coarse.some_points(POINTS), views, settings.appearance, start, moves,
                                       context.note)
        if start.lamp is None:
            return replace(nothing, record=record)
    else:
        start = replace(start, lamp=nearest)
    lamp = main_lamp(start.state.light, lit.coarse, views, moves, start.lamp.distance_mm)
    if wanted is None:
        fine = lit_along(lamp)  # it passes over fewer directions than the nearest that was tried
    fine = fine.with_lamp(lamp, views, moves)
    solution = fit_appearance(fine.coarse, settings.appearance, report_to(context), start=start, least=STEPS,
                              shapes=wanted is not None)
    return LitByLamp(fine, solution, record)


def fresh_highlights(solution: Solution, settings: AppearanceSettings) -> Solution:
    """The solution with highlights as they are at first: a far light may have lost them where the lamp is near."""
    if not settings.specular:
        return solution
    state = replace(solution.state, specular=settings.specular_prior[0], roughness=settings.roughness)
    return replace(solution, state=state, highlights_count=True)


def describe_lamp(
    lamp: NearLamp | None, light: np.ndarray, record: dict, views: Views, moves: str
) -> dict:
    """What solve.json says of the main lamp of a light [6 n^2, 3], as seen from the head's mean place, where envmap.exr
    sees the light from; empty where its distance was not asked for.

    A ball of radiance L and radius r at a distance D gives pi L r^2 / D^2 head-on: that of the lamp's solid angle.
    """
    if lamp is None:
        return dict(record)
    head = places_in_world(views.camera_from_head, moves).mean(0)
    resolution = cube_resolution(light)
    texels, seen = lamp.texels(resolution), lamp.seen_from(head, resolution)
    solid_angle = lamp_solid_angle(light, texels)
    power = cube_solid_angles(resolution)[texels] @ light[texels]
    return record | {
        "distance_mm": round(seen.distance_mm, 1),
        "position_mm": lamp.position.round(2).tolist(),
        "centre_mm": head.round(2).tolist(),
        "reach": round(seen.radius, 5),
        "radius_mm": round(lamp.distance_mm * (solid_angle / np.pi) ** 0.5, 2),
        "radiance": (power / solid_angle).round(4).tolist(),
    }


def main_lamp(light: np.ndarray, capture: Capture, views: Views, moves: str, distance_mm: float) -> NearLamp:
    """The brightest texel of a light [6 n^2, 3] linear and those around it as a lamp at a distance; moves: what moves
    against the light.

    Its centre is the mean place of the capture's points in the views: what they see of the lamp on average is the same
    at each distance, so that the light at one is a good start for another.
    """
    resolution, own = cube_resolution(light), lamp_texels(light)
    directions = cube_directions(resolution)[own]
    power = light[own].mean(1) * cube_solid_angles(resolution)[own]
    axis = normalised(power @ directions)
    radius = float(np.arccos(np.clip(directions @ axis, -1.0, 1.0)).max() + 1.0 / resolution)
    centre = capture.points.positions.mean(0) @ capture.world_from_head.mean(0).T
    centre += places_in_world(views.camera_from_head, moves).mean(0)
    return NearLamp(distance_mm, tuple(centre.tolist()), tuple(axis.tolist()), radius)


def lit_by_lamp(capture: Capture, solution: Solution) -> bool:
    """Whether a lamp gives LEAST_LAMP_SHARE of the light in some frame, seen along an even set of directions."""
    along = light_along(solution.state.light, capture.directions, capture.world_from_head)
    arriving = along.mean(2)
    share = arriving[concentrated(along)].sum(0) / np.maximum(arriving.sum(0), 1e-12)
    return bool(share.max() > LEAST_LAMP_SHARE)


def directions_towards(lamp: NearLamp, lit: LitSurface, views: Views, moves: str) -> np.ndarray:
    """[J, 3]: the even set that a surface was lit along, split as finely as a lamp asks for where it passes."""
    even = lit.precomputed.directions
    parts = int(np.clip(round((ACROSS * widest_spacing(even) / lamp.radius) ** 2), 1, PARTS))
    return split_directions(even, passing(lamp, even, lit.coarse.points.positions, views, moves), parts)


def passing(lamp: NearLamp, directions: np.ndarray, positions: np.ndarray, views: Views, moves: str) -> np.ndarray:
    """[J] bool: along which of an even set of directions [J, 3] some frame sees the lamp from some of the positions
    [P, 3] mm."""
    seen = SeenLamp.of(lamp, views.camera_from_head, moves)
    axis = np.einsum("fij,i->fj", seen.world_from_head, np.array(lamp.axis)) + seen.centres / lamp.distance_mm
    some = positions[spread_vertices(positions, PASSING_POINTS)]
    towards = normalised(axis[None] - some[:, None] / lamp.distance_mm).reshape(-1, 3)
    reach = np.cos(lamp.radius + 0.5 * widest_spacing(directions))
    found = np.zeros(len(directions), bool)
    for part in np.array_split(towards, max(1, len(towards) // 512)):
        found |= (directions @ part.T).max(1) > reach
    return found


def solve_distance(
    capture: Capture,
    views: Views,
    settings: AppearanceSettings,
    start: Solution,
    moves: str,
    note: Callable[[str], None],
) -> tuple[Solution, dict]:
    """The solution with the lamp at the distance that the frames have, or with none, and what was tried.

    capture: of these views, along directions that suit the lamp; start: of the light, with a lamp in it.
    """
    tried: dict[float, Solution] = {}

    def fit(distance: float, start: Solution, steps: int, shapes: bool = False) -> Solution:
        lamp = main_lamp(start.state.light, capture, views, moves, distance)
        seen = replace(capture, lamp=SeenLamp.of(lamp, views.camera_from_head, moves))
        found = fit_appearance(seen, replace(settings, steps=steps), start=start, least=steps - 1, shapes=shapes)
        note(f"lamp at {distance:.0f} mm: residual {found.held_out:.5f} held out")
        return found

    last = tried[FAR] = fit(FAR, start, FIRST_STEPS, shapes=True)
    for distance in TRIED_MM:
        before, last = last, fit(distance, last, STEPS)
        tried[distance] = last
        if last.held_out > before.held_out:
            break
    between = _least_between(tried)
    if between is not None:
        nearest = min(tried, key=lambda one: abs(1.0 / one - 1.0 / between))
        tried[between] = fit(between, tried[nearest], STEPS)
    best = min(tried, key=lambda one: tried[one].frame_errors.mean())
    errors = [tried[one].frame_errors for one in (FAR, best)]
    fall, standard_error = gain(*errors) if len(errors[0]) > 1 else (0.0, 0.0)
    near = best != FAR and fall > standard_error
    record = {
        "near": bool(near),
        "tried": [{"distance_mm": round(one, 1) if one != FAR else None, "held_out": tried[one].held_out}
                  for one in sorted(tried, reverse=True)],
        "fall": fall,
        "standard_error": standard_error,
    }
    note(f"main lamp: {record}")
    return tried[best] if near else replace(start, lamp=None), record


def _least_between(tried: dict[float, Solution]) -> float | None:
    """Where the parabola through the least residual and its neighbours, over the inverse distance, is least; None where
    an end is."""
    nearness = np.array(sorted(1.0 / one for one in tried))
    residual = np.array([tried[one].held_out for one in sorted(tried, reverse=True)])
    least = int(residual.argmin())
    if least in (0, len(residual) - 1):
        return None
    x, y = nearness[least - 1 : least + 2], residual[least - 1 : least + 2]
    bend, slope, _ = np.polyfit(x - x[1], y, 2)
    return float(1.0 / (x[1] - slope / (2.0 * bend)))
