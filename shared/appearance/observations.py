"""Sets up the appearance fit: which points, frames and directions it looks at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shared.appearance.chart_scale import ChartStatement
from shared.appearance.eye_whites import WhitesSeen
from shared.compute.read_ahead import read_ahead
from shared.compute.run_context import RunContext
from shared.geometry.transforms import camera_centres, world_from_head
from shared.imaging.frame_index import frames_of_lights, spread_frames
from shared.imaging.image_sampling import Samples, SurfaceViewer, sample_points_in_frames
from shared.imaging.turning_eyes import TurningEyes
from shared.imaging.views import Views
from shared.rendering.near_lamp import SeenLamp
from shared.rendering.precomputed_transfer import PrecomputedTransfer
from shared.rendering.shading import DEEP
from shared.rendering.transfer import Nodes, Points, Transfer, mesh_points, spread_vertices

MINIMUM_FRAMES = 4


@dataclass(frozen=True)
class Capture:
    """What the solver looks at: P points seen in F frames.

    points [P] with samples [P, F] and transfer; nodes and their own transfer; directions [J, 3];
    world_from_head [F, 3, 3]; fitted [F] bool (the other frames are held out); skin [P] bool: where the prior on skin
    reflectance applies; light_index [F]: which light each frame stands in; chart: what a colour chart says about the
    light's scale; lamp: of the light, where it stands near, None: all of the light is far away; whites: the same of
    places on the whites of the eyes, None where the clip does not show enough of them.
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
    light_index: np.ndarray
    chart: ChartStatement | None = None
    lamp: SeenLamp | None = None
    whites: Capture | None = None

    def traced_anew(self, precomputed: PrecomputedTransfer) -> Capture:
        """The same with another transfer."""
        whites = None if self.whites is None else self.whites.traced_anew(precomputed)
        return replace(self, transfer=precomputed.trace(self.points), node_transfer=precomputed.node_transfer,
                       whites=whites)

    def under_lamp(self, lamp: SeenLamp) -> Capture:
        """The same with a lamp that stands near."""
        return replace(self, lamp=lamp, whites=None if self.whites is None else replace(self.whites, lamp=lamp))

    @property
    def frames_of_lights(self) -> list[np.ndarray]:
        """Of each light, the indices of its frames."""
        return frames_of_lights(self.light_index, len(self.world_from_head))

    def take(self, index: np.ndarray) -> Capture:
        """What it shows of the points index [n] int."""
        return replace(
            self,
            points=self.points.take(index),
            samples=self.samples.points(index),
            transfer=self.transfer.take(index),
            skin=self.skin[index],
        )

    def some_points(self, count: int) -> Capture:
        """Of at most count points, spread evenly; itself where it has no more, or count is 0."""
        if not 0 < count < len(self.points):
            return self
        return self.take(spread_vertices(self.points.positions, count))


def face_front(viewer: SurfaceViewer, camera_from_head: np.ndarray, limit: float) -> np.ndarray:
    """[V] bool: vertices that turn towards the camera in some frame, by more than the cosine limit."""
    centres = camera_centres(camera_from_head)
    found = np.zeros(len(viewer.mesh.vertices), bool)
    for centre in centres[spread_frames(len(centres), 40)]:
        towards = centre - viewer.mesh.vertices
        cosine = (towards * viewer.normals).sum(1) / np.linalg.norm(towards, axis=1)
        found |= cosine > limit
    return found


def build_capture(
    viewer: SurfaceViewer,
    precomputed: PrecomputedTransfer,
    views: Views,
    moves: str,
    skin: np.ndarray,
    count: int,
    context: RunContext,
    eyes: TurningEyes | None = None,
) -> Capture:
    """Samples and transfer of at most count vertices in all views.

    moves: what moves against the light, which is not the views' where the light goes along; skin [V] bool: vertices
    that may be chosen, to all of which the prior on skin reflectance applies. Vertices seen in fewer than
    MINIMUM_FRAMES fitted frames or deep inside the mesh are left out. eyes: those of the mesh, whose whites tell of the
    light, None: they are not looked at.
    """
    front = skin & face_front(viewer, views.camera_from_head, 0.2)
    index = spread_vertices(viewer.layout, count, front)
    pictures = read_ahead(map(views.picture, context.progress(range(len(views)), "sampling the pictures")))
    whites = None if eyes is None or views.lids_px is None else WhitesSeen(eyes, viewer.scene, views)
    pictures = pictures if whites is None else whites.looked_at(pictures)
    samples = sample_points_in_frames(viewer, index, pictures, views.camera_from_head, views.intrinsics)
    # Of very few frames, chosen to cover the face, no point is seen in all.
    least = min(MINIMUM_FRAMES, -(-2 * int(views.fitted.sum()) // 3))
    seen = (samples.weight[:, views.fitted] > 0).sum(1) >= least
    points = mesh_points(viewer.mesh, index[seen])
    transfer = precomputed.trace(points, lambda batches: context.progress(batches, "tracing visibility"))
    shallow = np.nonzero(transfer.blocked < DEEP)[0]
    chosen = np.nonzero(seen)[0][shallow]
    found = Capture(
        points=points.take(shallow),
        samples=samples.points(chosen),
        transfer=transfer.take(shallow),
        nodes=precomputed.nodes,
        node_transfer=precomputed.node_transfer,
        directions=precomputed.directions,
        world_from_head=world_from_head(views.camera_from_head, moves),
        fitted=views.fitted,
        skin=np.ones(len(chosen), bool),
        light_index=views.light_index,
    )
    return found if whites is None else replace(found, whites=_of_whites(whites, found, precomputed))


def _of_whites(whites: WhitesSeen, capture: Capture, precomputed: PrecomputedTransfer) -> Capture | None:
    """What the whites show in a capture's frames, under its light; None where that is too little."""
    rows, samples = whites.samples(capture.fitted)
    if not len(rows):
        return None
    points = whites.places.take(rows)
    transfer = precomputed.trace(points)
    return replace(capture, points=points, samples=samples, transfer=transfer, skin=np.zeros(len(rows), bool))
