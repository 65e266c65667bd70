"""The shape's part of inverse rendering: what is shaped, from which frames, and whether the result is kept."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from shared.appearance.problem import AppearanceSettings
from shared.geometry.intersections import move_without_crossing
from shared.geometry.mesh import Mesh, subdivide
from shared.imaging.frame_index import lens_of_frames
from shared.rendering.precomputed_transfer import Sizes
from shared.shape.gauss_newton import HELD, SHAPED, Reflectance, ShapeClip, ShapeSettings, ShapeSolver, Traced
from shared.shape.silhouette import ContourSettings, Outlines, fit_outline, mask_distance
from shared.shape.step import TrackPoints

OUTLINED = ("forehead", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "lips", "chin", "jaw", "ears", "scalp")
"""Segments that may form the outline. The neck bends, and clothes cover it."""
TRACK_REACH_MM = 6.0
"""So far around a track point the tracks tell the surface better than an outline does."""
MODEL_ERROR_MM = 2.0
"""How far a fitted head model lies from a head."""
TRACK_FLOOR_MM = 0.1
"""Error of a track point that more frames or sharper pictures do not lessen."""


class RefinedInputs:
    """A clip's inputs with another mesh in the place of theirs; traced: what was looked up to refine it; stopped:
    vertices that moved less than wanted, since the surface would have cut itself."""

    def __init__(self, inputs, mesh: Mesh, traced: Traced | None = None, stopped: int = 0):
        self._inputs, self.mesh, self.traced, self.stopped = inputs, mesh, traced, stopped
        self.face_segment = segments_of(inputs, mesh)

    def __getattr__(self, name: str):
        return getattr(self._inputs, name)


def segments_of(inputs, mesh: Mesh) -> np.ndarray | None:
    """[faces] segments of the inputs' mesh or of one that it was subdivided into; None where it has none."""
    times = len(mesh.faces) // len(inputs.mesh.faces)
    return None if inputs.face_segment is None else np.repeat(inputs.face_segment, times)


def subdivided_to(mesh: Mesh, finer: Mesh) -> Mesh:
    """The mesh, subdivided until it has the topology of a finer one that was made from it."""
    while len(mesh.faces) < len(finer.faces):
        mesh = subdivide(mesh)
    return mesh


def faces_of(inputs, names: tuple[str, ...]) -> np.ndarray:
    """[faces] bool: faces in the named segments."""
    wanted = [inputs.segment_names.index(name) for name in names if name in inputs.segment_names]
    return np.isin(inputs.face_segment, wanted)


def track_points(positions: np.ndarray, sigma_mm: np.ndarray) -> TrackPoints:
    """Track points [N, 3] with the standard deviation of their depth [N]."""
    return TrackPoints(positions, np.hypot(TRACK_FLOOR_MM, sigma_mm))


def surface_error(tracks: tuple[np.ndarray, np.ndarray] | None) -> float:
    """How far the head's surface may be off, mm, given how far the depth of its track points may, and what the head
    model knows without them; 0: the mesh is not from tracks."""
    if tracks is None:
        return 0.0
    return float(1.0 / np.hypot(1.0 / np.median(track_points(*tracks).sigma_mm), 1.0 / MODEL_ERROR_MM))


def meet_outline(inputs, frames: tuple[np.ndarray, np.ndarray], settings: ContourSettings, note: Callable):
    """The inputs with their mesh moved to meet the person masks' borders where no track lies, and a record; frames:
    which, and which of them are fitted."""
    chosen, fitted = frames
    outlines = Outlines(
        tuple(mask_distance(inputs.mask(int(f))) for f in chosen),
        inputs.camera_from_head[chosen],
        fitted,
        np.broadcast_to(lens_of_frames(inputs.intrinsics, chosen), (len(chosen), 3, 3)),
    )
    vertices = inputs.mesh.vertices
    if inputs.tracks is None:
        known = np.isin(np.arange(len(vertices)), inputs.mesh.faces[faces_of(inputs, SHAPED)])
    else:
        known = cKDTree(inputs.tracks[0]).query(vertices)[0] < TRACK_REACH_MM
    mesh, record = fit_outline(inputs.mesh, faces_of(inputs, OUTLINED), known, outlines, settings, note)
    placed = move_without_crossing(vertices, mesh.vertices, mesh.faces)
    return RefinedInputs(inputs, mesh.replace(vertices=placed)), record


def refine_shape(
    inputs,
    frames: tuple[np.ndarray, np.ndarray],
    reflectance: Reflectance,
    appearance: AppearanceSettings,
    sizes: Sizes,
    settings: ShapeSettings,
    progress: Callable,
    note: Callable,
    begun: RefinedInputs | None = None,
) -> RefinedInputs:
    """The inputs with their mesh refined under a known light; frames: which, and which of them are fitted; begun: the
    same with fewer subdivisions, from where this goes on."""
    chosen, fitted = frames
    tracks = None
    if inputs.tracks is not None:
        tracks = track_points(*inputs.tracks)
    clip = ShapeClip(
        lambda i: inputs.picture(int(chosen[i])),
        inputs.camera_from_head[chosen],
        lens_of_frames(inputs.intrinsics, chosen),
        fitted,
        appearance.light_moves(inputs.moves),
        tracks,
        inputs.light_index[chosen],
    )
    solver = ShapeSolver(clip, reflectance, appearance, sizes, settings, progress, note)
    so_far = None if begun is None else (begun.mesh, begun.traced)
    start, refined, traced = solver.refine(inputs.mesh, faces_of(inputs, SHAPED), faces_of(inputs, HELD), so_far)
    placed = move_without_crossing(start.vertices, refined.vertices, refined.faces)
    stopped = int((np.abs(placed - refined.vertices).max(1) > 1e-6).sum())
    if stopped:
        note(f"shape: {stopped} vertices moved less than wanted, so that the surface does not cut itself")
    return RefinedInputs(inputs, refined.replace(vertices=placed), traced and traced.kept(), stopped)
