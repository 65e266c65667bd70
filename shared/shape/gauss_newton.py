"""Shape from parallax and shading together, under a light and a reflectance that are known: Gauss-Newton steps.

Each step samples the frames at the vertices, shades the vertices, sums up what the samples say of place and normal, and
solves one sparse system. What the vertices see is traced on the mesh as it is, held for a few steps and traced again
while that helps: beside the nose, below it and between the lips the surface covers itself, and what a step moves there
is most of what it sees. Frames that were held out decide whether a step is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sparse

from shared.appearance.fit import Solution
from shared.appearance.local_roughness import SpecularEquations
from shared.appearance.observations import face_front
from shared.appearance.problem import AppearanceSettings
from shared.compute.run_context import SILENT, RunContext
from shared.compute.threads import share_out
from shared.geometry.mesh import Mesh, subdivide, typical_edge, vertex_normals
from shared.geometry.surface import TrackPoints
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.views import Views
from shared.rendering.near_lamp import NearLamp
from shared.rendering.normal_derivatives import Reflections, shading_terms
from shared.rendering.precomputed_transfer import PrecomputedTransfer, Sizes, precompute_transfer
from shared.rendering.shading import DEEP, Material, VertexShading
from shared.rendering.transfer import Nodes, Points, Transfer, mesh_points, nearest_points
from shared.shape.equations import EquationSettings, PointEquations, point_equations
from shared.shape.occluding_contour import ContourSettings
from shared.shape.samples import SurfaceView, look_at_surface, sample_surface
from shared.shape.silhouette import FaceOutline
from shared.shape.step import (
    LARGEST_STEP_EDGES,
    large_step_metric,
    normal_turns,
    point_terms,
    solve_offsets,
    track_rows,
)

SHAPED = ("forehead", "brows", "lids", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "lips", "chin", "jaw")
"""Segments whose samples shape the surface. Ears, neck and scalp follow them; what HELD names stays the model's."""
HELD = ("eyes", "inner_mouth", "eye_sockets")
MINIMUM_FRAMES, FEWEST_POINTS = 4, 50
_POINTS_PER_BLOCK = 1024
BLUR_EDGES = 0.4
"""Standard width of the pictures' blur over the typical edge: what a vertex stands for."""


@dataclass(frozen=True)
class ShapeSettings:
    """subdivisions: finer levels beyond the given mesh; rounds: most steps before the surface is traced again; traces:
    how often it is at most on the given mesh; finer levels are traced once; frames: that the shape is solved from;
    smoothness: lambda of the large steps; sigma_mm: how far the surface may be from the start as a whole; contour: how
    the outline is met first, None: it is not; looks_back: the last step of a level is judged, too, and not only the
    mesh by whoever asked for it."""

    subdivisions: int = 1
    rounds: int = 2
    traces: int = 3
    frames: int = 32
    smoothness: float = 19.0
    sigma_mm: float = 8.0
    equations: EquationSettings = field(default_factory=EquationSettings)
    contour: ContourSettings | None = field(default_factory=ContourSettings)
    looks_back: bool = True


@dataclass(frozen=True)
class Reflectance:
    """What the shape is solved under: light [6 n^2, 3], specular intensity, roughness and how it varies; nodes with
    their albedo [K, 3]: where light bounced when it was solved; directions [J, 3] that suit the light; light_weights:
    of several lights, which lie one below the other, how much samples of each count; lamp: of the light, where it
    stands near."""

    light: np.ndarray
    specular: float
    roughness: float
    nodes: Nodes
    node_albedo: np.ndarray
    directions: np.ndarray
    local_roughness_fit: SpecularEquations | None = None
    light_weights: tuple[float, ...] = ()
    lamp: NearLamp | None = None

    @staticmethod
    def of(
        solution: Solution, precomputed: PrecomputedTransfer, directions: np.ndarray | None = None
    ) -> Reflectance:
        """That of a solved appearance; directions [J, 3]: others than its transfer has."""
        state = solution.state
        return Reflectance(
            light=state.light, specular=state.specular, roughness=state.roughness, nodes=precomputed.nodes,
            node_albedo=state.node_albedo, directions=precomputed.directions if directions is None else directions,
            local_roughness_fit=solution.local_roughness_fit, light_weights=solution.light_weights,
            lamp=solution.lamp,
        )


WORTHWHILE = 0.01
"""Once traced again, a level whose held-out residual did not fall by this fraction is at rest."""
MOST_WORSE = 1
"""Steps in a row after which held-out frames may fit worse: the first of a finer level often is one by a hair, and the
next more than makes up for it. The best of all stays."""


@dataclass(frozen=True)
class ShapedSurface:
    """A mesh, the vertices index [P] that are shaped, and their equations."""

    mesh: Mesh
    index: np.ndarray
    tangents: np.ndarray
    equations: PointEquations


@dataclass(frozen=True)
class Traced:
    """What is looked up once for a few steps: the points of vertices index [P], their transfer and shading, how the
    frames see them, and what they reflect (None: nothing)."""

    precomputed: PrecomputedTransfer
    index: np.ndarray
    transfer: Transfer
    shading: VertexShading
    looks: list[SurfaceView]
    reflections: Reflections | None

    def turned_to(self, normals: np.ndarray) -> Transfer:
        """The transfer for other normals [P, 3] under the same visibility."""
        directions = self.precomputed.directions.T.astype(np.float32)
        directions *= np.float32(4.0 / directions.shape[1])
        normals, direct = normals.astype(np.float32), np.empty_like(self.transfer.direct)
        blocks = [slice(first, first + _POINTS_PER_BLOCK) for first in range(0, len(direct), _POINTS_PER_BLOCK)]

        def fill(k: int) -> None:
            part = blocks[k]
            direct[part] = np.maximum(normals[part] @ directions, 0.0) * self.transfer.visibility(part)

        share_out(len(blocks), fill)
        return replace(self.transfer, direct=direct)


class ShapeSolver:
    """Refines a mesh and its subdivisions from views of it; tracks: what tracking knows of the surface, or None;
    outline: what the face's edges in the views say of it, or None."""

    def __init__(
        self,
        views: Views,
        tracks: TrackPoints | None,
        reflectance: Reflectance,
        appearance: AppearanceSettings,
        sizes: Sizes,
        settings: ShapeSettings,
        context: RunContext = SILENT,
        outline: FaceOutline | None = None,
    ):
        self.views, self.tracks, self.reflectance, self.outline = views, tracks, reflectance, outline
        self.appearance, self.sizes, self.settings, self.context = appearance, sizes, settings, context

    def trace(self, mesh: Mesh, shaped: np.ndarray) -> Traced:
        """Looks at the shaped faces' vertices that some frame faces. shaped [F] bool: the faces that may move."""
        views, viewer = self.views, SurfaceViewer.of(mesh)
        wanted = np.zeros(len(mesh.vertices), bool)
        wanted[mesh.faces[shaped]] = True
        index = np.nonzero(wanted & face_front(viewer, views.camera_from_head, 0.2))[0]
        points = mesh_points(mesh, index)
        precomputed = precompute_transfer(viewer, self.sizes, self.appearance.visibility, self.reflectance.directions)
        transfer = precomputed.trace(points)
        shading = self._shading(mesh, index, points, transfer, precomputed)
        blur = BLUR_EDGES * typical_edge(mesh.vertices, mesh.faces[shaped])
        looks = look_at_surface(viewer, index, views, blur, self.context)
        shines = self.appearance.specular and len(index) >= FEWEST_POINTS
        reflections = Reflections(shading, np.arange(len(index))) if shines else None
        return Traced(precomputed, index, transfer, shading, looks, reflections)

    def examine(self, mesh: Mesh, traced: Traced) -> ShapedSurface | None:
        """Samples, shading and equations of the traced vertices; None where hardly any is seen."""
        views, settings, index = self.views, self.settings, traced.index
        points = mesh_points(mesh, index)
        samples = sample_surface(points.positions, traced.looks, views.camera_from_head, views.intrinsics)
        if self.reflectance.light_weights:
            samples.weight[:] *= np.array(self.reflectance.light_weights, np.float32)[views.light_index]
        transfer = traced.turned_to(points.normals)
        seen = (samples.weight[:, views.fitted] > 0).sum(1) >= min(MINIMUM_FRAMES, int(views.fitted.sum()))
        rows = np.nonzero(seen & (transfer.blocked < DEEP))[0]
        if len(rows) < FEWEST_POINTS:
            return None
        material = self._material(points, traced.precomputed)
        shading = traced.shading.of_points(index, mesh.vertices, points, transfer, material)
        samples = samples.points(rows)
        terms = shading_terms(shading, rows, traced.reflections)
        points = points.take(rows)
        equations = point_equations(
            samples,
            terms,
            points.positions,
            points.normals,
            self.reflectance.specular,
            views.fitted,
            settings.equations,
        )
        return ShapedSurface(mesh, index[rows], terms.tangents, equations)

    def _shading(
        self, mesh: Mesh, index: np.ndarray, points: Points, transfer: Transfer, precomputed: PrecomputedTransfer
    ) -> VertexShading:
        known, views = self.reflectance, self.views
        return VertexShading(
            index,
            mesh.vertices,
            points,
            transfer,
            precomputed.node_transfer,
            self._material(points, precomputed),
            known.light,
            precomputed.directions,
            views.camera_from_head,
            self.appearance.light_moves(views.moves),
            bounce=self.appearance.bounce,
            light_index=views.light_index,
            lamp=known.lamp,
            node_points=precomputed.nodes.points,
        )

    def _material(self, points: Points, precomputed: PrecomputedTransfer) -> Material:
        known = self.reflectance
        local = None if known.local_roughness_fit is None else known.local_roughness_fit.roughness(points.positions)
        node_albedo = known.node_albedo[nearest_points(precomputed.nodes.points, known.nodes.points)]
        return Material(node_albedo, known.specular, known.roughness, local)

    def step(self, surface: ShapedSurface, start: np.ndarray, shaped: np.ndarray, held: np.ndarray) -> np.ndarray:
        """Offsets [V] along the normals. start [V, 3] mm: vertices of the level's first mesh; shaped [F] bool: the
        faces that may move; held [F] bool: those that may not."""
        mesh, count = surface.mesh, len(surface.mesh.vertices)
        normals = vertex_normals(mesh.vertices, mesh.faces)
        turns = normal_turns(mesh.vertices, mesh.faces, normals, surface.index, surface.tangents)
        terms = [point_terms(surface.index, turns, surface.equations.hessian, surface.equations.gradient, count)]
        if self.tracks is not None:
            rows, height, weight = track_rows(mesh.vertices, mesh.faces, normals, shaped, self.tracks)
            weighted = rows.T @ sparse.diags(weight)
            terms.append(((weighted @ rows).tocsr(), -(weighted @ height)))
        if self.outline is not None:
            terms.append(self.outline.terms(mesh))
        metric = large_step_metric(mesh.faces, count, self.settings.smoothness, self.settings.sigma_mm)
        free = np.ones(count, bool)
        free[mesh.faces[held]] = False
        offsets = solve_offsets(mesh.vertices, start, normals, metric, free, terms, self.context.note)
        largest = LARGEST_STEP_EDGES * typical_edge(mesh.vertices, mesh.faces[shaped])
        return np.clip(offsets, -largest, largest)

    def refine(
        self, mesh: Mesh, shaped: np.ndarray, held: np.ndarray, begun: Mesh | None = None
    ) -> tuple[Mesh, Mesh]:
        """The mesh subdivided as the settings say, as it was and refined. shaped, held [faces] bool; begun: the mesh,
        or a subdivision of it, as it was refined before: goes on from the next level, or on the finest one."""
        start, mesh, finished = mesh, begun or mesh, 0 if begun is None else len(begun.faces)
        for level in range(self.settings.subdivisions + 1):
            if level > 0:
                shaped, held, start = np.repeat(shaped, 4), np.repeat(held, 4), subdivide(start)
            if level < self.settings.subdivisions and finished >= len(start.faces):
                continue
            if len(mesh.faces) < len(start.faces):
                mesh = subdivide(mesh)
            traces = self.settings.traces if level == 0 else 1
            mesh = self._refine_level(mesh, start.vertices, shaped, held, level, traces)
        return start, mesh

    def _refine_level(self, mesh, start, shaped, held, level, traces) -> Mesh:
        last = np.inf
        for _ in range(traces):
            traced = self.trace(mesh, shaped)
            surface = self.examine(mesh, traced)
            if surface is None:
                self.context.note(f"shape level {level}: too little of the face is seen, the mesh stays")
                break
            self.context.note(f"shape level {level}: {len(surface.index)} points, {_residuals(surface)}")
            if surface.equations.judged > last * (1.0 - WORTHWHILE):
                break
            mesh, last = self._stepped(surface, start, shaped, held, traced), surface.equations.judged
        return mesh

    def _stepped(self, surface: ShapedSurface, start, shaped, held, traced: Traced) -> Mesh:
        """The mesh after the steps that serve under what was traced."""
        best, worse = surface, 0
        for number in range(self.settings.rounds):
            offsets = self.step(surface, start, shaped, held)
            normals = vertex_normals(surface.mesh.vertices, surface.mesh.faces)
            vertices = surface.mesh.vertices + offsets[:, None] * normals
            if number + 1 == self.settings.rounds and not (self.settings.looks_back or worse):
                return surface.mesh.replace(vertices=vertices)
            moved = self.examine(surface.mesh.replace(vertices=vertices), traced)
            if moved is None:
                break
            moves = np.abs(offsets[moved.index])
            moved_mm = f"moved {np.median(moves):.3f} mm, 95 % {np.percentile(moves, 95):.3f}"
            self.context.note(f"  {moved_mm}: {_residuals(moved)}")
            surface = moved
            if moved.equations.judged <= best.equations.judged:
                best, worse = moved, 0
            elif (worse := worse + 1) > MOST_WORSE:
                break
        return best.mesh


def _residuals(surface: ShapedSurface) -> str:
    return f"residual {surface.equations.fitted:.5f} fitted, {surface.equations.held_out:.5f} held out"
