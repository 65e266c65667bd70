"""Model selection on a clip: no more model, and no more of the clip, than its scene needs.

The light's and the skin's parts are chosen on few points of the surface, judged by more frames than the solve holds
out; then how many frames, points and directions tell that light, and how fine maps the pictures fill. Whether the mesh
is refined, the poses are solved anew, and roughness and specular intensity vary over the skin, held-out frames decide
under any model, where each is solved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shared.appearance.chart_scale import ChartStatement
from shared.appearance.fit import Solution, fit_appearance
from shared.appearance.observations import Capture
from shared.compute.run_context import RunContext
from shared.compute.threads import single_thread
from shared.geometry.surface import Surface
from shared.imaging.frame_index import hold_out
from shared.imaging.image_sampling import texel_size
from shared.imaging.views import Views
from shared.inverse.lit_surface import LitSurface, report_to
from shared.inverse.problem import FACE_SKIN, InverseSettings, some_views
from shared.rendering.precomputed_transfer import Sizes
from shared.selection.candidates import FEWEST_HELD_OUT, ModelSelection, allowed_candidates
from shared.selection.samples import enough_samples

TRIAL = Sizes(points=400, directions=512, nodes=400)
"""On which candidates are tried; no more than the settings have."""
HOLD_OUT_EVERY = 3
"""Which share of the frames judges: one in so many, and all that are held out anyway."""
TEXELS_PER_PX = 2.0**0.5
"""Across the face where it is largest in the pictures: a grid of any turn against theirs holds them then."""
SMALLEST_MAP = 512
"""Below which smaller maps save no time."""


@dataclass(frozen=True)
class SelectedModel:
    """What is left to solve, the surface lit as the settings now say with the light's solution on it, and the record of
    the candidates."""

    settings: InverseSettings
    lit: LitSurface
    solution: Solution
    candidates: tuple[dict, ...] = ()


def judged_capture(capture: Capture, settings: InverseSettings) -> Capture:
    """A capture with more of its frames held out; none is fitted that was held out before. Frames that are few and
    chosen stay as they are."""
    if settings.fit_frames:
        return capture
    judging = hold_out(len(capture.fitted), HOLD_OUT_EVERY, capture.light_index)
    return replace(capture, fitted=capture.fitted & judging)


def select(
    surface: Surface, views: Views, settings: InverseSettings, chart: ChartStatement | None, context: RunContext
) -> SelectedModel | None:
    """Chooses the model of a clip and solves its light; None: too few frames are held out. views: all of the clip."""
    light_views = some_views(views, settings, settings.light_frames)
    lit = LitSurface.of(surface, light_views, replace(settings, sizes=settings.sizes.at_most(TRIAL)), chart, context)
    capture = judged_capture(lit.capture, settings)
    held_out = int((~capture.fitted).sum())
    if held_out < FEWEST_HELD_OUT:
        context.note(f"the model is not chosen: {held_out} frames are too few to judge it by; all of it is solved")
        return None
    records = []

    def report(record: dict) -> None:
        records.append(record)
        fall = "" if record["fall"] is None else f", {-record['fall']:+.6f} +- {record['standard_error']:.6f}"
        said = "accepted" if record["accepted"] else "not accepted"
        said += ", where held-out frames leave it open" if record["open"] else ""
        text = f"{record['part']} {record['candidate']}: {record['held_out']:.6f} held out{fall}"
        context.note(f"model selection: {text}; {said} ({record['seconds']:.1f} s)")

    candidates = allowed_candidates(settings.appearance, settings.selection)
    with single_thread():
        present = ModelSelection(capture, settings.appearance, candidates, report).select()
        chosen = replace(settings, appearance=present.model.applied(settings.appearance))
        if "samples" not in settings.selection:
            enough = enough_samples(
                capture, chosen.appearance, present.solution, settings.light_frames, settings.sizes
            )
            chosen = replace(chosen, light_frames=enough.frames, sizes=enough.sizes)
            context.note(f"model selection: {enough.told}")
    if "maps" not in settings.selection:
        chosen = replace(chosen, map_size=fitting_map_size(surface, views, settings.map_size))
    lit = LitSurface.of(surface, some_views(views, chosen, chosen.light_frames), chosen, chart, context)
    solution = fit_appearance(lit.coarse, chosen.appearance, report_to(context), start=present.solution)
    return SelectedModel(chosen, lit, solution, tuple(records))


def fitting_map_size(surface: Surface, views: Views, most: int) -> int:
    """Edge of the maps whose texels the views' pixels fill on the face, a power of two smaller than most or most."""
    on_face = np.ones(len(surface.mesh.faces), bool)
    if surface.face_segment is not None:
        on_face = surface.faces_of(FACE_SKIN)
    size, texel_mm = most, float(np.median(texel_size(surface.mesh, most)[on_face]))
    while size >= 2 * SMALLEST_MAP and 2.0 * texel_mm * TEXELS_PER_PX * views.px_per_mm <= 1.0:
        size, texel_mm = size // 2, 2.0 * texel_mm
    return size
