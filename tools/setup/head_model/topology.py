"""Which part of MakeHuman's body becomes the head: skin down to the neck, mouth bag, eye sockets, eyeballs.

Eyeballs stay (they block light and carry texture); the sockets behind them and the mouth bag stay so that the
head is one closed surface with a single rim, at the neck, and rays that enter between lids or lips end on
something. Lashes go (open cards that would cast hard shadows), and so do teeth and tongue (hidden in a nearly
neutral face).
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components

from tools.setup.head_model.makehuman import BaseMesh

NECK_RINGS = 4
FRONT_NECK_RINGS = 6
THROAT_HALF_WIDTH = 48.0
LIP_RINGS = 7
"""Rings of quads around the mouth bag that make the red of the lips."""
SKIN, MOUTH, SOCKET_LEFT, SOCKET_RIGHT, EYE_LEFT, EYE_RIGHT = range(6)
"""Parts of the head; left is the subject's left (x > 0)."""


@dataclass(frozen=True)
class HeadTopology:
    """base_index [V] into the base mesh, faces [F, 3], part [F], mirror [V]."""

    base_index: np.ndarray
    faces: np.ndarray
    part: np.ndarray
    mirror: np.ndarray

    def vertices_of(self, *parts: int) -> np.ndarray:
        """Indices of all vertices of the given parts, sorted."""
        return np.unique(self.faces[np.isin(self.part, parts)])


def head_topology(base: BaseMesh, mirror: np.ndarray) -> HeadTopology:
    """Select the head's quads, triangulate them symmetrically and renumber the vertices in the base mesh's
    order.
    """
    quads, part = _head_quads(base)
    faces, source = _triangulate(base.vertices, quads)
    base_index, local = np.unique(faces, return_inverse=True)
    local_of_base = np.full(len(base.vertices), -1)
    local_of_base[base_index] = np.arange(len(base_index))
    return HeadTopology(
        base_index,
        local.reshape(-1, 3).astype(np.int32),
        part[source].astype(np.uint8),
        local_of_base[mirror[base_index]],
    )


def rings_around(topology: HeadTopology, parts: tuple[int, ...], count: int) -> np.ndarray:
    """[F] how many rings of skin quads a face lies from the given parts: 0 touches them, -1 is `count` or
    more away.

    MakeHuman's edge loops follow lids and lips, so rings are the natural outlines of both.
    """
    quads = topology.faces.reshape(-1, 6)
    part = topology.part[::2]
    ring = np.full(len(quads), -1)
    reached = np.zeros(len(topology.base_index), bool)
    reached[quads[np.isin(part, parts)]] = True
    for k in range(count):
        new = reached[quads].any(1) & (part == SKIN) & (ring < 0)
        ring[new] = k
        reached[quads[new]] = True
    return np.repeat(ring, 2)


def _head_quads(base: BaseMesh) -> tuple[np.ndarray, np.ndarray]:
    """Quads [Q, 4] and parts [Q]. The texture islands of the body tell its parts apart."""
    quads, uvs = base.quads["body"], base.quad_uvs["body"]
    centre = base.vertices[quads].mean(1)
    edges = np.concatenate([uvs[:, [k, (k + 1) % 4]] for k in range(4)])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(base.uvs),) * 2)
    island = connected_components(graph)[1][uvs[:, 0]]

    def island_at(point: tuple[float, float, float]) -> int:
        return island[np.argmin(np.linalg.norm(centre - point, axis=1))]

    # Anchors in the base mesh, mm: crown, back of the mouth bag, depths of the eye sockets, chest.
    chosen = np.full(len(quads), -1)
    for part, anchor in (
        (SKIN, (0, 850, 10)),
        (MOUTH, (0, 640, 56)),
        (SOCKET_LEFT, (31, 728, 109)),
        (SOCKET_RIGHT, (-31, 728, 109)),
    ):
        chosen[island == island_at(anchor)] = part
    chest = island == island_at((0, 450, 150))
    # The throat takes two rings more than the rest, which brings the rim to about one height.
    throat = (np.abs(centre[:, 0]) < THROAT_HALF_WIDTH) & (centre[:, 2] > 0)
    for ring in range(FRONT_NECK_RINGS):
        reached = np.isin(quads, quads[chosen == SKIN]).any(1) & chest & (chosen < 0)
        chosen[reached & (throat | (ring < NECK_RINGS))] = SKIN
    keep = chosen >= 0
    eyes = [base.quads["helper-l-eye"], base.quads["helper-r-eye"]]
    parts = [chosen[keep], np.full(len(eyes[0]), EYE_LEFT), np.full(len(eyes[1]), EYE_RIGHT)]
    return np.concatenate([quads[keep], *eyes]), np.concatenate(parts)


def _triangulate(vertices: np.ndarray, quads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split each quad along its shorter diagonal: faces [2 Q, 3] and the quad each came from [2 Q].

    The base mesh is exactly symmetric, so mirrored quads get mirrored diagonals; ties on the middle line are
    broken by the height of the diagonal's ends, which mirroring does not change. A vertex that only one quad
    has, a corner of the rim, is an end of the diagonal, so that no triangle has two edges on the rim.
    """
    corners = vertices[quads]
    first = np.linalg.norm(corners[:, 0] - corners[:, 2], axis=1).round(6)
    second = np.linalg.norm(corners[:, 1] - corners[:, 3], axis=1).round(6)
    height = corners[:, [0, 2], 1].max(1) >= corners[:, [1, 3], 1].max(1)
    along_first = (first < second) | ((first == second) & height)
    alone = np.bincount(quads.ravel(), minlength=len(vertices))[quads] == 1
    along_first = np.where(alone.any(1), alone[:, 0] | alone[:, 2], along_first)
    split = np.where(along_first[:, None], quads[:, [0, 1, 2, 0, 2, 3]], quads[:, [1, 2, 3, 1, 3, 0]])
    return split.reshape(-1, 3), np.repeat(np.arange(len(quads)), 2)
