"""The ladder on a clip: the small captures that it is climbed on, the mesh's rungs, and what is then left to solve."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from shared.gather import SurfaceViewer
from shared.solve.appearance import Capture
from shared.solve.capture import Sizes, hold_out, set_scenery, spread_frames
from shared.solve.fit_appearance import Solution
from shared.solve.inverse_problem import InverseInputs, InverseSettings, capture_skin, frames_of
from shared.solve.ladder import FEWEST_HELD_OUT, Ladder, allowed_rungs, describe, serves
from shared.solve.ladder_gloss import POOLING, VARIATIONS, Gloss, GlossLadder, segments_at
from shared.solve.reshape import reshape
from shared.solve.shape import Reflectance, ShapeSettings

CLIMB_SIZES = Sizes(points=600, directions=768, nodes=200)
CLIMB_FRAMES, CLIMB_HOLD_OUT = 36, 3
"""Frames that the ladder looks at, and which share of them judges: one in so many, and all that are held out anyway."""


@dataclass(frozen=True)
class Climbed:
    """The clip with the mesh that was chosen, what is left to solve, a solution to start from, how its gloss varies,
    what became of the mesh, and the record of the rungs."""

    inputs: InverseInputs
    settings: InverseSettings
    start: Solution | None = None
    gloss: Gloss | None = None
    shape_record: dict = field(default_factory=lambda: {"refined": False})
    rungs: tuple[dict, ...] = ()


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
        self.sizes = Sizes(*(min(getattr(full, name), getattr(CLIMB_SIZES, name)) for name in vars(CLIMB_SIZES)))
        viewer = SurfaceViewer.of(inputs.mesh)
        self.scenery = Made(lambda visibility: set_scenery(viewer, self.sizes, visibility))
        frames = frames_to_climb(inputs, settings, fitted)
        moves, count = settings.appearance.light_moves(inputs.moves), self.sizes.points
        seen = capture_skin(inputs, viewer, self.scenery[True], frames, moves, count, progress)
        self.captures = Made(self._without_visibility)
        self.captures[True] = replace(seen, chart=chart)

    def _without_visibility(self, visibility: bool) -> Capture:
        seen, bare = self.captures[True], self.scenery[visibility]
        return replace(seen, transfer=bare.trace(seen.points), node_transfer=bare.node_transfer)


def frames_to_climb(
    inputs: InverseInputs, settings: InverseSettings, fitted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Frames that the ladder looks at, and which of them are fitted: none that is held out of the whole solve."""
    if settings.fit_frames:
        return frames_of(inputs, settings, CLIMB_FRAMES, fitted)
    lights = inputs.light_index
    chosen = spread_frames(len(fitted), CLIMB_FRAMES, lights)
    return chosen, fitted[chosen] & hold_out(len(chosen), CLIMB_HOLD_OUT, lights[chosen])


def climb(
    inputs: InverseInputs, settings: InverseSettings, fitted: np.ndarray, chart, progress: Callable, note: Callable
) -> Climbed:
    """Chooses the model of a clip. fitted [F] bool; chart: what a colour chart says of the light, or None."""
    climber = _Climber(inputs, settings, fitted, chart, progress, note)
    if climber.held_out < FEWEST_HELD_OUT:
        note(f"the model is not chosen: {climber.held_out} frames are too few to judge it by; all of it is solved")
        return Climbed(inputs, replace(settings, ladder=None))
    climber.climb()
    return climber.climbed()


class _Climber:
    """Appearance on the tracked mesh, then the mesh, then the appearance again where the mesh changed."""

    def __init__(self, inputs, settings: InverseSettings, fitted: np.ndarray, chart, progress, note):
        self.settings, self.fitted, self.chart = settings, fitted, chart
        self.progress, self.note, self.rungs = progress, note, []
        self.forced = settings.ladder
        self.tracked = self.small = SmallClip(inputs, settings, fitted, chart, progress)
        self.held_out = int((~self.small.captures[True].fitted).sum())
        self.ladder = self._ladder(self.small)
        self.shape_record: dict = {"refined": False}
        self.gloss = Gloss()

    def climb(self) -> None:
        """All parts; the result stands in small, ladder.present and gloss."""
        self.ladder.climb()
        if self.settings.shape is not None and self.small.inputs.face_segment is not None:
            self._climb_geometry(self.settings.shape)
        if self.ladder.present.model.specular != "none":
            self._climb_gloss()

    def _climb_geometry(self, shape: ShapeSettings) -> None:
        before = self.ladder.present
        for subdivisions in range(shape.subdivisions + 1):
            if not self._refine(replace(shape, subdivisions=subdivisions, looks_back=False)):
                break
        if self.small is not self.tracked:
            after = self.ladder.present
            residuals = {"before": float(before.errors.mean()), "after": float(after.errors.mean())}
            stopped = self.small.inputs.stopped
            self.shape_record = {"refined": True, "held_out": residuals, "stopped_vertices": stopped}
            self.ladder.climb()

    def _climb_gloss(self) -> None:
        present, inputs, settings = self.ladder.present, self.small.inputs, self.settings.appearance
        capture = self.small.captures[present.model.visibility != "off"]
        segment = segments_at(inputs.mesh, inputs.face_segment, capture.points.positions)
        free = {"specular": True, "roughness": settings.local_roughness}
        rungs = {part: VARIATIONS[: 3 if free[part] and part not in self.forced else 1] for part in free}
        applied = present.model.applied(settings)
        self.gloss = GlossLadder(capture, applied, present, segment, rungs, self._report).climb()

    def _refine(self, shape: ShapeSettings) -> bool:
        """Refines the tracked mesh, or goes on refining it, under the present solution; kept where that serves."""
        start = time.perf_counter()
        below, tracked, below_is_tracked = self.ladder.present, self.tracked.inputs, self.small is self.tracked
        appearance = below.model.applied(self.settings.appearance)
        known = Reflectance.of(below.solution, self.small.scenery[appearance.visibility])
        frames = frames_of(tracked, self.settings, shape.frames, self.fitted)
        how = appearance, self.small.sizes, shape, self.progress, self.note
        reshaped = reshape(tracked, frames, known, *how, begun=None if below_is_tracked else self.small.inputs)
        small = SmallClip(reshaped, self.settings, self.fitted, self.chart, self.progress)
        ladder = self._ladder(small)
        ladder.begin(below.model, below.solution)
        trial = replace(ladder.present, seconds=time.perf_counter() - start)
        better = "geometry" in self.forced or serves(below.errors, trial.errors)
        name = "refined" if shape.subdivisions == 0 else f"subdivided_{shape.subdivisions}"
        self._report(describe("geometry", name, trial, below, better))
        if better:
            self.small, self.ladder = small, ladder
        return better

    def _ladder(self, small: SmallClip) -> Ladder:
        rungs = allowed_rungs(self.settings.appearance, self.forced)
        return Ladder(small.captures, self.settings.appearance, rungs, self._report)

    def _report(self, record: dict) -> None:
        self.rungs.append(record)
        fall = "" if record["fall"] is None else f", {-record['fall']:+.6f} +- {record['standard_error']:.6f}"
        said = "climbed" if record["climbed"] else "not climbed"
        text = f"{record['part']} {record['rung']}: {record['held_out']:.6f} held out{fall}"
        self.note(f"ladder: {text}; {said} ({record['seconds']:.1f} s)")

    def climbed(self) -> Climbed:
        """What is left to solve."""
        present, settings, forced = self.ladder.present, self.settings, self.forced
        appearance = present.model.applied(settings.appearance)
        local = appearance.local_roughness and "roughness" in forced
        appearance = replace(appearance, local_roughness=local, fit_roughness=False)  # the ladder found it
        widths = settings.specular_widths if "specular" in forced else POOLING[self.gloss.specular]
        settings = replace(settings, appearance=appearance, shape=None, specular_widths=widths)
        found = self.gloss, self.shape_record, tuple(self.rungs)
        return Climbed(self.small.inputs, settings, present.solution, *found)
