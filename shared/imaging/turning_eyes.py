"""Eyeballs that turn in a mesh that does not: an eyeball is close to a ball, so its gaze moves no surface, only which
texel lies where.

What belongs to a place in head space stays there: where cameras see it, what covers it, the light that it gets. A texel
takes all of that from the place to which the gaze turns it, and a ray that meets the eyeball reads the texture at the
place from which the gaze turned what lies there. Eyeballs are no exact spheres; a direction from the centre has one
place on them all the same.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shared.geometry.eyeballs import Eyeball, eyeballs_of, gaze_rotation
from shared.geometry.mesh import Mesh, interpolate, normalised, tangent_frames
from shared.geometry.raycast import RAY_START_MM, RayScene
from shared.geometry.surface import Surface
from shared.imaging.image_sampling import SurfaceViewer, View
from shared.imaging.texels import FrameView, MovedTexels, TexelSurface

LID_MARGIN_MM = 1.0
"""What of an eyeball is so close to what covers it counts less or not: lids are off by that, and have lashes."""
LIDS = ("lids", "eye_sockets")


class TurningEyes:
    """The two eyeballs of a mesh: balls, right and left; side [F] int8: which of them a face belongs to, -1: none."""

    def __init__(self, mesh: Mesh, balls: tuple[Eyeball, Eyeball]):
        self.mesh, self.balls = mesh, balls
        self.side = np.full(len(mesh.faces), -1, np.int8)
        for k, ball in enumerate(balls):
            self.side[ball.faces] = k
        self._scenes = [RayScene(mesh.vertices, mesh.faces[ball.faces]) for ball in balls]

    @classmethod
    def of(cls, surface: Surface) -> TurningEyes | None:
        """Those of a head; None where its mesh has none."""
        balls = eyeballs_of(surface)
        return None if balls is None else cls(surface.mesh, balls)

    def directions(self, side: int, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        """[n, 3] unit: from the centre of an eyeball to places on its faces, face [n] int and corner weights bary
        [n, 3]."""
        return normalised(interpolate(self.mesh.vertices, self.mesh.faces, face, bary) - self.balls[side].centre)

    def place(self, side: int, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Face [n] int and corner weights [n, 3] of the places where unit directions [n, 3] from the centre of an
        eyeball meet it."""
        ball = self.balls[side]
        face, bary, _ = self._scenes[side].intersect(np.broadcast_to(ball.centre, directions.shape), directions)
        missed = np.nonzero(face < 0)[0]
        if len(missed):  # single precision slips through between two faces: the nearest vertex is next to the place
            corner = directions[missed] @ normalised(self.mesh.vertices[ball.vertices] - ball.centre).T
            at = self.mesh.faces[ball.faces] == ball.vertices[corner.argmax(1)][:, None, None]
            face[missed], bary[missed] = at.any(2).argmax(1), at[np.arange(len(missed)), at.any(2).argmax(1)]
        return ball.faces[face], bary

    def read_at(self, face: np.ndarray, bary: np.ndarray, gaze: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays that meet faces [n] (-1: none) with corner weights [n, 3] read the texture -> the same for it.

        gaze [2, 2] radians, right and left; NaN: that eye looks straight ahead, as a shut one has no gaze.
        """
        face, bary = face.copy(), bary.copy()
        owner = np.where(face >= 0, self.side[face], -1)
        for side in np.nonzero(np.isfinite(gaze).all(1))[0]:
            own = np.nonzero(owner == side)[0]
            if len(own):
                seen = self.directions(side, face[own], bary[own])
                face[own], bary[own] = self.place(side, seen @ gaze_rotation(gaze[side]))
        return face, bary


class EyeTexels:
    """The texels of a map that lie on the eyeballs: rows [E] of its surface, growing; side [E] int8 and directions
    [E, 3] unit from the centre, as the eye looks straight ahead.

    lids [F] bool: faces that cover nothing in frames whose lids are known from the picture, since lids move, and a
    mesh's are off.
    """

    def __init__(self, surface: TexelSurface, viewer: SurfaceViewer, eyes: TurningEyes, lids: np.ndarray):
        self.surface, self.viewer, self.eyes = surface, viewer, eyes
        self._but_lids = RayScene(eyes.mesh.vertices, eyes.mesh.faces[~lids & (eyes.side < 0)])
        self.rows = np.nonzero(eyes.side[surface.face] >= 0)[0]
        self.side = eyes.side[surface.face[self.rows]]
        self.directions = np.empty((len(self.rows), 3))
        for side in (0, 1):
            own = self.side == side
            rows = self.rows[own]
            self.directions[own] = eyes.directions(side, surface.face[rows], surface.bary[rows])

    def turned(self, frame: FrameView, view: View, gaze: np.ndarray, lids_px: np.ndarray | None = None) -> FrameView:
        """A frame with the eyeballs' texels where the gaze [2, 2] radians has turned them; of a shut eye, NaN, it shows
        none. view: the camera's of all vertices; lids_px [2, N, 2]: of each eye, see Views."""
        known = np.isfinite(gaze).all(1)
        if lids_px is not None:
            known &= np.isfinite(lids_px).all((1, 2))
        parts = [self._of_eye(side, frame, view, gaze[side], None if lids_px is None else lids_px[side])
                 for side in np.nonzero(known)[0]]
        nothing = np.empty(0, int), np.empty(0, int), np.empty((0, 3)), np.empty((0, frame.table.shape[1]), np.float32)
        moved = [np.concatenate(columns) for columns in zip(nothing, *parts, strict=True)]
        order = np.argsort(moved[0])
        still = np.setdiff1d(frame.rows, self.rows, assume_unique=True)
        return replace(frame, rows=np.sort(np.concatenate([still, moved[0]])),
                       moved=MovedTexels(*(column[order] for column in moved)))

    def _of_eye(
        self, side: int, frame: FrameView, view: View, gaze: np.ndarray, lids_px: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The fields of MovedTexels for what the frame shows of one eye."""
        viewer, faces, size = self.viewer, self.surface.mesh.faces, frame.picture.inside.shape[::-1]
        own = self.side == side
        rows, directions = self.rows[own], self.directions[own] @ gaze_rotation(gaze).T
        facing = directions @ view.towards_camera[self.eyes.balls[side].vertices].mean(0) > 0.0
        rows, (face, bary) = rows[facing], self.eyes.place(side, directions[facing])
        across, down, depth = interpolate(frame.table[:, :3], faces, face, bary).T
        pixels = np.stack([across, down], axis=1) / depth[:, None]
        weight = ((pixels > 1.0) & (pixels < np.subtract(size, 1.0))).all(1) & (depth > 0.0)
        if lids_px is not None:
            weight = weight & (pixels > lids_px.min(0)).all(1) & (pixels < lids_px.max(0)).all(1)
        rows, face, bary, pixels, depth = (values[weight] for values in (rows, face, bary, pixels, depth))
        cosine = interpolate(view.cosine, faces, face, bary)
        weight = np.where(cosine > viewer.least_cosine, np.square(cosine), 0.0)
        if lids_px is not None:
            inside_mm = depth_in_polygon(pixels, lids_px) * depth / frame.focal_length
            weight *= np.clip(inside_mm / LID_MARGIN_MM - 0.5, 0.0, 1.0)
        rows, face, bary, weight = (values[weight > 0.0] for values in (rows, face, bary, weight))
        normals = normalised(interpolate(viewer.normals, faces, face, bary))
        towards = normalised(interpolate(view.towards_camera, faces, face, bary))
        places = interpolate(self.surface.mesh.vertices, faces, face, bary) + RAY_START_MM * normals
        if lids_px is None:
            shown = ~self._covered(places, normals, towards)
        else:
            shown = ~self._but_lids.occluded(places, towards)
        values = interpolate(frame.table, faces, face[shown], bary[shown])
        values[:, 3] = weight[shown]
        return rows[shown], face[shown], bary[shown], values

    def _covered(self, places: np.ndarray, normals: np.ndarray, towards: np.ndarray) -> np.ndarray:
        """[n] bool: does something lie between the camera and a place, or what is within the margin about it."""
        covered = self.viewer.scene.occluded(places, towards)
        across = tangent_frames(normals)
        for step in (across[:, 0], -across[:, 0], across[:, 1], -across[:, 1]):
            left = np.nonzero(~covered)[0]
            covered[left] = self.viewer.scene.occluded(places[left] + LID_MARGIN_MM * step[left], towards[left])
        return covered


def depth_in_polygon(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """[n] distance of points [n, 2] from the border of a polygon [N, 2], its corners in order; negative outside."""
    start, along = polygon, np.roll(polygon, -1, axis=0) - polygon
    off = points[:, None] - start
    share = np.clip((off * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12), 0.0, 1.0)
    distance = np.linalg.norm(off - share[..., None] * along, axis=-1).min(1)
    across = (off[..., 1] < 0.0) != (off[..., 1] < along[:, 1])
    rise = np.where(along[:, 1] == 0.0, 1.0, along[:, 1])
    crossings = across & (off[..., 0] < off[..., 1] / rise * along[:, 0])
    return np.where(crossings.sum(1) % 2 == 1, distance, -distance)
