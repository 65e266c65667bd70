"""Skin that an action would fold over is smoothed.

The head model's strongest actions, as a full smile, crease the skin of the cheek until it passes through itself. There
the displacements, not the skin, are smoothed: each vertex moves as those around it do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from shared.geometry.mesh import face_normals, vertex_adjacency

FOLDED_COSINE, FOLDED_AREA = 0.35, 0.15
"""A face is folded over where its normal turns so far from where it was, or its area shrinks to such a share."""
ROUNDS, RINGS, SMOOTHINGS = 12, 6, 4


@dataclass(frozen=True, eq=False)
class SkinFolds:
    """vertices [V, 3] mm at rest; faces [F, 3] of the skin and their normals [F, 3] at rest, as long as twice the area;
    free [V] bool: what may be smoothed; near [V, V]: mean of the vertices around."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    free: np.ndarray
    near: sparse.csr_matrix

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray, free: np.ndarray) -> SkinFolds:
        """vertices [V, 3] mm and faces [F, 3] of the whole head; free [V] bool: the skin without what touches
        anything."""
        near = vertex_adjacency(faces, len(vertices))
        near = (sparse.diags(1.0 / np.maximum(np.asarray(near.sum(1)).ravel(), 1.0)) @ near).tocsr()
        faces = faces[free[faces].all(1)]
        return cls(vertices, faces, face_normals(vertices, faces), free, near)

    def folded(self, moves: np.ndarray) -> np.ndarray:
        """[F] bool: faces of the skin that displacements moves [V, 3] mm fold over or squeeze together."""
        before, after = self.normals, face_normals(self.vertices + moves, self.faces)
        length, moved = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
        turned = (before * after).sum(1) < FOLDED_COSINE * length * moved
        return (turned | (moved < FOLDED_AREA * length)) & (length > 0.0)

    def smoothed(self, moves: np.ndarray) -> np.ndarray:
        """Displacements moves [V, 3] mm, smoothed where they fold the skin, with what lies around going along."""
        for _ in range(ROUNDS):
            folded = self.folded(moves)
            if not folded.any():
                break
            share = np.zeros(len(moves))
            share[self.faces[folded]] = 1.0
            for _ in range(RINGS):
                share = np.maximum(share, self.near @ share)
            share *= self.free
            for _ in range(SMOOTHINGS):
                moves = moves + share[:, None] * (self.near @ moves - moves)
        return moves
