"""Lips that an action presses together meet, and go no farther.

Where the lips lie on each other at rest, each vertex has partners on the other side. An action may bring them nearer
until they touch; what goes beyond is taken back, by halves from both sides, across the lips as they then lie. Sliding
along each other is left alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from shared.geometry.intersections import crossing_edges, edges_beside
from shared.geometry.mesh import mesh_edges, normalised, vertex_adjacency, vertex_normals
from shared.tracking.head_model import HeadModel

CONTACT_MM, FACING_COSINE = 4.0, -0.3
"""Partners are so near, and the cosine between their normals is below."""
BLUR_MM = 0.7
"""By how much farther than the nearest a partner may be until it counts little."""
TOUCHING_MM = 0.05
"""Lips so far apart touch; those that are nearer at rest may stay so."""
LEAST_MM = 0.01
"""Lips that an action moves by less stay as they are."""
AROUND_MM = 5.0
"""From edges that cross: so far on what lies there is moved."""
MOST_MM = 1.5
"""Lips that would have to give way farther roll in under each other; they are left as they are."""
ROUNDS, SMOOTHINGS = 8, 6


@dataclass(frozen=True, eq=False)
class LipContact:
    """own [n]: vertices with partners; partners [n, V]: their weights, of sum 1 in each row; near [V, V]: mean of a
    vertex and those around it; gap [n] mm: to the partners at rest; faces [F, 3] and edges [E, 2]: of lips and mouth;
    at_rest [K, 2]: edges that cross faces then."""

    faces: np.ndarray
    own: np.ndarray
    partners: sparse.csr_matrix
    near: sparse.csr_matrix
    gap: np.ndarray
    edges: np.ndarray
    at_rest: np.ndarray

    @classmethod
    def of(cls, model: HeadModel, vertices: np.ndarray) -> LipContact | None:
        """Of a head at rest, vertices [V, 3] mm; None where the model has no lips."""
        if "lips" not in model.segment_names:
            return None
        faces = model.faces[model.segment("lips", "inner_mouth")]
        lips = np.unique(faces)
        normals = vertex_normals(vertices, model.faces)
        pairs = lips[cKDTree(vertices[lips]).query_pairs(CONTACT_MM, output_type="ndarray")]
        pairs = pairs[(normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(1) < FACING_COSINE]
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        away = vertices[pairs[:, 1]] - vertices[pairs[:, 0]]
        # Opposite, and not behind: the way leads out of both surfaces.
        along = np.minimum((away * normals[pairs[:, 0]]).sum(1), -(away * normals[pairs[:, 1]]).sum(1))
        pairs = pairs[along > -TOUCHING_MM]
        return cls._of_pairs(faces, pairs, vertices, normals) if len(pairs) else None

    @classmethod
    def _of_pairs(cls, faces: np.ndarray, pairs: np.ndarray, vertices: np.ndarray, normals: np.ndarray) -> LipContact:
        own, row = np.unique(pairs[:, 0], return_inverse=True)
        squared = np.square(vertices[pairs[:, 1]] - vertices[pairs[:, 0]]).sum(1)
        nearest = np.full(len(own), np.inf)
        np.minimum.at(nearest, row, squared)
        weight = np.exp((nearest[row] - squared) / (2.0 * BLUR_MM**2))
        weight /= np.bincount(row, weight)[row]
        partners = sparse.csr_matrix((weight, (row, pairs[:, 1])), shape=(len(own), len(vertices)))
        near = vertex_adjacency(faces, len(vertices)) + sparse.identity(len(vertices))
        near = sparse.diags(1.0 / np.asarray(near.sum(1)).ravel()) @ near
        across = normalised(normals[own] - partners @ normals)
        gap = ((partners @ vertices - vertices[own]) * across).sum(1)
        edges = mesh_edges(faces)[0]
        return cls(faces, own, partners.tocsr(), near.tocsr(), gap, edges, crossing_edges(vertices, faces, edges))

    def moved_by(self, moves: np.ndarray) -> bool:
        """Do displacements moves [V, 3] mm move lips?"""
        return bool(np.abs(moves[self.own]).max() > LEAST_MM)

    def parted(self, moved: np.ndarray) -> np.ndarray:
        """Vertices moved [V, 3] mm by an action, with lips that do not pass through each other.

        Only what lies near to where they do is moved, and the round is kept that leaves fewest edges crossing.
        """
        least, placed = np.minimum(self.gap, TOUCHING_MM), moved
        best, fewest = moved, np.inf
        for attempt in range(ROUNDS + 1):
            if np.linalg.norm(placed - moved, axis=1).max() >= MOST_MM:
                break
            crossing = self._crossing(placed)
            if len(crossing) < fewest:
                best, fewest = placed, len(crossing)
            if not len(crossing) or attempt == ROUNDS:
                break
            where = cKDTree(placed[crossing]).query(placed[self.own], distance_upper_bound=AROUND_MM)[0]
            placed = self._pushed(placed, least, np.clip(2.0 - 2.0 * where / AROUND_MM, 0.0, 1.0))
        return best

    def _crossing(self, placed: np.ndarray) -> np.ndarray:
        """Vertices of edges that pass through faces, and did not at rest."""
        edges = crossing_edges(placed, self.faces, self.edges)
        return np.unique(edges_beside(edges, self.at_rest))

    def _pushed(self, placed: np.ndarray, least: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Both sides moved apart until their gap is the least [n] mm, by a share [n] of the way."""
        normals = vertex_normals(placed, self.faces)
        across = normalised(normals[self.own] - self.partners @ normals)
        gap = ((self.partners @ placed - placed[self.own]) * across).sum(1)
        back = share * np.maximum(least - gap, 0.0)
        push = np.zeros_like(placed)
        push[self.own] = -0.5 * back[:, None] * across
        most = np.linalg.norm(push, axis=1).max()
        for _ in range(SMOOTHINGS):
            push = self.near @ push
        return placed + push * (most / max(np.linalg.norm(push, axis=1).max(), 1e-9))
