"""Shape from parallax and shading together, under a light and a reflectance that are known: Gauss-Newton steps.

Each step samples the frames at the vertices, shades the vertices, sums up what the samples say of place and normal, and
solves one sparse system. Visibility and bounces are traced anew after each step. Frames that were held out decide
whether a step is kept.
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
from shared.geometry.mesh import Mesh, subdivide, vertex_normals
from shared.geometry.surface import TrackPoints
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.views import Views
from shared.rendering.near_lamp import NearLamp
from shared.rendering.normal_derivatives import Reflections, shading_terms
from shared.rendering.precomputed_transfer import PrecomputedTransfer, Sizes, precompute_transfer
from shared.rendering.shading import DEEP, Material, VertexShading
from shared.rendering.transfer import Nodes, Points, Transfer, mesh_points, nearest_points
from shared.shape.equations import EquationSettings, PointEquations, point_equations
from shared.shape.samples import SurfaceView, look_at_surface, sample_surface
from shared.shape.silhouette import ContourSettings
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
    """subdivisions: finer levels beyond the given mesh; rounds: most steps per level; frames: that the shape is solved
    from; smoothness: lambda of the large steps; sigma_mm: how far the surface may be from the start as a whole;
    contour: how the outline is met first, None: it is not; looks_back: the last step of a level is judged, too, and not
    only the mesh by whoever asked for it."""

    subdivisions: int = 1
    rounds: int = 2
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
    """What is looked up once per level, since steps move the surface by far less than what it sees is away: the
    points of vertices index [P] and their transfer, how the frames see them, and what they reflect (None: nothing)."""

    precomputed: PrecomputedTransfer
    index: np.ndarray
    points: Points
    transfer: Transfer
    looks: list[SurfaceView]
    reflections: Reflections | None

    def kept(self) -> Traced:
        """What a finer level needs of it: neither pictures nor reflections."""
        return replace(self, looks=[], reflections=None)

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
    """Refines a mesh and its subdivisions from views of it; tracks: what tracking knows of the surface, or None."""

    def __init__(
        self,
        views: Views,
        tracks: TrackPoints | None,
        reflectance: Reflectance,
        appearance: AppearanceSettings,
        sizes: Sizes,
        settings: ShapeSettings,
        context: RunContext = SILENT,
    ):
        self.views, self.tracks, self.reflectance = views, tracks, reflectance
        self.appearance, self.sizes, self.settings, self.context = appearance, sizes, settings, context
        self._shading: VertexShading | None = None

    def trace(self, mesh: Mesh, shaped: np.ndarray, before: Traced | None = None) -> Traced:
        """Looks at the shaped faces' vertices that some frame faces. before: of a coarser level, whose nearest point
        tells what each sees. shaped [F] bool: the faces that may move."""
        views, viewer = self.views, SurfaceViewer.of(mesh)
        wanted = np.zeros(len(mesh.vertices), bool)
        wanted[mesh.faces[shaped]] = True
        index = np.nonzero(wanted & face_front(viewer, views.camera_from_head, 0.2))[0]
        points = mesh_points(mesh, index)
        if before is None:
            precomputed = precompute_transfer(
                viewer, self.sizes, self.appearance.visibility, self.reflectance.directions
            )
            transfer = precomputed.trace(points)
        else:
            precomputed, transfer = before.precomputed, before.transfer.take(nearest_points(points, before.points))
        blur = BLUR_EDGES * typical_edge(mesh.vertices, mesh.faces[shaped])
        looks = look_at_surface(viewer, index, views, blur, self.context)
        traced = Traced(precomputed, index, points, transfer, looks, None)
        if not self.appearance.specular or len(index) < FEWEST_POINTS:
            return traced
        shading = self._shade(mesh, traced, points, traced.turned_to(points.normals))
        return replace(traced, reflections=Reflections(shading, np.arange(len(index))))

    def examine(self, mesh: Mesh, shaped: np.ndarray, traced: Traced) -> ShapedSurface | None:
        """Samples, shading and equations of the traced vertices; None where hardly any is seen. shaped [F] bool: the
        faces that may move."""
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
        shading = self._shade(mesh, traced, points, transfer)
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

    def _shade(self, mesh, traced: Traced, points, transfer) -> VertexShading:
        known, precomputed = self.reflectance, traced.precomputed
        local = None if known.local_roughness_fit is None else known.local_roughness_fit.roughness(points.positions)
        node_albedo = known.node_albedo[nearest_points(precomputed.nodes.points, known.nodes.points)]
        material = Material(node_albedo, known.specular, known.roughness, local)
        place = traced.index, mesh.vertices, points, transfer
        if self._shading is None:  # all levels and steps have its light and its nodes
            self._shading = VertexShading(
                *place,
                precomputed.node_transfer,
                material,
                known.light,
                precomputed.directions,
                self.views.camera_from_head,
                self.appearance.light_moves(self.views.moves),
                bounce=self.appearance.bounce,
                light_index=self.views.light_index,
                lamp=known.lamp,
                node_points=precomputed.nodes.points,
            )
            return self._shading
        return self._shading.of_points(*place, material)

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
        metric = large_step_metric(mesh.faces, count, self.settings.smoothness, self.settings.sigma_mm)
        free = np.ones(count, bool)
        free[mesh.faces[held]] = False
        offsets = solve_offsets(mesh.vertices, start, normals, metric, free, terms, self.context.note)
        largest = LARGEST_STEP_EDGES * typical_edge(mesh.vertices, mesh.faces[shaped])
        return np.clip(offsets, -largest, largest)

    def refine(
        self, mesh: Mesh, shaped: np.ndarray, held: np.ndarray, begun: tuple[Mesh, Traced] | None = None
    ) -> tuple[Mesh, Mesh, Traced | None]:
        """The mesh subdivided as the settings say, as it was and refined, and what was traced last. shaped, held
        [faces] bool; begun: the mesh, or a subdivision of it, as it was refined before, with what was traced then: goes
        on from the next one."""
        start, (mesh, traced) = mesh, begun or (mesh, None)
        finished = len(mesh.faces) if begun else 0
        for level in range(self.settings.subdivisions + 1):
            if level > 0:
                shaped, held, start = np.repeat(shaped, 4), np.repeat(held, 4), subdivide(start)
            if finished >= len(start.faces):
                continue
            if len(mesh.faces) < len(start.faces):
                mesh = subdivide(mesh)
            traced = self.trace(mesh, shaped, traced)
            mesh = self._refine_level(mesh, start.vertices, shaped, held, level, traced)
        return start, mesh, traced

    def _refine_level(self, mesh, start, shaped, held, level, traced: Traced) -> Mesh:
        surface = self.examine(mesh, shaped, traced)
        if surface is None:
            self.context.note(f"shape level {level}: too little of the face is seen, the mesh stays")
            return mesh
        self.context.note(f"shape level {level}: {len(surface.index)} points, {_residuals(surface)}")
        best, worse = surface, 0
        for number in range(self.settings.rounds):
            offsets = self.step(surface, start, shaped, held)
            normals = vertex_normals(surface.mesh.vertices, surface.mesh.faces)
            vertices = surface.mesh.vertices + offsets[:, None] * normals
            if number + 1 == self.settings.rounds and not (self.settings.looks_back or worse):
                return mesh.replace(vertices=vertices)
            moved = self.examine(mesh.replace(vertices=vertices), shaped, traced)
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


def typical_edge(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Median length of the faces' first edges, mm."""
    return float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))


def _residuals(surface: ShapedSurface) -> str:
    return f"residual {surface.equations.fitted:.5f} fitted, {surface.equations.held_out:.5f} held out"
