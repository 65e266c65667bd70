"""Inverse rendering of a clip: appearance fit, then the texture pass, then the maps. Arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from shared.appearance.chart_scale import describe_scale, scale_warnings, state_chart
from shared.appearance.diagnostics import diagnostic_warnings, diagnostics_of, face_regions
from shared.appearance.fine_normals import NormalPass, resolved_texels
from shared.appearance.fit import Solution
from shared.appearance.light_models import SeveralLights
from shared.appearance.local_roughness import local_roughness
from shared.appearance.maps import make_maps
from shared.appearance.problem import AppearanceProblem
from shared.appearance.texture_pass import Clip, TexturePass
from shared.capture.chart import ChartObservation
from shared.geometry.mesh import uniform_laplacian
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.texels import TexelSurface
from shared.inverse.light_and_mesh import LitClip, solve_light
from shared.inverse.problem import (
    InverseInputs,
    InverseResult,
    InverseSettings,
    frames_of,
    frames_to_fit,
    shade_vertices,
)
from shared.inverse.published_clip import solve_by_reference
from shared.shape.gauss_newton import typical_edge
from shared.shape.refine import faces_of, meet_outline, surface_error

HAIRLINE_MM = 10.0
"""Bends of the hairline shorter than this are the mesh's, not the hair's."""


def solve_clip(
    inputs: InverseInputs,
    settings: InverseSettings,
    progress: Callable,
    note: Callable,
    observations: Sequence[ChartObservation] = (),
) -> InverseResult:
    """The whole of it. progress(items, label) wraps loops, note(text) logs a line; observations: of a colour chart in
    view.
    """
    viewer = SurfaceViewer.of(inputs.mesh)
    fitted = frames_to_fit(inputs, settings, viewer)
    if settings.reference is not None:
        return solve_by_reference(inputs, settings, settings.reference, fitted, progress, note)
    outline = {}
    if settings.shape is not None and settings.shape.contour is not None and inputs.face_segment is not None:
        frames = frames_of(inputs, settings, settings.shape.contour.frames, fitted)
        inputs, outline = meet_outline(inputs, frames, settings.shape.contour, note)
        viewer = SurfaceViewer.of(inputs.mesh)
    moves = settings.appearance.light_moves(inputs.moves)
    light = int(inputs.light_index[observations[0].frame]) if observations else 0
    chart, warning = state_chart(observations, viewer.scene, inputs.camera_from_head, inputs.intrinsics, moves, light)
    lit = solve_light(inputs, settings, viewer, fitted, chart, progress, note)
    inputs, settings, viewer = lit.inputs, lit.settings, lit.viewer.within_rim(surface_error(lit.inputs.tracks))
    diagnostics, solution = examine(lit)
    shading = shade_vertices(inputs, settings.appearance, viewer, lit.precomputed, solution, progress)
    surface = TexelSurface(inputs.mesh, settings.map_size)
    clip = Clip(inputs.picture, inputs.camera_from_head, inputs.intrinsics, fitted, inputs.light_index)
    typical = np.median(solution.state.albedo, axis=0)
    texture = TexturePass(
        surface, viewer, shading, clip, specular=specular_at(surface, solution), typical_albedo=typical,
        light_weights=solution.light_weights, region=scalp_of(inputs), progress=progress,
    )
    widths = settings.map_size * np.array(settings.specular_widths if settings.appearance.specular else (np.inf,))
    material, texture_record = texture.run(widths)
    roughness, local = solution.state.roughness, solution.local_roughness_fit
    roughness = roughness if local is None else local.roughness(inputs.mesh.vertices)
    turn, relief = None, {}
    if settings.normal_map:
        fine = NormalPass(surface, viewer, shading, clip, material, progress)
        turn, relief = fine.run(resolved_texels(surface, clip))
        note(f"fine normals: {relief}")
    maps = make_maps(surface, material, roughness, turn)
    warnings = [warning] * bool(warning) + scale_warnings(chart, typical)
    warnings += diagnostic_warnings(diagnostics, inputs.moves)
    shape_record = {**lit.shape_record, "outline": outline}
    record = {"texture": texture_record, "shape": shape_record, "relief": relief, "signs": diagnostics}
    record |= {"warnings": warnings, "albedo_scale": describe_scale(chart, typical), "rungs": lit.candidates}
    return InverseResult(solution, material, maps, shading, viewer, fitted, record)


def examine(lit: LitClip) -> tuple[dict[str, float], Solution]:
    """What the samples show beside the light: diagnostics of what the model cannot follow, and the solution with
    roughness that varies over the skin where that serves."""
    settings, solution, inputs = lit.settings.appearance, lit.solution, lit.inputs
    problem = AppearanceProblem.of(lit.capture, settings)
    positions = lit.capture.points.positions
    regions = face_regions(inputs.mesh, inputs.face_segment, inputs.segment_names, positions)
    diagnostics = diagnostics_of(problem, solution.state, regions)
    if settings.specular and settings.local_roughness:
        fit, said = local_roughness(problem, solution.state)
        solution = replace(solution, local_roughness_fit=fit, roughness_record=said)
    return diagnostics, solution


def scalp_of(inputs: InverseInputs) -> np.ndarray | None:
    """[V] bool: vertices of the scalp, whose hair says nothing of the skin, within a border as smooth as a hairline;
    None where the mesh has no segments."""
    if inputs.face_segment is None:
        return None
    mesh = inputs.mesh
    scalp = np.zeros(len(mesh.vertices))
    scalp[mesh.faces[faces_of(inputs, ("scalp",))]] = 1.0
    laplacian = uniform_laplacian(mesh.faces, len(scalp))
    for _ in range(round((HAIRLINE_MM / typical_edge(mesh.vertices, mesh.faces)) ** 2)):
        scalp -= 0.5 * (laplacian @ scalp)
    return scalp > 0.5


def specular_at(surface: TexelSurface, solution: Solution) -> float | np.ndarray:
    """The specular intensity that texels start from: one, or each its own [T]."""
    if solution.local_specular is None:
        return solution.state.specular
    return np.clip(solution.local_specular.specular_at(surface.interpolate(surface.mesh.vertices)), 0.0, 2.0)


def describe_light(state) -> str:
    """The light's model in words."""
    model, numbers = state.light_model, len(state.params)
    count = model.count if isinstance(model, SeveralLights) else 1
    several = f"{count} lights, each a " if count > 1 else ""
    return f"{several}cubemap of 6 x {model.resolution}^2 texels from {numbers // count} numbers per channel"


def summarise(inputs: InverseInputs, result: InverseResult) -> dict:
    """What solve.json says, but for which frames were rendered and held out."""
    solution, state = result.solution, result.solution.state
    seen = result.material.information > 1.0
    return {
        "model": {
            "light": describe_light(state),
            "specular_intensity": round(state.specular, 4),
            "specular_variation": "by segment" if solution.local_specular else result.record["texture"]["chosen"],
            "roughness": round(state.roughness, 4),
            "roughness_variation": solution.roughness_record,
            "moves": inputs.moves,
        },
        "residuals": {
            "fitted": solution.fitted,
            "held_out": solution.held_out,
            "texture_held_out": result.record["texture"]["held_out"],
        },
        **{key: result.record[key] for key in ("shape", "relief", "signs") if key in result.record},
        **({"ladder": [dict(candidate) for candidate in result.record["rungs"]]} if result.record.get("rungs") else {}),
        "iterations": list(solution.iterations),
        "albedo_scale": result.record["albedo_scale"],
        "seen_share_of_texels": round(float(seen.mean()), 4),
        "warnings": warnings_about(result),
    }


def warnings_about(result: InverseResult) -> list[str]:
    """What a person should know before trusting the maps."""
    found, solution = list(result.record["warnings"]), result.solution
    if solution.held_out > 1.3 * solution.fitted:
        found.append(
            f"frames held out fit worse ({solution.held_out:.4f}) than fitted ones ({solution.fitted:.4f}): "
            "poses or shape may be off, or the light changed"
        )
    if solution.held_out > 0.06:
        found.append(f"the model explains the clip poorly: residual {solution.held_out:.3f} of full scale")
    return found
