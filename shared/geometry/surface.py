"""The head's surface as solvers are given it: a mesh, what its parts are, and track points that lie on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shared.geometry.mesh import Mesh

TRACK_FLOOR_MM = 0.1
"""Error of a track point that more frames or sharper pictures do not lessen."""


@dataclass(frozen=True, eq=False)
class TrackPoints:
    """Points on the skin known from tracking: positions [N, 3] head space and standard deviation of depth [N], mm."""

    positions: np.ndarray
    sigma_mm: np.ndarray

    @classmethod
    def tracked(cls, positions: np.ndarray, sigma_mm: np.ndarray) -> TrackPoints:
        """Points [N, 3] mm with the deviation sigma_mm [N] that the adjustment states, and the floor under it."""
        return cls(positions, np.hypot(TRACK_FLOOR_MM, sigma_mm))


@dataclass(frozen=True, eq=False)
class Surface:
    """mesh; face_segment [faces]: index into segment_names, None where the mesh has no segments; tracks: None where
    mesh and poses were given and not tracked."""

    mesh: Mesh
    face_segment: np.ndarray | None = None
    segment_names: tuple[str, ...] = ()
    tracks: TrackPoints | None = None

    def faces_of(self, names: Sequence[str]) -> np.ndarray:
        """[faces] bool: faces in the named segments, of a mesh that has segments."""
        wanted = [self.segment_names.index(name) for name in names if name in self.segment_names]
        return np.isin(self.face_segment, wanted)

    def faces_near(self, names: Sequence[str], edges: int) -> np.ndarray:
        """[faces] bool: faces in the named segments and those within so many edges of them."""
        found = self.faces_of(names)
        for _ in range(edges):
            reached = np.zeros(len(self.mesh.vertices), bool)
            reached[self.mesh.faces[found]] = True
            found = reached[self.mesh.faces].any(1)
        return found

    def vertices_of(self, names: Sequence[str]) -> np.ndarray:
        """[V] bool: vertices of faces in the named segments; all of them where the mesh has no segments."""
        if self.face_segment is None:
            return np.ones(len(self.mesh.vertices), bool)
        found = np.zeros(len(self.mesh.vertices), bool)
        found[self.mesh.faces[self.faces_of(names)]] = True
        return found

    def with_mesh(self, mesh: Mesh) -> Surface:
        """The same with another mesh of its topology, or one that it was subdivided into."""
        if self.face_segment is None:
            return replace(self, mesh=mesh)
        times = len(mesh.faces) // len(self.mesh.faces)
        return replace(self, mesh=mesh, face_segment=np.repeat(self.face_segment, times))
