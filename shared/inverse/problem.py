"""Inverse rendering of a clip: what a solver is given, what it returns, and what all solvers need of a clip."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from shared.appearance.fit import Solution
from shared.appearance.observations import Capture, build_capture, face_front
from shared.appearance.problem import AppearanceSettings
from shared.appearance.texture import TexelMaterial
from shared.compute.read_ahead import read_ahead
from shared.geometry.mesh import Mesh
from shared.imaging.frame_index import hold_out, lens_of_frames, spread_frames
from shared.imaging.image_sampling import Picture, SurfaceViewer
from shared.inverse.frame_choice import covering_frames
from shared.published.settings import ReferenceSettings
from shared.rendering.precomputed_transfer import PrecomputedTransfer, Sizes
from shared.rendering.shading import Material, VertexShading
from shared.rendering.transfer import mesh_points
from shared.shape.gauss_newton import ShapeSettings
from shared.shape.refine import faces_of

FACE_SKIN = ("forehead", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "chin", "jaw")
"""Segments whose skin the light is solved from; hair, brows, lips, lids, eyes and what clothes may cover are left out.
"""


class InverseInputs(Protocol):
    """What the solver needs of a clip or of several; shared.inverse.clip_inputs.ClipInputs is one.

    picture(f): frame f of F ready for sampling; mask(f) [H, W], 0: background; camera_from_head [F, 4, 4]; intrinsics
    [3, 3], or [F, 3, 3], and size (width, height) of the pictures; moves: "head" or "camera"; face_segment [faces] or
    None where the mesh has no segments; tracks: points [N, 3] on the skin with their errors [N] in depth, mm, or None;
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
    face, 0: all but those held out; reference: solve by the published algorithm instead; selection: choose the model,
    up to what the settings say, and leave only the named parts of it as they say; specular_widths: over which, relative
    to the map, texels share their specular intensity: what held-out frames choose from."""

    sizes: Sizes = field(default_factory=Sizes)
    appearance: AppearanceSettings = field(default_factory=AppearanceSettings)
    light_frames: int = 48
    map_size: int = 1024
    hold_out_every: int = 8
    shape: ShapeSettings | None = field(default_factory=ShapeSettings)
    fit_frames: int = 0
    reference: ReferenceSettings | None = None
    normal_map: bool = True
    selection: frozenset[str] | None = None
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


def capture_skin(
    inputs, viewer, precomputed: PrecomputedTransfer, frames: tuple[np.ndarray, np.ndarray], moves: str, count: int,
    progress
) -> Capture:
    """What at most count points of the face's skin show; frames: which, and which of them are fitted."""
    chosen, fitted = frames
    skin = segment_vertices(inputs, FACE_SKIN)
    return build_capture(
        viewer,
        precomputed,
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


def shade_vertices(
    inputs, appearance: AppearanceSettings, viewer, precomputed: PrecomputedTransfer, solution: Solution, progress
) -> VertexShading:
    """Shading of all vertices that some frame faces, in all frames."""
    index = np.nonzero(face_front(viewer, inputs.camera_from_head, -0.1))[0]
    points = mesh_points(viewer.mesh, index)
    transfer = precomputed.trace(points, lambda batches: progress(batches, "tracing the surface"))
    state = solution.state
    local = None if solution.local_roughness_fit is None else solution.local_roughness_fit.roughness(points.positions)
    return VertexShading(
        index,
        viewer.mesh.vertices,
        points,
        transfer,
        precomputed.node_transfer,
        Material(state.node_albedo, state.specular, state.roughness, local),
        state.light,
        precomputed.directions,
        inputs.camera_from_head,
        appearance.light_moves(inputs.moves),
        bounce=appearance.bounce,
        light_index=inputs.light_index,
    )
