"""Precomputed transfer of a mesh: the part of its shading that no frame and no light changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shared.geometry.mesh import normalised
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import fibonacci_sphere
from shared.imaging.image_sampling import SurfaceViewer
from shared.rendering.transfer import Nodes, Points, Transfer, bounce_nodes, nearest_points, trace_transfer


@dataclass(frozen=True)
class Sizes:
    """points on the surface, directions over the sphere, nodes that bounce light."""

    points: int = 4000
    directions: int = 768
    nodes: int = 1000

    def at_most(self, other: Sizes) -> Sizes:
        """The smaller of each."""
        return Sizes(min(self.points, other.points), min(self.directions, other.directions),
                     min(self.nodes, other.nodes))


@dataclass(frozen=True)
class PrecomputedTransfer:
    """What does not depend on the frames: directions [J, 3] (a direction_set), bounce nodes and their transfer, whether
    parts of the head cover each other."""

    scene: RayScene
    directions: np.ndarray
    nodes: Nodes
    node_transfer: Transfer
    visibility: bool = True

    def trace(self, points: Points, progress: Callable = iter) -> Transfer:
        """The transfer of surface points along the directions."""
        return trace_transfer(
            self.scene, points, self.nodes, self.directions, progress=progress, visibility=self.visibility
        )


    def with_standing(self, viewer: SurfaceViewer) -> PrecomputedTransfer:
        """For points of what stands off the head: of a viewer's mesh, whose first faces are the head's. It is shaded by
        all that is there and lit by the head's nodes, and casts no shadow on the head itself, whose light was solved
        without it: a shell about hair that lies on the skin would leave it no light."""
        mesh, count = viewer.mesh, len(self.nodes.of_face)
        centres = Points(mesh.vertices[mesh.faces[count:]].mean(1),
                         normalised(viewer.normals[mesh.faces[count:]].mean(1)))
        more = nearest_points(centres, self.nodes.points).astype(np.int32)
        nodes = Nodes(self.nodes.points, np.concatenate([self.nodes.of_face, more]))
        return replace(self, scene=viewer.scene, nodes=nodes)


def precompute_transfer(
    viewer: SurfaceViewer, sizes: Sizes, visibility: bool = True, directions: np.ndarray | None = None
) -> PrecomputedTransfer:
    """Bounce nodes of a mesh, traced along directions [J, 3], or along an even set; visibility off: see trace_transfer.
    """
    directions = fibonacci_sphere(sizes.directions) if directions is None else directions
    nodes = bounce_nodes(viewer.mesh, sizes.nodes, viewer.layout)
    node_transfer = trace_transfer(viewer.scene, nodes.points, nodes, directions, visibility=visibility)
    return PrecomputedTransfer(viewer.scene, directions, nodes, node_transfer, visibility)
