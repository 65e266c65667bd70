"""Model selection on a clip: the small capture of the tracked mesh that it looks at, and what is then left to solve.

Only the light's and the skin's parts are chosen here. Whether the mesh is refined, the poses are solved anew, and
roughness and specular intensity vary over the skin, held-out frames decide under any model, where each is solved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from shared.appearance.chart_scale import ChartStatement
from shared.appearance.fit import Solution
from shared.appearance.observations import Capture, build_capture
from shared.compute.run_context import RunContext
from shared.geometry.surface import Surface
from shared.imaging.frame_index import hold_out, spread_frames
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.turning_eyes import TurningEyes
from shared.imaging.views import Views
from shared.inverse.problem import FACE_SKIN, InverseSettings, some_views
from shared.rendering.precomputed_transfer import Sizes, precompute_transfer
from shared.selection.candidates import FEWEST_HELD_OUT, ModelSelection, allowed_candidates

SELECTION_SIZES = Sizes(points=600, directions=768, nodes=200)
SELECTION_FRAMES, SELECTION_HOLD_OUT = 36, 3
"""Frames that model selection looks at, and which share of them judges: one in so many, and all that are held out
anyway."""


@dataclass(frozen=True)
class SelectedModel:
    """What is left to solve, a solution to start from, and the record of the candidates."""

    settings: InverseSettings
    start: Solution | None = None
    candidates: tuple[dict, ...] = ()


def small_capture(
    views: Views, surface: Surface, settings: InverseSettings, chart: ChartStatement | None, context: RunContext
) -> Capture:
    """Capture of a surface with few points, views and directions."""
    full = settings.sizes
    sizes = Sizes(**{name: min(getattr(full, name), most) for name, most in vars(SELECTION_SIZES).items()})
    viewer = SurfaceViewer.of(surface.mesh)
    precomputed = precompute_transfer(viewer, sizes, settings.appearance.visibility)
    moves, skin = settings.appearance.light_moves(views.moves), surface.vertices_of(FACE_SKIN)
    few = selection_views(views, settings)
    eyes = None if few.gaze is None else TurningEyes.of(surface)
    seen = build_capture(viewer, precomputed, few, moves, skin, sizes.points, context, eyes)
    return replace(seen, chart=chart)


def selection_views(views: Views, settings: InverseSettings) -> Views:
    """Views that model selection looks at; none is fitted that is held out of the whole solve."""
    if settings.fit_frames:
        return some_views(views, settings, SELECTION_FRAMES)
    chosen = spread_frames(len(views), SELECTION_FRAMES, views.light_index)
    judging = hold_out(len(chosen), SELECTION_HOLD_OUT, views.light_index[chosen])
    return views.take(chosen, views.fitted[chosen] & judging)


def select(
    views: Views, surface: Surface, settings: InverseSettings, chart: ChartStatement | None, context: RunContext
) -> SelectedModel:
    """Chooses the model of a clip; chart: what a colour chart says of the light, or None."""
    capture = small_capture(views, surface, settings, chart, context)
    held_out = int((~capture.fitted).sum())
    if held_out < FEWEST_HELD_OUT:
        context.note(f"the model is not chosen: {held_out} frames are too few to judge it by; all of it is solved")
        return SelectedModel(replace(settings, selection=None))
    records = []

    def report(record: dict) -> None:
        records.append(record)
        fall = "" if record["fall"] is None else f", {-record['fall']:+.6f} +- {record['standard_error']:.6f}"
        said = "accepted" if record["accepted"] else "not accepted"
        said += ", since held-out frames leave it open" if record["open"] else ""
        text = f"{record['part']} {record['candidate']}: {record['held_out']:.6f} held out{fall}"
        context.note(f"model selection: {text}; {said} ({record['seconds']:.1f} s)")

    candidates = allowed_candidates(settings.appearance, settings.selection)
    present = ModelSelection(capture, settings.appearance, candidates, report).select()
    appearance = present.model.applied(settings.appearance)
    return SelectedModel(replace(settings, appearance=appearance), present.solution, tuple(records))
