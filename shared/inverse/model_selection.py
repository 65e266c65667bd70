"""Model selection on a clip: the small captures that it looks at, the mesh's candidates, and what is then left to
solve."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from shared.appearance.chart_scale import ChartStatement
from shared.appearance.fit import Solution
from shared.appearance.observations import Capture, build_capture
from shared.compute.run_context import RunContext
from shared.geometry.mesh import segments_at
from shared.geometry.surface import Surface
from shared.imaging.frame_index import hold_out, spread_frames
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.turning_eyes import TurningEyes
from shared.imaging.views import Views
from shared.inverse.problem import FACE_SKIN, InverseSettings, some_views
from shared.rendering.precomputed_transfer import Sizes, precompute_transfer
from shared.selection.candidates import FEWEST_HELD_OUT, ModelSelection, allowed_candidates, describe, serves
from shared.selection.specular import POOLING, VARIATIONS, SpecularSelection, SpecularVariation
from shared.shape.gauss_newton import Reflectance, ShapeSettings
from shared.shape.refine import RefinedSurface, refine_shape

SELECTION_SIZES = Sizes(points=600, directions=768, nodes=200)
SELECTION_FRAMES, SELECTION_HOLD_OUT = 36, 3
"""Frames that model selection looks at, and which share of them judges: one in so many, and all that are held out
anyway."""


@dataclass(frozen=True)
class SelectedModel:
    """The surface with the mesh that was chosen, what is left to solve, a solution to start from, how its specular
    terms vary, what became of the mesh, and the record of the candidates."""

    surface: Surface
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
    """Captures of a surface with few points, views and directions: with visibility (True) and without; refined: how the
    surface was made, None: it is the tracked one."""

    def __init__(
        self,
        views: Views,
        surface: Surface,
        settings: InverseSettings,
        chart: ChartStatement | None,
        context: RunContext,
        refined: RefinedSurface | None = None,
    ):
        self.surface, self.refined, full = surface, refined, settings.sizes
        self.sizes = Sizes(**{name: min(getattr(full, name), most) for name, most in vars(SELECTION_SIZES).items()})
        viewer = SurfaceViewer.of(surface.mesh)
        self.precomputed = Made(lambda visibility: precompute_transfer(viewer, self.sizes, visibility))
        moves, skin = settings.appearance.light_moves(views.moves), surface.vertices_of(FACE_SKIN)
        few = selection_views(views, settings)
        eyes = None if few.gaze is None else TurningEyes.of(surface)
        seen = build_capture(viewer, self.precomputed[True], few, moves, skin, self.sizes.points, context, eyes)
        self.captures = Made(self._without_visibility)
        self.captures[True] = replace(seen, chart=chart)

    def _without_visibility(self, visibility: bool) -> Capture:
        return self.captures[True].traced_anew(self.precomputed[visibility])


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
    selector = _ClipSelection(views, surface, settings, chart, context)
    if selector.held_out < FEWEST_HELD_OUT:
        context.note(
            f"the model is not chosen: {selector.held_out} frames are too few to judge it by; all of it is solved"
        )
        return SelectedModel(surface, replace(settings, selection=None))
    selector.select()
    return selector.selected()


class _ClipSelection:
    """Appearance on the tracked mesh, then the mesh, then the appearance again where the mesh changed."""

    def __init__(
        self,
        views: Views,
        surface: Surface,
        settings: InverseSettings,
        chart: ChartStatement | None,
        context: RunContext,
    ):
        self.views, self.settings, self.chart, self.context = views, settings, chart, context
        self.candidates, self.forced = [], settings.selection
        self.tracked = self.small = SmallClip(views, surface, settings, chart, context)
        self.held_out = int((~self.small.captures[True].fitted).sum())
        self.selection = self._selection(self.small)
        self.shape_record: dict = {"refined": False}
        self.variation = SpecularVariation()

    def select(self) -> None:
        """All parts; the result stands in small, selection.present and variation."""
        self.selection.select()
        if self.settings.shape is not None and self.small.surface.face_segment is not None:
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
            stopped = self.small.refined.stopped
            self.shape_record = {"refined": True, "held_out": residuals, "stopped_vertices": stopped}
            self.selection.select()

    def _select_specular(self) -> None:
        present, surface, settings = self.selection.present, self.small.surface, self.settings.appearance
        capture = self.small.captures[present.model.visibility != "off"]
        segment = segments_at(surface.mesh, surface.face_segment, capture.points.positions)
        free = {"specular": True, "roughness": settings.local_roughness}
        candidates = {part: VARIATIONS[: 3 if free[part] and part not in self.forced else 1] for part in free}
        applied = present.model.applied(settings)
        self.variation = SpecularSelection(capture, applied, present, segment, candidates, self._report).select()

    def _refine(self, shape: ShapeSettings) -> bool:
        """Refines the tracked mesh, or goes on refining it, under the present solution; kept where that serves."""
        start = time.perf_counter()
        below = self.selection.present
        appearance = below.model.applied(self.settings.appearance)
        refined = refine_shape(
            some_views(self.views, self.settings, shape.frames),
            self.tracked.surface,
            reflectance=Reflectance.of(below.solution, self.small.precomputed[appearance.visibility]),
            appearance=appearance,
            sizes=self.small.sizes,
            settings=shape,
            context=self.context,
            begun=None if self.small.refined is None else self.small.surface.mesh,
        )
        small = SmallClip(self.views, refined.surface, self.settings, self.chart, self.context, refined)
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
        said = "accepted" if record["accepted"] else "not accepted"
        text = f"{record['part']} {record['candidate']}: {record['held_out']:.6f} held out{fall}"
        self.context.note(f"model selection: {text}; {said} ({record['seconds']:.1f} s)")

    def selected(self) -> SelectedModel:
        """What is left to solve."""
        present, settings, forced = self.selection.present, self.settings, self.forced
        appearance = present.model.applied(settings.appearance)
        local = appearance.local_roughness and "roughness" in forced
        appearance = replace(appearance, local_roughness=local, fit_roughness=False)  # model selection found it
        widths = settings.specular_widths if "specular" in forced else POOLING[self.variation.specular]
        settings = replace(settings, appearance=appearance, shape=None, specular_widths=widths)
        return SelectedModel(
            self.small.surface, settings, start=present.solution, variation=self.variation,
            shape_record=self.shape_record,
            candidates=tuple(self.candidates),
        )
