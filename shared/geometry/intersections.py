"""Where a mesh cuts itself, and how to move it without that.

Two triangles that cross do so along a segment whose ends lie on an edge of one or the other: it is enough to follow
every edge and see whether it meets a face.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from shared.geometry.mesh import face_normals, mesh_edges, vertex_adjacency
from shared.geometry.raycast import RayScene

_ENDS = 1e-3
"""Share of an edge at both ends that is not followed: there the faces around it begin."""
_MOST_HALVINGS = 4
_LEAST_AREA = 0.02
_RINGS = 2
"""Of vertices around a crossing that move less, at first."""
_STEEPEST = 0.3
"""Of what vertices move, by how much at most it may change from place to place, mm per mm, where some are held back."""


def crossing_edges(vertices: np.ndarray, faces: np.ndarray, edges: np.ndarray | None = None) -> np.ndarray:
    """[N, 2] edges (vertex pairs, the lower first) that pass through a face they have no vertex in common with.

    edges [E, 2]: the ones to follow; None: all.
    """
    edges = mesh_edges(faces)[0] if edges is None else edges
    if len(edges) == 0:
        return edges
    along = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    scene = RayScene(vertices, faces)
    found = np.zeros(len(edges), bool)
    for first, sign in ((0, 1.0), (1, -1.0)):
        # From both ends: the first face met may be a neighbour of the edge that hides another.
        origins = vertices[edges[:, first]] + _ENDS * sign * along
        face, _, distance = scene.intersect(origins, sign * along, farthest=1.0)
        met = np.nonzero((face >= 0) & (distance < 1.0 - 2.0 * _ENDS))[0]
        own = (faces[face[met]][:, :, None] == edges[met][:, None, :]).any((1, 2))
        found[met[~own]] = True
    return edges[found]


def edges_beside(edges: np.ndarray, known: np.ndarray) -> np.ndarray:
    """[n, 2] those of the edges [E, 2] that are not among the known ones [K, 2], both as crossing_edges gives them."""
    count = 1 + max(int(edges.max(initial=0)), int(known.max(initial=0)))
    return edges[~np.isin(edges @ [count, 1], known @ [count, 1])]


def turned_faces(start: np.ndarray, moved: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[F] bool: faces that the move from start to moved [V, 3] turns over or shrinks to next to nothing."""
    before, after = face_normals(start, faces), face_normals(moved, faces)
    return (before * after).sum(1) < _LEAST_AREA * (before * before).sum(1)


def move_without_crossing(
    start: np.ndarray, wanted: np.ndarray, faces: np.ndarray, resting: np.ndarray | None = None
) -> np.ndarray:
    """Vertices [V, 3] as near to wanted as goes without crossings that start did not have and without turned faces.

    Where moved faces cross, turn over or lose nearly all area, the move of the vertices around is halved, at last
    undone; from there it grows to what is wanted over so many millimetres that no step is left in the surface. Only
    edges near what has moved since the last look are followed. start [V, 3] and wanted [V, 3]: mm. resting [F] bool:
    faces that lie on others and may cross them, None: none does.
    """
    adjacency = vertex_adjacency(faces, len(start))
    free = faces if resting is None else faces[~resting]
    edges = mesh_edges(free)[0]
    share, placed = np.ones(len(start)), start
    for attempt in range(_MOST_HALVINGS + 1):
        last, placed = placed, start + share[:, None] * (wanted - start)
        near = _near(placed, edges, (placed != last).any(1))
        some_faces, some_edges = free[near[free].any(1)], edges[near[edges].any(1)]
        crossing = crossing_edges(placed, some_faces, some_edges)
        crossing = edges_beside(crossing, crossing_edges(start, some_faces, crossing))
        turned = turned_faces(start, placed, faces)
        if len(crossing) == 0 and not turned.any():
            return placed
        around = np.zeros(len(start))
        around[crossing.ravel()] = 1.0
        around[faces[turned].ravel()] = 1.0
        for _ in range(_RINGS + attempt):
            around = np.maximum(around, (adjacency @ around > 0) * 1.0)
        share = np.where(around > 0, 0.5 * share if attempt < _MOST_HALVINGS - 1 else 0.0, share)
        share = _without_steps(share, around > 0, start, wanted)
    return start + share[:, None] * (wanted - start)


def _without_steps(share: np.ndarray, held: np.ndarray, start: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Shares [V] of the moves from start to wanted [V, 3] mm that grow from those of the held vertices [V] bool by no
    more than _STEEPEST lets them."""
    longest = float(np.linalg.norm(wanted - start, axis=1).max())
    distance, nearest = cKDTree(start[held]).query(start, distance_upper_bound=longest / _STEEPEST)
    near = np.isfinite(distance)
    nearest = np.nonzero(held)[0][nearest[near]]
    own = np.linalg.norm((wanted - start)[near], axis=1)
    limit = share[nearest] + _STEEPEST * distance[near] / np.maximum(own, 1e-9)
    found = share.copy()
    found[near] = np.minimum(found[near], limit)
    return found


def _near(vertices: np.ndarray, edges: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """[V] bool: vertices whose faces and edges may touch what the moved vertices [V] bool belong to."""
    if not moved.any():
        return moved
    longest = float(np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=1).max())
    distance = cKDTree(vertices[moved]).query(vertices, distance_upper_bound=2.0 * longest)[0]
    return np.isfinite(distance)
