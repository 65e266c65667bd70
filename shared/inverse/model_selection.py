"""Model selection on a clip: the small captures that it looks at, the mesh's candidates, and what is then left to
solve."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from shared.appearance.fit import Solution
from shared.appearance.observations import Capture
from shared.geometry.mesh import segments_at
from shared.imaging.frame_index import hold_out, spread_frames
from shared.imaging.image_sampling import SurfaceViewer
from shared.inverse.problem import InverseInputs, InverseSettings, capture_skin, frames_of
from shared.rendering.precomputed_transfer import Sizes, precompute_transfer
from shared.selection.candidates import FEWEST_HELD_OUT, ModelSelection, allowed_candidates, describe, serves
from shared.selection.specular import POOLING, VARIATIONS, SpecularSelection, SpecularVariation
from shared.shape.gauss_newton import Reflectance, ShapeSettings
from shared.shape.refine import refine_shape

SELECTION_SIZES = Sizes(points=600, directions=768, nodes=200)
SELECTION_FRAMES, SELECTION_HOLD_OUT = 36, 3
"""Frames that model selection looks at, and which share of them judges: one in so many, and all that are held out
anyway."""


@dataclass(frozen=True)
class SelectedModel:
    """The clip with the mesh that was chosen, what is left to solve, a solution to start from, how its
    specular terms vary,
    what became of the mesh, and the record of the candidates."""

    inputs: InverseInputs
    settings: InverseSettings
    start: Solution | None = None
    variation: SpecularVariation | None = None
    shape_record: dict = field(default_factory=lambda: {"refined": False})
    candidates: tuple[dict, ...] = ()


class Made(dict):
    """Values that are made when they are first asked for."""

    def __init__(self, make: Callable):
        super().__init__()
        self._make = make

    def __missing__(self, key):
        value = self[key] = self._make(key)
        return value


class SmallClip:
    """A clip's captures with few points, frames and directions, from one mesh: with visibility (True) and without."""

    def __init__(self, inputs: InverseInputs, settings: InverseSettings, fitted: np.ndarray, chart, progress: Callable):
        self.inputs, full = inputs, settings.sizes
        self.sizes = Sizes(**{name: min(getattr(full, name), most) for name, most in vars(SELECTION_SIZES).items()})
        viewer = SurfaceViewer.of(inputs.mesh)
        self.precomputed = Made(lambda visibility: precompute_transfer(viewer, self.sizes, visibility))
        frames = selection_frames(inputs, settings, fitted)
        moves, count = settings.appearance.light_moves(inputs.moves), self.sizes.points
        seen = capture_skin(inputs, viewer, self.precomputed[True], frames, moves, count, progress)
        self.captures = Made(self._without_visibility)
        self.captures[True] = replace(seen, chart=chart)

    def _without_visibility(self, visibility: bool) -> Capture:
        seen, bare = self.captures[True], self.precomputed[visibility]
        return replace(seen, transfer=bare.trace(seen.points), node_transfer=bare.node_transfer)


def selection_frames(
    inputs: InverseInputs, settings: InverseSettings, fitted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Frames that model selection looks at, and which of them are fitted: none that is held out of the whole solve."""
    if settings.fit_frames:
        return frames_of(inputs, settings, SELECTION_FRAMES, fitted)
    lights = inputs.light_index
    chosen = spread_frames(len(fitted), SELECTION_FRAMES, lights)
    return chosen, fitted[chosen] & hold_out(len(chosen), SELECTION_HOLD_OUT, lights[chosen])


def select(
    inputs: InverseInputs, settings: InverseSettings, fitted: np.ndarray, chart, progress: Callable, note: Callable
) -> SelectedModel:
    """Chooses the model of a clip. fitted [F] bool; chart: what a colour chart says of the light, or None."""
    selector = _ClipSelection(inputs, settings, fitted, chart, progress, note)
    if selector.held_out < FEWEST_HELD_OUT:
        note(f"the model is not chosen: {selector.held_out} frames are too few to judge it by; all of it is solved")
        return SelectedModel(inputs, replace(settings, selection=None))
    selector.select()
    return selector.selected()


class _ClipSelection:
    """Appearance on the tracked mesh, then the mesh, then the appearance again where the mesh changed."""

    def __init__(self, inputs, settings: InverseSettings, fitted: np.ndarray, chart, progress, note):
        self.settings, self.fitted, self.chart = settings, fitted, chart
        self.progress, self.note, self.candidates = progress, note, []
        self.forced = settings.selection
        self.tracked = self.small = SmallClip(inputs, settings, fitted, chart, progress)
        self.held_out = int((~self.small.captures[True].fitted).sum())
        self.selection = self._selection(self.small)
        self.shape_record: dict = {"refined": False}
        self.variation = SpecularVariation()

    def select(self) -> None:
        """All parts; the result stands in small, selection.present and variation."""
        self.selection.select()
        if self.settings.shape is not None and self.small.inputs.face_segment is not None:
            self._select_geometry(self.settings.shape)
        if self.selection.present.model.specular != "none":
            self._select_specular()

    def _select_geometry(self, shape: ShapeSettings) -> None:
        before = self.selection.present
        for subdivisions in range(shape.subdivisions + 1):
            if not self._refine(replace(shape, subdivisions=subdivisions, looks_back=False)):
                break
        if self.small is not self.tracked:
            after = self.selection.present
            residuals = {"before": float(before.errors.mean()), "after": float(after.errors.mean())}
            stopped = self.small.inputs.stopped
            self.shape_record = {"refined": True, "held_out": residuals, "stopped_vertices": stopped}
            self.selection.select()

    def _select_specular(self) -> None:
        present, inputs, settings = self.selection.present, self.small.inputs, self.settings.appearance
        capture = self.small.captures[present.model.visibility != "off"]
        segment = segments_at(inputs.mesh, inputs.face_segment, capture.points.positions)
        free = {"specular": True, "roughness": settings.local_roughness}
        candidates = {part: VARIATIONS[: 3 if free[part] and part not in self.forced else 1] for part in free}
        applied = present.model.applied(settings)
        self.variation = SpecularSelection(capture, applied, present, segment, candidates, self._report).select()

    def _refine(self, shape: ShapeSettings) -> bool:
        """Refines the tracked mesh, or goes on refining it, under the present solution; kept where that serves."""
        start = time.perf_counter()
        below, tracked, below_is_tracked = self.selection.present, self.tracked.inputs, self.small is self.tracked
        appearance = below.model.applied(self.settings.appearance)
        known = Reflectance.of(below.solution, self.small.precomputed[appearance.visibility])
        frames = frames_of(tracked, self.settings, shape.frames, self.fitted)
        refined = refine_shape(
            tracked, frames, reflectance=known, appearance=appearance, sizes=self.small.sizes, settings=shape,
            progress=self.progress, note=self.note, begun=None if below_is_tracked else self.small.inputs,
        )
        small = SmallClip(refined, self.settings, self.fitted, self.chart, self.progress)
        selection = self._selection(small)
        selection.begin(below.model, below.solution)
        trial = replace(selection.present, seconds=time.perf_counter() - start)
        better = "geometry" in self.forced or serves(below.errors, trial.errors)
        name = "refined" if shape.subdivisions == 0 else f"subdivided_{shape.subdivisions}"
        self._report(describe("geometry", name, trial, below, better))
        if better:
            self.small, self.selection = small, selection
        return better

    def _selection(self, small: SmallClip) -> ModelSelection:
        candidates = allowed_candidates(self.settings.appearance, self.forced)
        return ModelSelection(small.captures, self.settings.appearance, candidates, self._report)

    def _report(self, record: dict) -> None:
        self.candidates.append(record)
        fall = "" if record["fall"] is None else f", {-record['fall']:+.6f} +- {record['standard_error']:.6f}"
        said = "accepted" if record["climbed"] else "not accepted"
        text = f"{record['part']} {record['rung']}: {record['held_out']:.6f} held out{fall}"
        self.note(f"model selection: {text}; {said} ({record['seconds']:.1f} s)")

    def selected(self) -> SelectedModel:
        """What is left to solve."""
        present, settings, forced = self.selection.present, self.settings, self.forced
        appearance = present.model.applied(settings.appearance)
        local = appearance.local_roughness and "roughness" in forced
        appearance = replace(appearance, local_roughness=local, fit_roughness=False)  # model selection found it
        widths = settings.specular_widths if "specular" in forced else POOLING[self.variation.specular]
        settings = replace(settings, appearance=appearance, shape=None, specular_widths=widths)
        return SelectedModel(
            self.small.inputs, settings, start=present.solution, variation=self.variation,
            shape_record=self.shape_record,
            candidates=tuple(self.candidates),
        )
