"""Inverse rendering of a clip: appearance fit, then the texture pass, then the maps. Arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from shared.appearance.chart_scale import ChartStatement, describe_scale, scale_warnings, state_chart
from shared.appearance.diagnostics import diagnostic_warnings, diagnostics_of, face_regions
from shared.appearance.eye_whites import describe_whites
from shared.appearance.fit import Solution, at_mean_scale, fit_all_points, fit_appearance, fit_sharper_light
from shared.appearance.light_models import SeveralLights
from shared.appearance.local_roughness import local_roughness
from shared.appearance.problem import AppearanceProblem, AppearanceSettings
from shared.appearance.projection import ROUGHNESS_RANGE, SPECULAR_RANGE, reached_end
from shared.capture.chart import ChartObservation
from shared.compute.run_context import SILENT, RunContext
from shared.geometry.surface import Surface
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.views import Views
from shared.inverse.clip_inputs import TrackedPoses
from shared.inverse.exposure import exposure_warnings, solve_exposure
from shared.inverse.lamp_distance import describe_lamp, find_lamp
from shared.inverse.lit_surface import LitSurface, report_to
from shared.inverse.model_selection import select
from shared.inverse.problem import InverseSettings, frames_to_fit, some_views
from shared.inverse.published_clip import solve_by_reference
from shared.inverse.result import InverseResult
from shared.inverse.shaping import shape_and_turn
from shared.inverse.solve_texels import solve_texels
from shared.shape.refine import meet_outline, surface_error
from shared.shape.silhouette import LEAST_MET

LEAST_SEEN_SHARE = 0.01
"""Of the map: a clip that shows less of it gives no result, and one that determines less gives a warning."""


def solve_clip(
    views: Views,
    surface: Surface,
    settings: InverseSettings,
    context: RunContext = SILENT,
    observations: Sequence[ChartObservation] = (),
    tracked: TrackedPoses | None = None,
) -> InverseResult:
    """The whole of it. views: which of them are fitted is decided here; observations: of a colour chart in view;
    tracked: what the poses can be tracked from again, None: they stay as they are."""
    viewer = SurfaceViewer.of(surface.mesh)
    views = views.with_fitted(frames_to_fit(views, surface, settings, viewer))
    if settings.reference is not None:
        return solve_by_reference(views, surface, settings, settings.reference, context)
    outline = {}
    if settings.shape is not None and settings.shape.contour is not None and surface.face_segment is not None:
        contour = settings.shape.contour
        surface, outline = meet_outline(some_views(views, settings, contour.frames), surface, contour, context)
        viewer = SurfaceViewer.of(surface.mesh)
    chart, chart_warning = said_by_chart(observations, viewer, views, settings)

    # Light on the mesh as it was tracked, of the model that is chosen there where one is to be.
    selected = None if settings.selection is None else select(surface, views, settings, chart, context)
    settings = settings if selected is None else selected.settings
    light_views = some_views(views, settings, settings.light_frames)
    if selected is None:
        lit = LitSurface.of(surface, light_views, settings, chart, context)
        solution = fit_appearance(lit.coarse, settings.appearance, report_to(context))
    else:
        lit, solution = selected.lit, selected.solution

    # A lamp that stands near, where held-out frames ask for one.
    by_lamp = find_lamp(lit, solution, light_views, settings, chart, context)

    # Where the camera's exposure wandered, all of it anew from frames as bright as one still light makes them.
    exposure = solve_exposure(views, by_lamp.lit, by_lamp.solution, settings, context)
    if exposure is not None:
        views = replace(views, gain=exposure.gain)
        steady = [observation.over(exposure.gain[observation.frame]) for observation in observations]
        chart, chart_warning = said_by_chart(steady, viewer, views, settings)
        light_views = some_views(views, settings, settings.light_frames)
        lit = LitSurface.of(surface, light_views, settings, chart, context)
        solution = fit_appearance(lit.coarse, settings.appearance, report_to(context), start=exposure.solution,
                                  shapes=True)
        by_lamp = find_lamp(lit, solution, light_views, settings, chart, context)
    lit, solution = by_lamp.lit, by_lamp.solution

    # Then closer directions where a lamp shines, the mesh refined under that light, and the poses anew on that mesh.
    shaped = shape_and_turn(views, lit, solution, settings, chart, tracked, context)
    views, lit, solution = shaped.views, shaped.lit, shaped.solution
    shape_record = {"refined": False} | shaped.shape_record
    solution = fit_sharper_light(lit.coarse, settings.appearance, solution, report_to(context))
    if lit.coarse is not lit.capture:
        solution = fit_all_points(lit.capture, settings.appearance.at_last, solution, report_to(context))
    diagnostics, solution, whites = examine(lit, settings.appearance, at_mean_scale(solution))

    # Under that light, of that shape: every texel's material, and relief finer than the mesh.
    if settings.smooth_rim and surface.face_segment is not None:
        lit = lit.with_smooth_rim(settings)
    surface, precomputed = lit.surface, lit.precomputed
    viewer = lit.viewer.within_rim(surface_error(surface.tracks))
    covariance, pose_record = shaped.covariance, shaped.pose_record
    solved_from = {"frames": len(lit.capture.fitted), "points": len(lit.capture.points),
                   "directions": len(precomputed.directions), "bounce_nodes": len(precomputed.nodes.points)}
    lit = shaped = None  # texels need the memory that the points' samples and transfer take
    stands_off = outline.get("met", 1.0) < LEAST_MET
    texels, told = solve_texels(views, surface, viewer, precomputed, settings, solution, stands_off, context)
    typical = np.median(solution.state.albedo, axis=0)
    record = {
        **told,
        "solved_from": solved_from,
        "shape": {**shape_record, "outline": outline},
        "poses": pose_record,
        "exposure": {} if exposure is None else exposure.record,
        "lamp": describe_lamp(solution.lamp, solution.state.light, by_lamp.record, views,
                              settings.appearance.light_moves(views.moves)),
        "diagnostics": diagnostics,
        "warnings": [*filter(None, [chart_warning]), *scale_warnings(chart, typical),
                     *exposure_warnings(exposure), *diagnostic_warnings(diagnostics, views.moves)],
        "albedo_scale": describe_scale(chart, typical, whites, solution.scale, settings.appearance.tints),
        "model_selection": () if selected is None else selected.candidates,
    }
    return InverseResult(solution, texels, views, record, covariance)


def said_by_chart(
    observations: Sequence[ChartObservation], viewer: SurfaceViewer, views: Views, settings: InverseSettings
) -> tuple[ChartStatement | None, str]:
    """What a chart in view says, or None and a warning: see state_chart."""
    return state_chart(
        observations,
        viewer.scene,
        views.camera_from_head,
        views.intrinsics,
        settings.appearance.light_moves(views.moves),
        light=int(views.light_index[observations[0].frame]) if observations else 0,
    )


def examine(
    lit: LitSurface, settings: AppearanceSettings, solution: Solution
) -> tuple[dict[str, float], Solution, dict | None]:
    """What the samples show beside the light: diagnostics of what the model cannot follow, the solution with roughness
    that varies over the skin where that serves, and what the whites of the eyes say of the scale, None: nothing."""
    problem, surface = AppearanceProblem.of(lit.capture, settings), lit.surface
    positions = lit.capture.points.positions
    regions = face_regions(surface.mesh, surface.face_segment, surface.segment_names, positions)
    diagnostics = diagnostics_of(problem, solution.state, regions)
    if settings.specular and settings.local_roughness:
        fit, said = local_roughness(problem, solution.state)
        solution = replace(solution, local_roughness_fit=fit, roughness_record=said)
    whites = None
    if (said := problem.said_by_whites(solution.state)) is not None:
        log_factor, covariance = said
        whites = describe_whites(len(lit.capture.whites.points), log_factor, covariance)
    return diagnostics, solution, whites


def describe_light(state) -> str:
    """The light's model in words."""
    model, numbers = state.light_model, len(state.params)
    count = model.count if isinstance(model, SeveralLights) else 1
    several = f"{count} lights, each a " if count > 1 else ""
    return f"{several}cubemap of 6 x {model.resolution}^2 texels from {numbers // count} numbers per channel"


def summarise(result: InverseResult, moves: str) -> dict:
    """What solve.json says, but for which frames were rendered and held out; moves: the head or the camera."""
    solution, state = result.solution, result.solution.state
    seen, tried = result.texels.material.information > 1.0, result.record.get("model_selection")
    return {
        "model": {
            "light": describe_light(state),
            "specular_intensity": round(state.specular, 4),
            "specular_variation": result.record["texture"]["chosen"],
            "contradicted_texels": result.record["texture"]["contradicted"]["chosen"],
            "roughness": round(state.roughness, 4),
            "roughness_variation": solution.roughness_record,
            "moves": moves,
            **({"solved_from": found} if (found := result.record.get("solved_from")) else {}),
            "map_size": len(result.texels.maps["confidence"]),
        },
        "residuals": {
            "fitted": solution.fitted,
            "held_out": solution.held_out,
            "texture_held_out": result.record["texture"]["held_out"],
            "contradicted_held_out": result.record["texture"]["contradicted"]["held_out"],
        },
        **{key: result.record[key] for key in ("shape", "poses", "relief", "diagnostics") if key in result.record},
        **({"exposure": exposure} if (exposure := result.record.get("exposure")) else {}),
        **({"lamp": lamp} if (lamp := result.record.get("lamp")) else {}),
        **({"hair": hair} if (hair := result.record.get("hair")) else {}),
        **({"catchlights": found} if (found := result.record.get("catchlights")) else {}),
        **({"model_selection": [dict(candidate) for candidate in tried]} if tried else {}),
        "iterations": list(solution.iterations),
        "albedo_scale": result.record["albedo_scale"],
        "seen_share_of_texels": round(float(seen.mean()), 4),
        "warnings": warnings_about(result),
    }


def in_words(record: Mapping) -> str:
    """The solved model of a solve.json in one line for people."""
    model, lamp = record["model"], record.get("lamp", {})
    used = model.get("solved_from")
    roughness = "local" if model["roughness_variation"].get("chosen") == "local" else "one"
    parts = (
        f"light of {model['light'].rpartition(' from ')[2]}",
        "" if used is None else f"from {used['points']} points in {used['frames']} frames",
        f"{roughness} roughness" if model["specular_intensity"] else "no highlights",
        f"lamp {lamp['distance_mm'] / 1000:.2f} m away" if "distance_mm" in lamp else "",
        "shape refined" if record.get("shape", {}).get("refined") else "shape as tracked",
        "poses solved anew on it" if record.get("poses", {}).get("kept") else "",
        "exposure of each frame" if record.get("exposure") else "",
        f"maps of {model['map_size']} texels",
    )
    return ", ".join(filter(None, parts))


def warnings_about(result: InverseResult) -> list[str]:
    """What a person should know before using the maps."""
    solution = result.solution
    found = list(result.record["warnings"]) + highlight_warnings(solution)
    if solution.held_out > 1.3 * solution.fitted:
        found.append(
            f"frames held out fit worse ({solution.held_out:.4f}) than fitted ones ({solution.fitted:.4f}): "
            "poses or shape may be off, or the light changed"
        )
    if (result.texels.maps["confidence"] > 0.5).mean() < LEAST_SEEN_SHARE:
        found.append("the clip determines hardly any of the maps (see the confidence map): its frames contradict each "
                     "other, are too dark or blurred, or do not encode light as colour.transfer says")
    if solution.held_out > 0.06:
        found.append(f"the model explains the clip poorly: residual {solution.held_out:.3f} of full scale")
    return found


def highlight_warnings(solution: Solution) -> list[str]:
    """Where roughness or specular intensity are not what this person's highlights show."""
    state = solution.state
    if state.specular == 0.0:
        return []
    if not solution.highlights_count:
        return ["highlights led the fit astray, so roughness and specular intensity are usual values of skin: the clip "
                "shows few, or its shape or light is off where they lie"]
    values = (("roughness", state.roughness, ROUGHNESS_RANGE), ("specular intensity", state.specular, SPECULAR_RANGE))
    return [f"the {name} ended at {value:.2f}, the {end} end of its range: it is not this person's, but takes up what "
            "the light or the shape lacks" for name, value, allowed in values if (end := reached_end(value, allowed))]
