"""Inverse rendering of a clip: appearance fit, then the texture pass, then the maps. Arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from shared.chart import ChartSight
from shared.gather import Picture, SurfaceViewer
from shared.mesh import Mesh
from shared.read_ahead import read_ahead
from shared.shading import Material, VertexShading
from shared.solve.appearance import Settings
from shared.solve.capture import (
    Capture,
    Scenery,
    Sizes,
    build_capture,
    face_front,
    hold_out,
    lens_of_frames,
    set_scenery,
    spread_frames,
)
from shared.solve.chart_scale import describe_scale, doubt_scale, state_chart
from shared.solve.doubts import doubts_about, signs_of
from shared.solve.fit_appearance import Solution, fit_appearance, with_local_roughness
from shared.solve.frame_choice import covering_frames
from shared.solve.light_models import SeveralLights
from shared.solve.maps import make_maps
from shared.solve.normal_map import NormalPass, resolved_texels
from shared.solve.reference_settings import ReferenceSettings
from shared.solve.reshape import faces_of, meet_outline, reshape
from shared.solve.shape import Reflectance, ShapeSettings
from shared.solve.texture import TexelMaterial
from shared.solve.texture_pass import Clip, TexturePass
from shared.texels import TexelSurface
from shared.transfer import mesh_points

FACE_SKIN = ("forehead", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "chin", "jaw")
"""Segments whose skin the light is solved from; hair, brows, lips, lids, eyes and what
clothes may cover are left out."""


class InverseInputs(Protocol):
    """What the solver needs of a clip or of several; shared.io.clip_inputs.ClipInputs is one.

    picture(f): frame f of F ready for sampling; mask(f) [H, W], 0: background; camera_from_head [F, 4, 4]; intrinsics
    [3, 3], or [F, 3, 3], and size (width, height) of the pictures; moves: "head" or "camera"; face_segment [faces] or
    None where the mesh has no segments; tracks: points [N, 3] on the skin with their errors [N], px, or None;
    light_index [F]: which light each frame stands in, 0 first, frames of one light in a row.
    """

    mesh: Mesh
    camera_from_head: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    moves: str
    face_segment: np.ndarray | None
    segment_names: tuple[str, ...]
    tracks: tuple[np.ndarray, np.ndarray] | None
    light_index: np.ndarray

    def picture(self, f: int) -> Picture: ...

    def mask(self, f: int) -> np.ndarray: ...


@dataclass(frozen=True)
class InverseSettings:
    """sizes of the light's problem, its settings, frames it is solved from, edge of the maps, hold-out period.

    shape: how the mesh is refined, None: it stays as it is; fit_frames: how many frames to fit, chosen to cover the
    face, 0: all but those held out; reference: solve by the published algorithm instead; ladder: choose the model, up
    to what the settings say, and leave only the named parts of it as they say; specular_widths: over which, relative
    to the map, texels share their specular intensity: what held-out frames choose from."""

    sizes: Sizes = field(default_factory=Sizes)
    appearance: Settings = field(default_factory=Settings)
    light_frames: int = 48
    map_size: int = 1024
    hold_out_every: int = 8
    shape: ShapeSettings | None = field(default_factory=ShapeSettings)
    fit_frames: int = 0
    reference: ReferenceSettings | None = None
    normal_map: bool = True
    ladder: frozenset[str] | None = None
    specular_widths: tuple[float, ...] = (np.inf, 1 / 16, 1 / 64)


@dataclass(frozen=True)
class InverseResult:
    """solution of the appearance fit, the texels' material, maps by name, the vertices' shading in all frames, the
    viewer of the final mesh, and what is worth recording."""

    solution: Solution
    material: TexelMaterial
    maps: dict[str, np.ndarray]
    shading: VertexShading
    viewer: SurfaceViewer
    fitted: np.ndarray
    record: dict


@dataclass(frozen=True)
class LitClip:
    """A clip before its texture pass: the inputs with the mesh that was chosen and its viewer and scenery, settings of
    the model that was chosen, the capture and its solution, what became of the mesh, the ladder's rungs; tracked: the
    solution before the mesh was refined, where it was tried."""

    inputs: InverseInputs
    settings: InverseSettings
    viewer: SurfaceViewer
    scenery: Scenery
    capture: Capture
    solution: Solution
    shape_record: dict
    rungs: tuple[dict, ...]
    tracked: Solution | None = None


def solve_clip(
    inputs: InverseInputs,
    settings: InverseSettings,
    progress: Callable,
    note: Callable,
    sights: Sequence[ChartSight] = (),
) -> InverseResult:
    """The whole of it. progress(items, label) wraps loops, note(text) logs a line; sights: of a colour chart in view.
    """
    viewer = SurfaceViewer.of(inputs.mesh)
    fitted = frames_to_fit(inputs, settings, viewer)
    if settings.reference is not None:
        from shared.solve.reference_clip import solve_by_reference

        return solve_by_reference(inputs, settings, settings.reference, fitted, progress, note)
    outline = {}
    if settings.shape is not None and settings.shape.rim is not None and inputs.face_segment is not None:
        frames = frames_of(inputs, settings, settings.shape.rim.frames, fitted)
        inputs, outline = meet_outline(inputs, frames, settings.shape.rim, note)
        viewer = SurfaceViewer.of(inputs.mesh)
    moves = settings.appearance.light_moves(inputs.moves)
    light = int(inputs.light_index[sights[0].frame]) if sights else 0
    chart, warning = state_chart(sights, viewer.scene, inputs.camera_from_head, inputs.intrinsics, moves, light)
    lit = solve_light(inputs, settings, viewer, fitted, chart, progress, note)
    inputs, settings, viewer = lit.inputs, lit.settings, lit.viewer
    signs = signs_of(lit.capture, settings.appearance, lit.solution)
    solution = with_local_roughness(lit.capture, settings.appearance, lit.solution)
    shading = shade_vertices(inputs, settings.appearance, viewer, lit.scenery, solution, progress)
    surface = TexelSurface(inputs.mesh, settings.map_size)
    clip = Clip(inputs.picture, inputs.camera_from_head, inputs.intrinsics, fitted, inputs.light_index)
    typical = np.median(solution.state.albedo, axis=0)
    known = specular_at(surface, solution), typical
    texture = TexturePass(surface, viewer, shading, clip, *known, light_trust=solution.light_trust, progress=progress)
    widths = settings.map_size * np.array(settings.specular_widths if settings.appearance.specular else (np.inf,))
    material, texture_record = texture.run(widths)
    gloss = solution.gloss
    roughness = solution.state.roughness if gloss is None else gloss.roughness(inputs.mesh.vertices)
    turn, relief = None, {}
    if settings.normal_map:
        fine = NormalPass(surface, viewer, shading, clip, material, progress)
        turn, relief = fine.run(resolved_texels(surface, clip))
        note(f"fine normals: {relief}")
    maps = make_maps(surface, material, roughness, turn)
    warnings = [*[warning] * bool(warning), *doubt_scale(chart, typical), *doubts_about(signs)]
    shape_record = {**lit.shape_record, "outline": outline}
    record = {"texture": texture_record, "shape": shape_record, "relief": relief, "signs": signs, "warnings": warnings}
    record |= {"albedo_scale": describe_scale(chart, typical), "rungs": lit.rungs}
    return InverseResult(solution, material, maps, shading, viewer, fitted, record)


def solve_light(
    inputs: InverseInputs, settings: InverseSettings, viewer: SurfaceViewer, fitted, chart, progress, note
) -> LitClip:
    """Light and mesh: those of the full model, or of the one that the ladder leads to."""
    start, gloss, tracked, shape_record, rungs = None, None, None, {"refined": False}, ()
    if settings.ladder is not None:
        from shared.solve.ladder_clip import climb

        climbed = climb(inputs, settings, fitted, chart, progress, note)
        inputs, settings, start, gloss = climbed.inputs, climbed.settings, climbed.start, climbed.gloss
        shape_record, rungs = climbed.shape_record, climbed.rungs
        viewer = SurfaceViewer.of(inputs.mesh)
    scenery = set_scenery(viewer, settings.sizes, settings.appearance.visibility)
    solution, capture = _fit_light(inputs, settings, viewer, scenery, fitted, chart, progress, note, start)
    if settings.shape is not None and inputs.face_segment is not None:
        known = Reflectance.of(solution, scenery)
        frames = frames_of(inputs, settings, settings.shape.frames, fitted)
        reshaped = reshape(inputs, frames, known, settings.appearance, settings.sizes, settings.shape, progress, note)
        viewer_then = SurfaceViewer.of(reshaped.mesh)
        scenery_then = set_scenery(viewer_then, settings.sizes, settings.appearance.visibility)
        more = viewer_then, scenery_then, fitted, chart, progress, note, solution
        then, capture_then = _fit_light(reshaped, settings, *more)
        tracked, shape_record = solution, judge_shape(solution, then)
        note(f"refined mesh: {shape_record}")
        if shape_record["refined"]:
            inputs, viewer, scenery = reshaped, viewer_then, scenery_then
            solution, capture = then, capture_then
    solution = solution if gloss is None else gloss.worn_by(solution)
    return LitClip(inputs, settings, viewer, scenery, capture, solution, shape_record, rungs, tracked)


def judge_shape(before: Solution, after: Solution) -> dict:
    """Is the refined mesh kept, and why: held-out residuals, fitted ones where no frame could be held out."""
    name = "held_out" if before.held_out > 0 else "fitted"
    residuals = {"before": getattr(before, name), "after": getattr(after, name)}
    return {"refined": residuals["after"] < residuals["before"], name: residuals}


def frames_of(
    inputs: InverseInputs, settings: InverseSettings, wanted: int, fitted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """At most wanted frames, evenly spread, and which of them are fitted."""
    lights = inputs.light_index
    chosen = spread_frames(len(inputs.camera_from_head), wanted, lights)
    if settings.fit_frames:
        chosen = np.union1d(chosen, np.nonzero(fitted)[0])
    if (~fitted[chosen]).sum() >= 2:
        return chosen, fitted[chosen]
    # Every part of the solve needs held-out frames too: where thinning left too few, hold out among the thinned.
    return chosen, hold_out(len(chosen), settings.hold_out_every, lights[chosen])


def frames_to_fit(inputs: InverseInputs, settings: InverseSettings, viewer: SurfaceViewer) -> np.ndarray:
    """[F] bool: all frames but those held out, or the few that cover the face."""
    poses = inputs.camera_from_head
    if not settings.fit_frames:
        return hold_out(len(poses), settings.hold_out_every, inputs.light_index)
    skin = segment_vertices(inputs, FACE_SKIN)
    chosen = covering_frames(viewer, skin, poses, inputs.intrinsics, inputs.size, settings.fit_frames)
    return np.isin(np.arange(len(poses)), chosen)


def segment_vertices(inputs: InverseInputs, names: tuple[str, ...]) -> np.ndarray:
    """[V] bool: vertices of faces in the named segments; all of them where the mesh has no segments."""
    if inputs.face_segment is None:
        return np.ones(len(inputs.mesh.vertices), bool)
    found = np.zeros(len(inputs.mesh.vertices), bool)
    found[inputs.mesh.faces[faces_of(inputs, names)]] = True
    return found


def _fit_light(
    inputs, settings, viewer, scenery: Scenery, fitted, chart, progress, note, start: Solution | None = None
) -> tuple[Solution, Capture]:
    frames = frames_of(inputs, settings, settings.light_frames, fitted)
    moves, count = settings.appearance.light_moves(inputs.moves), settings.sizes.points
    capture = replace(capture_skin(inputs, viewer, scenery, frames, moves, count, progress), chart=chart)
    climbed = settings.ladder is not None and start is not None
    step = (lambda record: note(_describe(record))), start, climbed
    return fit_appearance(capture, settings.appearance, *step), capture


def capture_skin(
    inputs, viewer, scenery: Scenery, frames: tuple[np.ndarray, np.ndarray], moves: str, count: int, progress
) -> Capture:
    """What at most count points of the face's skin show; frames: which, and which of them are fitted."""
    chosen, fitted = frames
    skin = segment_vertices(inputs, FACE_SKIN)
    return build_capture(
        viewer,
        scenery,
        read_ahead(map(inputs.picture, progress(chosen, "gathering samples"))),
        inputs.camera_from_head[chosen],
        lens_of_frames(inputs.intrinsics, chosen),
        moves,
        fitted,
        allowed=skin,
        skin=skin,
        count=count,
        progress=lambda items: progress(items, "tracing visibility"),
        light_index=inputs.light_index[chosen],
    )


def describe_light(state) -> str:
    """The light's model in words."""
    model, numbers = state.light_model, len(state.params)
    count = model.count if isinstance(model, SeveralLights) else 1
    several = f"{count} lights, each a " if count > 1 else ""
    return f"{several}cubemap of 6 x {model.resolution}^2 texels from {numbers // count} numbers per channel"


def _describe(record: dict) -> str:
    return (
        f"{record['light']} {record['resolution']}, step {record['step']}: residual {record['fitted']:.5f} fitted, "
        f"{record['held_out']:.5f} held out; specular {record['specular_intensity']:.3f}, "
        f"roughness {record['roughness']:.3f}"
    )


def shade_vertices(
    inputs, appearance: Settings, viewer, scenery: Scenery, solution: Solution, progress
) -> VertexShading:
    """Shading of all vertices that some frame faces, in all frames."""
    index = np.nonzero(face_front(viewer, inputs.camera_from_head, -0.1))[0]
    points = mesh_points(viewer.mesh, index)
    transfer = scenery.trace(points, lambda batches: progress(batches, "tracing the surface"))
    state = solution.state
    local = None if solution.gloss is None else solution.gloss.roughness(points.positions)
    return VertexShading(
        index,
        viewer.mesh.vertices,
        points,
        transfer,
        scenery.node_transfer,
        Material(state.node_albedo, state.specular, state.roughness, local),
        state.light,
        scenery.directions,
        inputs.camera_from_head,
        appearance.light_moves(inputs.moves),
        bounce=appearance.bounce,
        light_index=inputs.light_index,
    )


def specular_at(surface: TexelSurface, solution: Solution) -> float | np.ndarray:
    """The specular intensity that texels start from: one, or each its own [T]."""
    if solution.local_specular is None:
        return solution.state.specular
    return np.clip(solution.local_specular.specular_at(surface.interpolate(surface.mesh.vertices)), 0.0, 2.0)


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
            "roughness_variation": solution.gloss_record,
            "moves": inputs.moves,
        },
        "residuals": {
            "fitted": solution.fitted,
            "held_out": solution.held_out,
            "texture_held_out": result.record["texture"]["held_out"],
        },
        **{key: result.record[key] for key in ("shape", "relief", "signs") if key in result.record},
        **({"ladder": [dict(rung) for rung in result.record["rungs"]]} if result.record.get("rungs") else {}),
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
