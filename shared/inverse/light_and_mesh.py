"""A clip's light and mesh: light on the tracked mesh, the mesh refined under it, light anew, and which mesh is kept.

Either with the full model or with the one that model selection leads to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from shared.appearance.fit import Solution, fit_appearance
from shared.appearance.observations import Capture
from shared.imaging.image_sampling import SurfaceViewer
from shared.inverse.model_selection import select
from shared.inverse.problem import InverseInputs, InverseSettings, capture_skin, frames_of
from shared.rendering.precomputed_transfer import PrecomputedTransfer, precompute_transfer
from shared.shape.gauss_newton import Reflectance
from shared.shape.refine import refine_shape, subdivided_to


@dataclass(frozen=True)
class LitClip:
    """A clip before its texture pass: the inputs with the mesh that was chosen and its viewer and precomputed transfer,
    settings of the model that was chosen, the capture and its solution, what became of the mesh, model selection's
    candidates; tracked: the solution before the mesh was refined, where it was tried."""

    inputs: InverseInputs
    settings: InverseSettings
    viewer: SurfaceViewer
    precomputed: PrecomputedTransfer
    capture: Capture
    solution: Solution
    shape_record: dict
    candidates: tuple[dict, ...]
    tracked: Solution | None = None


def solve_light(
    inputs: InverseInputs, settings: InverseSettings, viewer: SurfaceViewer, fitted, chart, progress, note
) -> LitClip:
    """Light and mesh: those of the full model, or of the one that model selection leads to."""
    start, variation, tracked, shape_record, candidates = None, None, None, {"refined": False}, ()
    if settings.selection is not None:
        selected = select(inputs, settings, fitted, chart, progress, note)
        inputs, settings, start, variation = selected.inputs, selected.settings, selected.start, selected.variation
        shape_record, candidates = selected.shape_record, selected.candidates
        viewer = SurfaceViewer.of(inputs.mesh)
    precomputed = precompute_transfer(viewer, settings.sizes, settings.appearance.visibility)
    solution, capture = _fit_light(inputs, settings, viewer, precomputed, fitted, chart, progress, note, start)
    if settings.shape is not None and inputs.face_segment is not None:
        known = Reflectance.of(solution, precomputed)
        frames = frames_of(inputs, settings, settings.shape.frames, fitted)
        refined = refine_shape(inputs, frames, known, settings.appearance, settings.sizes, settings.shape, progress,
                               note)
        viewer_then = SurfaceViewer.of(refined.mesh, subdivided_to(inputs.mesh, refined.mesh).vertices)
        precomputed_then = precompute_transfer(viewer_then, settings.sizes, settings.appearance.visibility)
        then, capture_then = _fit_light(
            refined, settings, viewer_then, precomputed_then, fitted, chart, progress, note, start=solution
        )
        tracked, shape_record = solution, judge_shape(solution, then) | {"stopped_vertices": refined.stopped}
        note(f"refined mesh: {shape_record}")
        if shape_record["refined"]:
            inputs, viewer, precomputed = refined, viewer_then, precomputed_then
            solution, capture = then, capture_then
    solution = solution if variation is None else variation.worn_by(solution)
    return LitClip(inputs, settings, viewer, precomputed, capture, solution, shape_record, candidates, tracked)


def judge_shape(before: Solution, after: Solution) -> dict:
    """Is the refined mesh kept, and why: held-out residuals, fitted ones where no frame could be held out."""
    name = "held_out" if before.held_out > 0 else "fitted"
    residuals = {"before": getattr(before, name), "after": getattr(after, name)}
    return {"refined": residuals["after"] < residuals["before"], name: residuals}


def _fit_light(
    inputs, settings, viewer, precomputed: PrecomputedTransfer, fitted, chart, progress, note,
    start: Solution | None = None
) -> tuple[Solution, Capture]:
    frames = frames_of(inputs, settings, settings.light_frames, fitted)
    moves, count = settings.appearance.light_moves(inputs.moves), settings.sizes.points
    capture = replace(capture_skin(inputs, viewer, precomputed, frames, moves, count, progress), chart=chart)
    selected = settings.selection is not None and start is not None
    solution = fit_appearance(
        capture, settings.appearance, report=lambda record: note(_describe(record)), start=start, keep_start=selected
    )
    return solution, capture


def _describe(record: dict) -> str:
    return (
        f"{record['light']} {record['resolution']}, step {record['step']}: residual {record['fitted']:.5f} fitted, "
        f"{record['held_out']:.5f} held out; specular {record['specular_intensity']:.3f}, "
        f"roughness {record['roughness']:.3f}"
    )
