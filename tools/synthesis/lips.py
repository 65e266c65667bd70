"""Lips of a synthetic head that are shut: on some random heads they leave a slit, mostly at the corners.

Along the mouth the two lips come nearer, by steps and each by half, until no ray from before them, level or somewhat
tilted, meets the inner mouth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from scipy.ndimage import gaussian_filter1d
from scipy.sparse.csgraph import connected_components, dijkstra

from shared.compute.smooth_step import smooth_step
from shared.geometry.mesh import half_edges
from shared.geometry.raycast import RayScene
from tools.synthesis.head import Head

COLUMN_MM, ROW_MM, HEIGHT_MM = 1.0, 0.1, 8.0
"""Between columns of rays along the mouth, between rays in one, and how far they reach above and below its middle."""
TILTS = (-0.3, 0.0, 0.3)
"""Slopes of the rays, up and down."""
STEP_MM, STEPS = 0.2, 16
REACH_MM = 8.0
"""Along the surface from the lips' inner edge: what moves with it."""
CORNER_MM = 6.0
"""Skin near a corner of the mouth, whose ways to the two lips differ by less than half of this, moves less."""
BEFORE_MM, BESIDE_MM = 60.0, 45.0


@dataclass(frozen=True, eq=False)
class _Mouth:
    """middle [3] and half its width, mm; share [V]: of the closing by which each vertex moves up, or down below 0."""

    middle: np.ndarray
    half_width: float
    share: np.ndarray


def with_shut_lips(head: Head) -> Head:
    """The head with its lips brought together where they were apart."""
    mouth, mesh = _mouth(head), head.mesh
    columns = np.arange(-mouth.half_width, mouth.half_width + COLUMN_MM, COLUMN_MM)
    closing, vertices = np.zeros(len(columns)), mesh.vertices
    for _ in range(STEPS):
        apart = _apart(head, vertices, mouth, columns)
        if not apart.any():
            break
        closing = closing + STEP_MM * np.minimum(1.0, 1.5 * gaussian_filter1d(apart.astype(float), 1.5))
        moved = np.interp(mesh.vertices[:, 0] - mouth.middle[0], columns, closing) * mouth.share
        vertices = mesh.vertices + moved[:, None] * [0.0, 1.0, 0.0]
    return replace(head, mesh=mesh.replace(vertices=vertices))


def slit_mm(head: Head) -> float:
    """Length of the mouth along which rays from the front meet the inner mouth."""
    mouth = _mouth(head)
    columns = np.arange(-mouth.half_width, mouth.half_width + COLUMN_MM, COLUMN_MM)
    return COLUMN_MM * float(_apart(head, head.mesh.vertices, mouth, columns).sum())


def _mouth(head: Head) -> _Mouth:
    vertices, faces = head.mesh.vertices, head.mesh.faces
    lips, inner = (_edges(faces[head.face_segment == head.segment_names.index(name)])
                   for name in ("lips", "inner_mouth"))
    edge = np.array(sorted(lips & inner))
    inside = np.unique(edge)
    corners = inside[[vertices[inside, 0].argmin(), vertices[inside, 0].argmax()]]
    arcs = _arcs(edge[~np.isin(edge, corners).any(1)], len(vertices))
    lower, upper = sorted(arcs, key=lambda arc: vertices[arc, 1].mean())
    middle, half_width = vertices[inside].mean(0), 0.5 * float(np.ptp(vertices[inside, 0]))
    pairs = half_edges(faces)
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    graph = sparse.coo_matrix((length, pairs.T), shape=(len(vertices),) * 2).tocsr()
    below, above = (dijkstra(graph, indices=arc, min_only=True, limit=REACH_MM) for arc in (lower, upper))
    weight = smooth_step(1.0 - np.minimum(below, above) / REACH_MM)
    upwards = np.clip((np.minimum(above, REACH_MM) - np.minimum(below, REACH_MM)) / CORNER_MM, -0.5, 0.5)
    return _Mouth(middle, half_width, upwards * weight)


def _edges(faces: np.ndarray) -> set[tuple[int, int]]:
    return {(min(a, b), max(a, b)) for a, b in half_edges(faces).tolist()}


def _arcs(edge: np.ndarray, count: int) -> list[np.ndarray]:
    """The two largest connected parts of edges [E, 2]: vertices of each."""
    graph = sparse.coo_matrix((np.ones(len(edge)), edge.T), shape=(count, count))
    label, used = connected_components(graph, directed=False)[1], np.unique(edge)
    found, sizes = np.unique(label[used], return_counts=True)
    return [used[label[used] == one] for one in found[np.argsort(sizes)[-2:]]]


def _apart(head: Head, vertices: np.ndarray, mouth: _Mouth, columns: np.ndarray) -> np.ndarray:
    """[K] bool: columns at which a ray meets the inner mouth."""
    near = np.linalg.norm(vertices - mouth.middle, axis=1) < BESIDE_MM
    chosen = near[head.mesh.faces].any(1)
    within = head.face_segment[chosen] == head.segment_names.index("inner_mouth")
    scene, rows = RayScene(vertices, head.mesh.faces[chosen]), np.arange(-HEIGHT_MM, HEIGHT_MM, ROW_MM)
    x, y = np.meshgrid(columns, rows)
    apart = np.zeros(len(columns), bool)
    for tilt in TILTS:
        origins = mouth.middle + np.stack([x, y - tilt * BEFORE_MM, np.full_like(x, BEFORE_MM)], -1).reshape(-1, 3)
        towards = np.tile(np.float32([0.0, tilt, -1.0]), (len(origins), 1))
        face = scene.first_faces(origins.astype(np.float32), towards)
        apart |= ((face < 0) | within[face]).reshape(x.shape).any(0)  # the throat lies deeper than what is near
    return apart
