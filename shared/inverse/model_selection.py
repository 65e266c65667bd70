"""Model selection on a clip: on few points of the lit surface, judged by more frames than the solve holds out.

Only the light's and the skin's parts are chosen here. Whether the mesh is refined, the poses are solved anew, and
roughness and specular intensity vary over the skin, held-out frames decide under any model, where each is solved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from shared.appearance.fit import Solution, fit_all_points
from shared.appearance.observations import Capture
from shared.compute.run_context import RunContext
from shared.imaging.frame_index import hold_out
from shared.inverse.lit_surface import LitSurface, report_to
from shared.inverse.problem import InverseSettings
from shared.selection.candidates import FEWEST_HELD_OUT, ModelSelection, allowed_candidates

POINTS, HOLD_OUT_EVERY = 400, 3
"""Surface points that candidates are tried on, and which share of the frames judges: one in so many, and all that are
held out anyway."""


@dataclass(frozen=True)
class SelectedModel:
    """What is left to solve, the light's solution on the lit surface, and the record of the candidates."""

    settings: InverseSettings
    solution: Solution
    candidates: tuple[dict, ...] = ()


def judged_capture(capture: Capture, settings: InverseSettings) -> Capture:
    """What a capture shows of few points, more of its frames held out; none is fitted that was held out before. Frames
    that are few and chosen stay as they are."""
    few = capture.some_points(POINTS)
    if settings.fit_frames:
        return few
    judging = hold_out(len(few.fitted), HOLD_OUT_EVERY, few.light_index)
    return replace(few, fitted=few.fitted & judging)


def select(lit: LitSurface, settings: InverseSettings, context: RunContext) -> SelectedModel | None:
    """Chooses the model of a clip and solves its light; None: too few frames are held out."""
    capture = judged_capture(lit.coarse, settings)
    held_out = int((~capture.fitted).sum())
    if held_out < FEWEST_HELD_OUT:
        context.note(f"the model is not chosen: {held_out} frames are too few to judge it by; all of it is solved")
        return None
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
    settings = replace(settings, appearance=present.model.applied(settings.appearance))
    solution = fit_all_points(lit.coarse, settings.appearance, present.solution, report_to(context))
    return SelectedModel(settings, solution, tuple(records))
