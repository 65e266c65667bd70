"""Sets up the appearance fit: which points, frames and directions it looks at."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from shared.appearance.chart_scale import ChartStatement
from shared.geometry.transforms import world_from_head
from shared.imaging.frame_index import frames_of_lights, spread_frames
from shared.imaging.image_sampling import Picture, Samples, SurfaceViewer, sample_points_in_frames
from shared.rendering.precomputed_transfer import PrecomputedTransfer
from shared.rendering.shading import DEEP
from shared.rendering.transfer import Nodes, Points, Transfer, mesh_points, spread_vertices

MINIMUM_FRAMES = 4


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
