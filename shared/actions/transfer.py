"""Displacements of the head model carried over to a solved head of its topology.

Both heads have the same vertices, so that one is a smooth map of the other, x -> f(x). A displacement d of the model at
x is f'(x) d on the solved head: motion vectors turned and scaled with the surface, as [Noh2001] has them. f' comes from
the similarity that takes a vertex' neighbourhood in space from the one head to the other best: moving least squares
[Schaefer2006] with the closed form of [Umeyama1991]. Its neighbourhood is centimetres wide and does not stop at the
lips: upper and lower lip move alike where they lie on each other, as they do in the model, and what was refined by
tenths of a millimetre does not turn anything.

What moves between frames is exact where the solved head is a similarity of the model.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

REACH_MM = 30.0
"""Of a neighbourhood: there its weight has come down to zero."""
LEAST_WEIGHT = 3.0
"""Vertices around which fewer than so many count are given the map of the nearest that has more."""


def local_similarities(source: np.ndarray, target: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """[V, 3, 3]: scale times rotation that takes the surroundings of each source vertex [V, 3] mm to target [V, 3].

    counted [V] bool: vertices whose places count.
    """
    tree = cKDTree(source[counted])
    near = cKDTree(source).sparse_distance_matrix(tree, REACH_MM, output_type="coo_matrix").tocsr()
    near.data = np.square(1.0 - np.square(near.data / REACH_MM))
    total = np.asarray(near.sum(1)).ravel()
    known = np.nonzero(total > LEAST_WEIGHT)[0]
    near = sparse.diags(1.0 / total[known]) @ near[known]
    a, b = source[counted], target[counted]
    mean_a, mean_b = near @ a, near @ b
    spread = near @ np.square(a).sum(1) - np.square(mean_a).sum(1)
    both = (near @ (b[:, :, None] * a[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
    u, singular, vt = np.linalg.svd(both - mean_b[:, :, None] * mean_a[:, None, :])
    signs = np.ones((len(known), 3))
    signs[:, 2] = np.sign(np.linalg.det(u @ vt))
    maps = (u * signs[:, None, :]) @ vt * ((singular * signs).sum(1) / spread)[:, None, None]
    return maps[cKDTree(source[known]).query(source)[1]]


def carried(moves: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Displacements [V, 3] mm on the target, from moves [V, 3] mm on the source; maps [V, 3, 3]."""
    return np.einsum("vij,vj->vi", maps, moves)
