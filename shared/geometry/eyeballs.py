"""Where the eyeballs are in a head's mesh, and how they turn: gaze as yaw and pitch in head space.

Gaze [..., 2] is in radians: yaw towards +x (the viewer's right), pitch towards +y (up), both 0 straight ahead along +z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.geometry.mesh import Mesh, normalised
from shared.geometry.surface import Surface

SIDES = ("right", "left")
"""Of the head itself; the right eye is on the side of -x. Whatever holds both eyes has them in this order."""

IRIS_MM = 5.85
"""Radius of the visible iris in adults."""
EYE_RADIUS_MM = 12.0
"""Of an adult's eyeball [Bekerman2014]."""
TEAR_FILM_IOR, EYE_ROUGHNESS = 1.376, 0.08
"""Index of refraction of the cornea, which its tear film makes smooth, and that smoothness as a material has it."""


@dataclass(frozen=True, eq=False)
class Eyeball:
    """A part of the mesh that is close to a sphere: vertices [n] and faces [m] int of that mesh, centre [3] and radius
    in mm."""

    vertices: np.ndarray
    faces: np.ndarray
    centre: np.ndarray
    radius: float


def gaze_between(gaze: np.ndarray) -> np.ndarray:
    """Gaze [F, 2, 2] of frames in order, NaN where an eye is shut or not seen -> as the frames before and after have it
    there, and as the other eye has it where one is never seen; NaN where neither is."""
    filled, known = np.array(gaze, np.float64), np.isfinite(gaze).all(2)
    for side in np.nonzero(known.any(0))[0]:
        frames = np.nonzero(known[:, side])[0]
        filled[:, side] = np.stack([np.interp(np.arange(len(gaze)), frames, values) for values in
                                    gaze[frames, side].T], axis=1)  # fmt: skip
    return np.where(known.any(0)[:, None], filled, filled[:, ::-1])


def pitch_from_rest(gaze: np.ndarray) -> np.ndarray:
    """[F, 2] radians: how far both eyes' gaze [F, 2, 2], see gaze_between, is up from the middle of what is known of
    it, where a clip's lids are at rest; 0 where nothing is."""
    known = np.isfinite(gaze).all((1, 2))
    if not known.any():
        return np.zeros(gaze.shape[:2])
    pitch = gaze_between(gaze)[:, :, 1].mean(1)
    return np.repeat(pitch[:, None] - np.median(pitch[known]), 2, axis=1)


def eyeballs_of(surface: Surface) -> tuple[Eyeball, Eyeball] | None:
    """The right and the left eyeball of a head; None where the mesh has no segment `eyes`, or not one on each side."""
    if surface.face_segment is None or "eyes" not in surface.segment_names:
        return None
    faces = np.nonzero(surface.faces_of(("eyes",)))[0]
    corners = surface.mesh.faces[faces]
    right = surface.mesh.vertices[corners[:, 0], 0] < 0
    if not right.any() or right.all():
        return None
    return tuple(fit_eyeball(surface.mesh, faces[own]) for own in (right, ~right))


def fit_eyeball(mesh: Mesh, faces: np.ndarray) -> Eyeball:
    """The eyeball that faces [m] int of the mesh are."""
    own = np.unique(mesh.faces[faces])
    centre, radius = fit_sphere(mesh.vertices[own])
    return Eyeball(own, faces, centre, radius)


def fit_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre [3] and radius of the sphere nearest to points [N, 3] in the algebraic sense: 2 c x + r^2 - c^2 = x^2."""
    middle = points.mean(0)
    around = points - middle
    system = np.column_stack([2.0 * around, np.ones(len(around))])
    *centre, rest = np.linalg.lstsq(system, np.square(around).sum(1), rcond=None)[0]
    return middle + centre, float(np.sqrt(rest + np.dot(centre, centre)))


def gaze_direction(gaze: np.ndarray) -> np.ndarray:
    """Gaze [..., 2] -> unit directions [..., 3] in head space."""
    yaw, pitch = gaze[..., 0], gaze[..., 1]
    return np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=-1)


def gaze_towards(direction: np.ndarray) -> np.ndarray:
    """Directions [..., 3] in head space, of any length -> gaze [..., 2]; the inverse of gaze_direction."""
    x, y, z = np.moveaxis(direction, -1, 0)
    return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1)


def gaze_shown(ball: Eyeball, irises: np.ndarray, cameras: np.ndarray) -> np.ndarray:
    """Gaze [F, 2] with which a mesh's eyeball shows an iris where cameras see it: a fitted head's eyeball is some
    millimetres off in centre and size, which an iris' place need not follow.

    irises [F, 3], cameras [F, 3]: places of both in head space, mm. Where the line of sight passes by the eyeball: its
    point nearest to it.
    """
    sight = normalised(irises - cameras)
    away = ball.centre - cameras
    nearest = (away * sight).sum(-1, keepdims=True)
    beside = (away**2).sum(-1, keepdims=True) - nearest**2
    front = np.sqrt(np.maximum(ball.radius**2 - beside, 0.0))
    return gaze_towards((nearest - front) * sight - away)


def gaze_rotation(gaze: np.ndarray) -> np.ndarray:
    """Gaze [..., 2] -> [..., 3, 3], which turns +z to it: pitch about x, then yaw about y. Eyes roll by less than these
    angles say (Listing's law), which a centred iris does not show."""
    yaw, pitch = gaze[..., 0], gaze[..., 1]
    sy, cy, sp, cp = np.sin(yaw), np.cos(yaw), np.sin(pitch), np.cos(pitch)
    zero = np.zeros_like(yaw)
    rows = [[cy, -sy * sp, sy * cp], [zero, cp, sp], [-sy, -cy * sp, cy * cp]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
