"""The lids of a fitted head laid where the clip shows them.

Hardly a track point lies on lids, and the face mesh's landmarks slide over them, so that a fitted head's margins come
out millimetres beside the picture's. The iris network's contours (shared.capture.iris) follow the margins, but end
before the outer corner; the face mesh's go beyond it: of open eyes their mean is taken. It steers the codes of the head
model as landmarks do; what the codes leave is taken up by sliding the margins over the eyeball, with the lids' skin and
the socket's following as a thin plate. At last lids that are open come to rest on the eyeballs where their openings
end (shared.tracking.lid_openings). Where an eye is shut in the whole clip both margins meet on the line of
shared.tracking.closing_line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree

from shared.capture.iris import FACE_MESH_LIDS, LOWER_LID, UPPER_LID
from shared.compute.sparse_solve import factorised
from shared.geometry.eyeballs import Eyeball, eyeballs_of
from shared.geometry.mesh import mesh_edges, normalised
from shared.tracking.closing_line import closing_line
from shared.tracking.fit_eyeballs import eye_centres
from shared.tracking.fit_head import HeadFit, Pins, landmarks_on_points, most_central
from shared.tracking.fit_surface import ThinPlate
from shared.tracking.head_model import HeadModel
from shared.tracking.lids import Lids
from shared.tracking.tracked_clip import TrackedClip

CONTOUR_FRAMES = 40
"""The contours are taken from so many frames with open eyes, around the middle of the motion."""
PIN_MM = 3.0
"""Deviation of a contour's point where it steers the codes; some thirty of them count as one or two."""
FRONT_EDGES = 3, 5
"""A lid's rim is so many edges deep, of the lower and of the upper lid: there its skin turns to the front."""
OPEN_BEHIND_MM = 1.0
"""Rims of shut lids meet at their front edges; behind them each is so far away from the line."""
RESTING_MM, RIM_MM, OUTSIDE_MM = 0.05, 0.8, (0.8, 0.25)
"""Inner edges that rest on an eyeball are so far from it. The edges that one sees are so far before the ball at least,
and so far outside of the inner ones, in the corners by the former, in the middle of the lower lid, whose rim is seen,
and of the upper, whose rim is not."""
LEAST_FORWARD = 0.2
"""A margin is so far before the eye's centre at least, as a share of its distance from it."""
HOLD = 100.0
"""Weight of the margins' places against the plate's bending."""


@dataclass(frozen=True, eq=False)
class LidMargins:
    """Where the lids end in the model: [eye][lower, upper], right eye first. loops: vertices of the inner edge, where
    the socket begins, from the outer to the inner corner, both included; fronts: vertices of the edge that one sees,
    and the share of the way from corner to corner at which each lies; rims: all from the one to the other, the former
    not included, with that share, both corners' too, and how far each is on the way to the latter, 0 to 1."""

    loops: tuple[tuple[np.ndarray, np.ndarray], ...]
    fronts: tuple[tuple[tuple[np.ndarray, np.ndarray], ...], ...]
    rims: tuple[tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...], ...]

    @classmethod
    def of(cls, model: HeadModel, splits: int = 0) -> LidMargins | None:
        """None where the model has no lids with sockets behind them. splits: how many times finer the model is than
        the one that is tracked with."""
        if not {"lids", "eye_sockets"} <= set(model.segment_names):
            return None
        edges, edge_of_face, _ = mesh_edges(model.faces)
        rim = edges[np.intersect1d(edge_of_face[model.segment("lids")], edge_of_face[model.segment("eye_sockets")])]
        right = model.template[rim[:, 0], 0] < 0
        loops = tuple(_halves(rim[own], model.template) for own in (right, ~right))
        lids = model.faces[model.segment("lids")]
        rims = tuple(_rims(halves, lids, model.template, 2**splits) for halves in loops)
        return cls(loops, tuple(tuple(map(_front_edge, both)) for both in rims), rims)


def _rims(
    halves: tuple[np.ndarray, np.ndarray], faces: np.ndarray, template: np.ndarray, times: int
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]:
    """Of both halves: vertices up to so many edges, times as many, away along faces [F, 3] that are nearer to this half
    than to the other, the share of the way at which the half's nearest vertex lies, and how many of the edges they are
    away, as a share."""
    rings = [np.unique(np.concatenate(halves))]
    reached = rings[0]
    for _ in range(times * max(FRONT_EDGES)):
        rings.append(np.setdiff1d(faces[np.isin(faces, reached).any(1)], reached))
        reached = np.union1d(reached, rings[-1])
    trees, found = [cKDTree(template[half, :2]) for half in halves], []
    for own, other, half, edges in zip(trees, trees[::-1], halves, FRONT_EDGES, strict=True):
        parts = []
        for k in range(1, times * edges + 1):
            (apart, at), (elsewhere, _) = (tree.query(template[rings[k], :2]) for tree in (own, other))
            chosen = apart < elsewhere
            parts.append((rings[k][chosen], at[chosen] / (len(half) - 1), np.full(chosen.sum(), k / (times * edges))))
        found.append(tuple(np.concatenate(column) for column in zip(*parts, strict=True)))
    return tuple(found)


def _front_edge(rim: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Of a rim's vertices, shares and places between its edges those of the front edge, but for the corners'."""
    vertices, share, forward = rim
    chosen = (forward == 1.0) & (share > 0.0) & (share < 1.0)
    return vertices[chosen], share[chosen]


def _halves(rim: np.ndarray, template: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A closed loop of edges [E, 2] -> its lower and upper half, from the corner farthest from the nose."""
    neighbours: dict[int, list[int]] = {}
    for a, b in rim.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    away = {vertex: abs(template[vertex, 0]) for vertex in neighbours}
    outer, inner = max(away, key=away.get), min(away, key=away.get)
    halves = []
    for following in neighbours[outer]:
        path = [outer, following]
        while path[-1] != inner:
            path.append(next(vertex for vertex in neighbours[path[-1]] if vertex != path[-2]))
        halves.append(np.array(path))
    return tuple(sorted(halves, key=lambda half: template[half, 1].mean()))


@dataclass(frozen=True)
class LidContours:
    """Where the clip shows the margins: points [2, 2, 9, 3] of the right and left eye's lower and upper lid, from the
    outer to the inner corner, NaN where the eye is not seen; shut [2] bool: in the whole clip, the two are one then."""

    points: np.ndarray
    shut: np.ndarray

    def scaled(self, factor: float) -> LidContours:
        """Of a head that is larger by a factor."""
        return replace(self, points=factor * self.points)

    def moved(self, fit: HeadFit) -> LidContours:
        """From track space to head space."""
        return replace(self, points=fit.to_head(self.points.reshape(-1, 3)).reshape(self.points.shape))


def lid_contours(
    clip: TrackedClip, lids: Lids, camera_from_points: np.ndarray, track_points: np.ndarray, down: np.ndarray
) -> LidContours:
    """Of a clip whose eyes were looked for, in the space of its track_points [N, 3] and at their depth. lids: its own;
    camera_from_points [F, 4, 4]; down [3]: a millimetre down the face in that space."""
    central = most_central(camera_from_points)
    found, shut = np.full((2, 2, len(LOWER_LID), 3), np.nan), np.zeros(2, bool)
    for eye in range(2):
        seen = np.isfinite(clip.lids_px[:, eye]).all((1, 2))
        shut[eye] = seen.any() and lids.shut[seen, eye].all()
        use = central[(seen & (lids.shut[:, eye] == shut[eye]))[central]][:CONTOUR_FRAMES]
        if len(use):
            poses = camera_from_points[use]
            lids_px = clip.lids_px[use, eye]
            if not shut[eye]:
                lids_px = 0.5 * (lids_px + clip.landmarks_px[use][:, FACE_MESH_LIDS[eye]])
            margin = landmarks_on_points(lids_px, poses, track_points, clip.intrinsics)
            found[eye] = margin[list(LOWER_LID)], margin[list(UPPER_LID)]
            if shut[eye]:
                pictures = [clip.contrast[i] for i in use]
                found[eye] = closing_line(pictures, found[eye, 0], down, poses, clip.intrinsics)
    return LidContours(found, shut)


def lid_pins(margins: LidMargins, vertices: np.ndarray, contours: LidContours) -> Pins:
    """The contours' points (track space) with their places on the margins: at the same share of the way from corner to
    corner; vertices [V, 3] of a rough fit."""
    points, ends, shares = [], [], []
    for loops, shown in zip(margins.loops, contours.points, strict=True):
        for loop, curve in zip(loops, shown, strict=True):
            if np.isfinite(curve).all():
                place = np.interp(_way(curve), _way(vertices[loop]), np.arange(len(loop)))
                first = np.minimum(place.astype(int), len(loop) - 2)
                points.append(curve)
                ends.append(np.stack([loop[first], loop[first + 1]], axis=1))
                shares.append(place - first)
    if not points:
        return Pins(np.zeros((0, 3)), np.zeros((0, 2), int), np.zeros(0), PIN_MM)
    return Pins(np.concatenate(points), np.concatenate(ends), np.concatenate(shares), PIN_MM)


def lay_lids(plate: ThinPlate, margins: LidMargins, vertices: np.ndarray, contours: LidContours) -> np.ndarray:
    """Vertices [V, 3] with the margins on the contours (head space); nothing but lids and sockets moves."""
    held, targets = [], []
    for eye, (centre, shown) in enumerate(zip(eye_centres(plate.model, vertices), contours.points, strict=True)):
        if np.isfinite(shown).all():
            if contours.shut[eye]:
                own, places = _shut(margins, eye, vertices, shown[0], centre)
            else:
                own, places = _open(margins.loops[eye], vertices, shown, centre)
            held.append(own)
            targets.append(places)
    if not held:
        return vertices
    return vertices + followed(plate, held, [places - vertices[own] for own, places in zip(held, targets, strict=True)])


def lay_on_balls(plate: ThinPlate, margins: LidMargins, vertices: np.ndarray, openings: LidContours) -> np.ndarray:
    """Vertices [V, 3] whose lids leave open of the eyeballs what the openings (head space) do: inner edges rest on the
    eyeballs there, and the edges that one sees lie a little outside; nothing but lids and sockets moves."""
    held, targets = [], []
    for eye, (ball, shown) in enumerate(zip(eyeballs_of(plate.model.surface(vertices)), openings.points, strict=True)):
        if np.isfinite(shown).all():
            own, places = _resting(margins, eye, vertices, shown, ball)
            held.append(own)
            targets.append(places)
    if not held:
        return vertices
    return vertices + followed(plate, held, [places - vertices[own] for own, places in zip(held, targets, strict=True)])


def _resting(
    margins: LidMargins, eye: int, vertices: np.ndarray, shown: np.ndarray, ball: Eyeball
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [n] and their places [n, 3]: inner edges on the ball along the curves shown [2, n, 3], front edges
    outside of them and before the ball."""
    held, places = [], []
    across = normalised((shown[0, -1] - shown[0, 0])[None, :2])[0]
    up = np.array([-across[1], across[0]]) * np.sign(across[0])
    for sign, outside, loop, (rim, share, forward), curve in zip(
        (-1.0, 1.0), OUTSIDE_MM, margins.loops[eye], margins.rims[eye], shown, strict=True
    ):
        way, radius = _way(vertices[loop]), ball.radius + RESTING_MM
        held += [loop, rim]
        places.append(_on_curve(way, curve, ball.centre, np.full(len(loop), radius)))
        turn = np.pi * share[:, None]
        away = np.sin(turn) * sign * up - np.cos(turn) * across
        off = (RIM_MM + (outside - RIM_MM) * np.sin(turn)) * away * forward[:, None]
        length = np.maximum(np.linalg.norm(vertices[rim] - ball.centre, axis=1), radius + RIM_MM * forward)
        places.append(_on_curve(share, curve, ball.centre, length, off))
    return np.concatenate(held), np.concatenate(places)


def _open(
    loops: tuple[np.ndarray, np.ndarray], vertices: np.ndarray, shown: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [n] and their places [n, 3]: both loops on their contours [2, 9, 3]."""
    places = [
        _on_curve(_way(vertices[loop]), curve, centre, np.linalg.norm(vertices[loop] - centre, axis=1))
        for loop, curve in zip(loops, shown, strict=True)
    ]
    return np.concatenate(loops), np.concatenate(places)


def _shut(
    margins: LidMargins, eye: int, vertices: np.ndarray, line: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [n] and their places [n, 3]: the front edges of both lids meet on the line [9, 3], and their rims part
    behind it."""
    held, places, shares = [], [], np.linspace(0.0, 1.0, 33)
    profiles = [_profile(shares, share, np.linalg.norm(vertices[own] - centre, axis=1)) for own, share in
                margins.fronts[eye]]  # fmt: skip
    depth = np.mean(profiles, axis=0)
    for sign, loop, (front, share) in zip((-1.0, 1.0), margins.loops[eye], margins.fronts[eye], strict=True):
        held += [front, loop]
        places.append(_on_curve(share, line, centre, np.interp(share, shares, depth)))
        way = _way(vertices[loop])
        away = np.column_stack([np.zeros(len(way)), sign * OPEN_BEHIND_MM * np.sqrt(np.sin(np.pi * way))])
        places.append(_on_curve(way, line, centre, np.linalg.norm(vertices[loop] - centre, axis=1), away))
    return np.concatenate(held), np.concatenate(places)


def _profile(shares: np.ndarray, share: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Radius [n] at a share [n] of the way, at even shares [m]."""
    order = np.argsort(share)
    return np.interp(shares, share[order], radius[order])


def _on_curve(
    way: np.ndarray, curve: np.ndarray, centre: np.ndarray, radius: np.ndarray, off: np.ndarray | float = 0.0
) -> np.ndarray:
    """Places [n, 3] at shares way [n] of a curve [m, 3], off it by [n, 2] mm, as seen from the front, and as far as
    radius [n] from the eye's centre [3]."""
    target = PchipInterpolator(_way(curve), curve[:, :2])(way) + off
    across = np.square(target - centre[:2]).sum(1)
    forward = np.sqrt(np.maximum(radius**2 - across, np.square(LEAST_FORWARD * radius)))
    return np.column_stack([target, centre[2] + forward])


def _way(line: np.ndarray) -> np.ndarray:
    """[n] share of the way along a line [n, 3] of points, seen from the front."""
    way = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))]
    return way / way[-1]


def followed(plate: ThinPlate, held: Sequence[np.ndarray], moves: Sequence[np.ndarray]) -> np.ndarray:
    """Displacements [V, 3]: of held vertices, in parts [n] each, near their moves [n, 3], of lids and sockets as a
    plate, none elsewhere. A vertex of several parts moves as the first of them says."""
    held, first = np.unique(np.concatenate(held), return_index=True)
    moves, model = np.concatenate(moves)[first], plate.model
    soft = model.segment("lids", "eye_sockets")
    free = np.setdiff1d(np.unique(model.faces[soft]), np.unique(model.faces[~soft]))
    place = np.full(len(model.template), -1)
    place[free] = np.arange(len(free))
    own, moves = place[held[place[held] >= 0]], moves[place[held] >= 0]
    pull = sparse.csr_matrix((np.full(len(own), HOLD), (own, own)), shape=(len(free), len(free)))
    wanted = np.zeros((len(free), 3))
    wanted[own] = HOLD * moves
    moved = np.zeros(model.template.shape)
    moved[free] = factorised((plate.bending[free][:, free] + pull).tocsc()).solve(wanted)
    return moved


