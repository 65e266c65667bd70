"""Sets up the appearance fit: which points, frames and directions it looks at."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from shared.gather import Picture, Samples, SurfaceViewer, sample_points_in_frames
from shared.geometry import fibonacci_sphere, world_from_head
from shared.raycast import RayScene
from shared.shading import DEEP
from shared.solve.chart_scale import ChartStatement
from shared.transfer import (
    Nodes,
    Points,
    Transfer,
    bounce_nodes,
    mesh_points,
    spread_vertices,
    trace_transfer,
)

MINIMUM_FRAMES = 4


@dataclass(frozen=True)
class Sizes:
    """points on the surface, directions over the sphere, nodes that bounce light."""

    points: int = 4000
    directions: int = 768
    nodes: int = 1000


@dataclass(frozen=True)
class PrecomputedTransfer:
    """What does not depend on the frames: directions [J, 3], bounce nodes and their transfer, whether parts of the
    head cover each other."""

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


@dataclass(frozen=True)
class Capture:
    """What the solver looks at: P points seen in F frames.

    points [P] with samples [P, F] and transfer; nodes and their own transfer; directions [J, 3];
    world_from_head [F, 3, 3]; fitted [F] bool (the other frames are held out); skin [P] bool: where the prior on skin
    reflectance applies; chart: what a colour chart says about the light's scale; light_index [F]: which of several
    lights each frame stands in, None: there is one.
    """

    points: Points
    samples: Samples
    transfer: Transfer
    nodes: Nodes
    node_transfer: Transfer
    directions: np.ndarray
    world_from_head: np.ndarray
    fitted: np.ndarray
    skin: np.ndarray
    chart: ChartStatement | None = None
    light_index: np.ndarray | None = None

    @property
    def frames_of_lights(self) -> list[np.ndarray]:
        """Of each light, the indices of its frames."""
        return frames_of_lights(self.light_index, len(self.world_from_head))


def frames_of_lights(light_index: np.ndarray | None, count: int) -> list[np.ndarray]:
    """Of each light, the indices of its frames out of count; light_index [count]: each frame's light, None: one."""
    index = np.zeros(count, int) if light_index is None else light_index
    return [np.nonzero(index == light)[0] for light in range(int(index.max(initial=0)) + 1)]


def precompute_transfer(viewer: SurfaceViewer, sizes: Sizes, visibility: bool = True) -> PrecomputedTransfer:
    """Directions and bounce nodes of a mesh, traced; visibility off: see trace_transfer."""
    directions = fibonacci_sphere(sizes.directions)
    nodes = bounce_nodes(viewer.mesh, sizes.nodes, viewer.layout)
    node_transfer = trace_transfer(viewer.scene, nodes.points, nodes, directions, visibility=visibility)
    return PrecomputedTransfer(viewer.scene, directions, nodes, node_transfer, visibility)


def spread_frames(count: int, wanted: int, light_index: np.ndarray | None = None) -> np.ndarray:
    """At most wanted indices, evenly over range(count); of several lights, as many of each."""
    frames = frames_of_lights(light_index, count)
    spread = [own[np.unique(np.round(np.linspace(0, len(own) - 1, min(wanted, len(own)))).astype(int))]
              for own in frames]
    return np.concatenate(spread)


def hold_out(count: int, every: int, light_index: np.ndarray | None = None) -> np.ndarray:
    """[count] bool, True for fitted frames: every every-th frame is held out, starting in the middle of a period; of
    several lights, among the frames of each."""
    fitted = np.ones(count, bool)
    for own in frames_of_lights(light_index, count):
        if len(own) > every:
            fitted[own[every // 2 :: every]] = False
    return fitted


def lens_of_frames(intrinsics: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Intrinsics [3, 3] of all frames as they are, of [F, 3, 3] those of some frames."""
    return intrinsics if intrinsics.ndim == 2 else intrinsics[frames]


def face_front(viewer: SurfaceViewer, camera_from_head: np.ndarray, limit: float) -> np.ndarray:
    """[V] bool: vertices that turn towards the camera in some frame, by more than the cosine limit."""
    rotation, translation = camera_from_head[:, :3, :3], camera_from_head[:, :3, 3]
    centres = -np.einsum("fji,fj->fi", rotation, translation)
    found = np.zeros(len(viewer.mesh.vertices), bool)
    for centre in centres[spread_frames(len(centres), 40)]:
        towards = centre - viewer.mesh.vertices
        cosine = (towards * viewer.normals).sum(1) / np.linalg.norm(towards, axis=1)
        found |= cosine > limit
    return found


def build_capture(
    viewer: SurfaceViewer,
    precomputed: PrecomputedTransfer,
    pictures: Iterable[Picture],
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    moves: str,
    fitted: np.ndarray,
    allowed: np.ndarray,
    skin: np.ndarray,
    count: int,
    progress: Callable = iter,
    light_index: np.ndarray | None = None,
) -> Capture:
    """Samples and transfer of at most count vertices in F frames.

    pictures: the F frames in order; camera_from_head [F, 4, 4]; intrinsics [3, 3], or [F, 3, 3] of each; fitted [F];
    allowed, skin [V] bool: vertices that may be chosen, and where the prior on skin reflectance applies; light_index
    [F]: each frame's light, None: there is one. Vertices seen in fewer than MINIMUM_FRAMES fitted frames
    or deep inside the mesh are left out.
    """
    front = allowed & face_front(viewer, camera_from_head, 0.2)
    index = spread_vertices(viewer.layout, count, front)
    samples = sample_points_in_frames(viewer, index, pictures, camera_from_head, intrinsics)
    # Of very few frames, chosen to cover the face, no point is seen in all.
    least = min(MINIMUM_FRAMES, -(-2 * int(fitted.sum()) // 3))
    seen = (samples.weight[:, fitted] > 0).sum(1) >= least
    points = mesh_points(viewer.mesh, index[seen])
    transfer = precomputed.trace(points, progress)
    shallow = np.nonzero(transfer.blocked < DEEP)[0]
    chosen = np.nonzero(seen)[0][shallow]
    return Capture(
        points=points.take(shallow),
        samples=samples.points(chosen),
        transfer=transfer.take(shallow),
        nodes=precomputed.nodes,
        node_transfer=precomputed.node_transfer,
        directions=precomputed.directions,
        world_from_head=world_from_head(camera_from_head, moves),
        fitted=fitted,
        skin=skin[index[chosen]],
        light_index=light_index,
    )
