"""Where an action makes the skin of a head pass through itself."""

from __future__ import annotations

import numpy as np

from shared.geometry.blend_shapes import BlendShape
from shared.geometry.intersections import crossing_edges
from shared.geometry.surface import Surface

TOUCHING = ("lids", "eyes", "eye_sockets", "lips", "inner_mouth")
"""Segments in which skin touches skin, or an eyeball. The rims of a fitted head's lids, deeper than real ones, reach
into the ball at rest."""


def new_crossings(surface: Surface, shape: BlendShape, weight: float = 1.0) -> dict[str, int]:
    """{segment: edges that pass through a face with the action at a weight and do not at rest}; an edge counts for the
    segment of its first vertex, and where one of both lies outside of TOUCHING, for that one's."""
    vertices, faces = surface.mesh.vertices, surface.mesh.faces
    edges = crossing_edges(shape.applied(vertices, weight), faces)
    known = np.isin(edges @ [len(vertices), 1], crossing_edges(vertices, faces, edges) @ [len(vertices), 1])
    of_vertex = np.zeros(len(vertices), int)
    of_vertex[faces] = surface.face_segment[:, None]
    ends = np.array(surface.segment_names)[of_vertex[edges[~known]]]
    chosen = np.where(np.isin(ends[:, 0], TOUCHING), ends[:, 1], ends[:, 0])
    chosen = np.where(np.isin(chosen, TOUCHING), ends[:, 0], chosen)
    return {str(name): int(count) for name, count in zip(*np.unique(chosen, return_counts=True), strict=True)}
