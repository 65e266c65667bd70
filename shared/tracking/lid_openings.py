"""What the lids leave open of each eyeball, told by what moves: the eye turns under lids that stay with the head.

The contours of the iris network lie half a millimetre inside the lower margin of some eyes and go two or three beyond
the visible eyeball at its inner corner; lashes draw the upper one up. Where the gaze moves against the head, as it does
when who films oneself looks into the lens, pictures tell themselves: a place that is skin looks alike in all frames of
the head, a place of the eyeball looks as the mean picture of the eyeball (shared.tracking.iris_texture) does where the
gaze has turned it. What misfits either by how much, in the log-likelihood of a Cauchy distribution, is weighed against
the distance from the network's contour, which holds where nothing moves. Two motions as competing explanations of each
place: [Wang1994].
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from shared.capture.iris import LOWER_LID, UPPER_LID, SeenEyes
from shared.geometry.eyeballs import Eyeball, eyeballs_of
from shared.geometry.mesh import normalised
from shared.geometry.raycast import RayScene
from shared.geometry.surface import Surface
from shared.geometry.transforms import camera_centres
from shared.tracking.fit_lids import LidContours
from shared.tracking.gaze import Gaze
from shared.tracking.iris_texture import EyeView, ViewedBall, eyeball_views
from shared.tracking.lids import Lids

LARGEST_PIXEL_MM = 1.0
"""At the eye: of larger pixels an opening has some five rows, which tell no margin."""
LEAST_FRAMES, FRAMES = 8, 60
"""Frames with open eyes that tell an opening, at least and at most."""
OPEN, PITCH = 0.85, np.radians(4.0)
"""Lids stand as in most frames where the aperture is such a share of the clip's open eyes and the gaze is no farther up
or down from its median."""
REACH_MM, STEP_MM = (19.0, 11.0), 0.25
"""The raster of places about an eye: half of its width and height, and its step."""
LID_MM, ON_BALL, BEFORE_MM = 0.5, 0.97, 100.0
"""A lid's thickness at its margin; share of an eyeball's radius within which it is seen from the front; from where rays
start."""
LEAST_NOISE, NOISES = 6.0, 1.5
"""Codes by which skin and eyeball may differ from their means, at least and in deviations of the eyeball's."""
STILL = 0.6
"""Of the misfit: where the eyeball's picture is not known, skin may move by so much more than eyeballs usually do."""
LARGEST = 2.0
"""Of the evidence of one place: outliers say no more."""
LASHES_MM = 0.7
"""The network draws the upper contour along the lashes, so far above the lid's edge."""
PER_MM = 0.5
"""Evidence that outweighs a millimetre from the network's contour."""
BEYOND_MM = 1.5
"""So far beyond the network's contour nothing is open: what moves there are mirror images in glasses, or hair."""
SMOOTH_MM = 0.4
SEEN_SHARE, WELL_SEEN_SHARE = 0.15, 0.5
"""Of the frames: places that fewer show with both explanations are judged by the skin's alone."""
POINTS = 17


@dataclass(frozen=True, eq=False)
class _Raster:
    """Places about an eye, seen from the front: across [3] and up [3] unit, from the outer to the inner corner and
    towards the brow; columns [w] and rows [h] mm along them, from the middle [3] of the network's contour; outline
    [16, 2] of that contour in these."""

    middle: np.ndarray
    across: np.ndarray
    up: np.ndarray
    columns: np.ndarray
    rows: np.ndarray
    outline: np.ndarray

    @classmethod
    def about(cls, contour: np.ndarray) -> _Raster:
        """Of the network's contour [16, 3] in head space."""
        outer, inner = contour[0], contour[8]
        across = normalised(((inner - outer) * [1.0, 1.0, 0.0])[None])[0]
        up = np.array([-across[1], across[0], 0.0]) * np.sign(across[0])
        middle, contour = 0.5 * (outer + inner), contour.copy()
        contour[list(UPPER_LID[1:-1])] -= LASHES_MM * up
        outline = (contour - middle)[[*LOWER_LID, *UPPER_LID[-2:0:-1]]] @ np.stack([across, up], axis=1)
        columns, rows = (STEP_MM * np.arange(-round(reach / STEP_MM), round(reach / STEP_MM) + 1) for reach in REACH_MM)
        return cls(middle, across, up, columns, rows, outline)

    def places(self) -> np.ndarray:
        """[h w, 3] at the middle's depth."""
        flat = self.columns[:, None] * self.across + self.rows[:, None, None] * self.up
        return self.middle + flat.reshape(-1, 3)

    def inside(self) -> np.ndarray:
        """[h, w] bool: what the contour encloses."""
        filled = np.zeros((len(self.rows), len(self.columns)), np.uint8)
        corner = [self.columns[0], self.rows[0]]
        cv2.fillPoly(filled, [np.rint(16.0 * (self.outline - corner) / STEP_MM).astype(np.int32)], 1, shift=4)
        return filled > 0


def lid_openings(
    surface: Surface, seen: SeenEyes, lids: Lids, gaze: Gaze, camera_from_head: np.ndarray, intrinsics: np.ndarray
) -> LidContours:
    """Where both lids of each eye end on the eyeball, in head space; NaN for an eye of which too few frames, or too
    large pixels, tell.

    surface: the head as fitted; seen: eyes of F frames, with pictures; camera_from_head [F, 4, 4]; intrinsics [3, 3].
    """
    points, eyeballs = np.full((2, 2, POINTS, 3), np.nan), eyeballs_of(surface)
    if eyeballs is None:
        return LidContours(points, np.zeros(2, bool))
    for side, frames, ball, views in eyeball_views(
        seen, gaze.gaze, gaze.centres, gaze.iris_distance_mm, camera_from_head, intrinsics
    ):
        chosen = _frames_at_rest(gaze.gaze[frames, side], lids.openness[frames, side], lids.shut[frames, side])
        if len(chosen) < LEAST_FRAMES or ball.pixel_mm > LARGEST_PIXEL_MM:
            continue
        views, own = [views[k] for k in chosen], gaze.gaze[frames[chosen], side]
        contour = _network_contour(seen.lids_px[frames[chosen], side], camera_from_head[frames[chosen]], intrinsics,
                                   eyeballs[side])
        raster = _Raster.about(contour)
        evidence = _evidence(views, own, ball, _seen_places(surface, raster, eyeballs[side]), raster)
        curves = _margins(evidence, raster)
        if curves is not None:
            points[side] = raster.middle + curves[..., :1] * raster.across + curves[..., 1:] * raster.up
            points[side, ..., 2] = _front(eyeballs[side], points[side])
    return LidContours(points, np.zeros(2, bool))


def _frames_at_rest(gaze: np.ndarray, openness: np.ndarray, shut: np.ndarray) -> np.ndarray:
    """Indices of frames whose lids stand as in most: gaze [K, 2], openness [K], shut [K] bool."""
    pitch = gaze[:, 1]
    rest = ~shut & (openness > OPEN)
    if not rest.any():
        return np.empty(0, int)
    chosen = np.nonzero(rest & (np.abs(pitch - np.median(pitch[rest])) < PITCH))[0]
    return chosen[np.unique(np.linspace(0, len(chosen) - 1, FRAMES).round().astype(int))] if len(chosen) else chosen


def _network_contour(
    lids_px: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray, ball: Eyeball
) -> np.ndarray:
    """[16, 3] mm: the median over the frames of where the lines of sight of lids_px [K, 16, 2] meet the eyeball, or
    pass it nearest."""
    sight = np.concatenate([(lids_px - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]],
                            np.ones((*lids_px.shape[:2], 1))], axis=2)
    sight = normalised(sight @ camera_from_head[:, :3, :3])
    away = (ball.centre - camera_centres(camera_from_head))[:, None]
    nearest = (away * sight).sum(-1, keepdims=True)
    front = np.sqrt(np.maximum((ball.radius + LID_MM) ** 2 - (away**2).sum(-1, keepdims=True) + nearest**2, 0.0))
    return ball.centre + np.median((nearest - front) * sight - away, axis=0)


def _seen_places(surface: Surface, raster: _Raster, ball: Eyeball) -> np.ndarray:
    """The raster's places [h w, 3] on what is seen there from the front: the mesh's skin, but no farther before the
    eyeball than a lid is thick, since the lids of the mesh may cover too much."""
    mesh, places = surface.mesh, raster.places()
    skin = mesh.faces[~surface.faces_of(("eyes", "eye_sockets"))]
    start, forward = places + [0.0, 0.0, BEFORE_MM], np.array([0.0, 0.0, -1.0])
    face, _, distance = RayScene(mesh.vertices, skin).intersect(start, np.broadcast_to(forward, start.shape))
    depth = np.where(face >= 0, start[:, 2] - np.where(face >= 0, distance, 0.0), np.inf)
    front = _front(ball, places)
    on_ball = np.linalg.norm((places - ball.centre)[:, :2], axis=1) < ON_BALL * ball.radius
    known = np.minimum(depth, np.where(on_ball, front + LID_MM, np.inf))
    return np.column_stack([places[:, :2], np.where(np.isfinite(known), known, front)])


def _front(ball: Eyeball, places: np.ndarray) -> np.ndarray:
    """[...] mm: depth at which an eyeball is seen from the front at places [..., 3]; its centre's beside it."""
    across = np.square((places - ball.centre)[..., :2]).sum(-1)
    return ball.centre[2] + np.sqrt(np.maximum(ball.radius**2 - across, 0.0))


def _evidence(
    views: list[EyeView], gaze: np.ndarray, ball: ViewedBall, places: np.ndarray, raster: _Raster
) -> np.ndarray:
    """[h, w]: below 0 where the frames say eyeball, above 0 where they say lid, against the network's contour."""
    inside, shape = raster.inside(), (len(raster.rows), len(raster.columns))
    off, noise = ball.off_mean(views, gaze, places)
    still = _off_still(views, ball, places, inside.ravel())
    scale = max(LEAST_NOISE, NOISES * noise) if np.isfinite(noise) else LEAST_NOISE
    turns, stays = np.log1p(np.square(off / scale)), np.log1p(np.square(still / scale))
    both = np.isfinite(turns) & np.isfinite(stays)
    share = both.mean(0)
    compared = _mean(np.where(both, turns - stays, np.nan))
    known = share > SEEN_SHARE
    core = known & inside.ravel()
    usual = float(np.median(_mean(np.where(both, turns, np.nan))[core])) if core.any() else 0.0
    alone = np.where(np.isfinite(stays).mean(0) > SEEN_SHARE, usual + STILL - _mean(stays), 0.0)
    blend = np.where(known, np.minimum(share / WELL_SEEN_SHARE, 1.0), 0.0)
    said = np.clip(blend * compared + (1.0 - blend) * alone, -LARGEST, LARGEST).reshape(shape)
    apart = _signed_distance(inside)
    evidence = ndimage.gaussian_filter(said, SMOOTH_MM / STEP_MM) + PER_MM * apart
    return np.where(apart > BEYOND_MM, np.maximum(evidence, LARGEST), evidence)


def _off_still(views: list[EyeView], ball: ViewedBall, places: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """[K, N]: by how much each frame differs at places [N, 3] from the median over the frames, under a gain of
    each frame that the skin beside the eye says; NaN where it does not show them. inside [N] bool: the eye."""
    light = np.full((len(views), len(places)), np.nan)
    for k, view in enumerate(views):
        seen, shown = view.brightness(ball.pixels(places, view))
        light[k, shown] = seen[shown]
    middle = _median(light)
    beside = ~inside & np.isfinite(middle)
    gain = np.array([_median((own[beside] / np.maximum(middle[beside], 1.0))[:, None])[0] for own in light])
    light /= np.where(np.isfinite(gain), gain, 1.0)[:, None]
    return light - _median(light)


def _margins(evidence: np.ndarray, raster: _Raster) -> np.ndarray | None:
    """[2, POINTS, 2] mm along the raster: lower and upper border of what is below 0 about the network's contour, from
    the outer to the inner corner; None where nothing is."""
    diamond = ndimage.iterate_structure(ndimage.generate_binary_structure(2, 1), 3)
    open_here = ndimage.binary_fill_holes(_largest_part(evidence < 0.0, raster.inside()))
    open_here = _largest_part(ndimage.binary_opening(open_here, diamond), raster.inside())
    columns = np.nonzero(open_here.any(0))[0]
    if len(columns) < POINTS:
        return None
    first = open_here[:, columns].argmax(0)
    last = len(raster.rows) - 1 - open_here[::-1, columns].argmax(0)
    lower, upper = (_crossing(evidence[:, columns], row, step, raster.rows) for row, step in ((first, -1), (last, 1)))
    way = raster.columns[columns]
    lower, upper = (ndimage.gaussian_filter1d(curve, SMOOTH_MM / STEP_MM, mode="nearest") for curve in (lower, upper))
    ends = 0.5 * (lower + upper)[[0, -1]]
    places = way[0] + (way[-1] - way[0]) * 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, POINTS)))
    curves = []
    for curve, outward in ((lower, -1.0), (upper, 1.0)):
        heights = outward * _bowed(places, way, outward * curve)
        heights[[0, -1]] = ends
        curves.append(np.column_stack([places, heights]))
    return np.stack(curves)


def _largest_part(mask: np.ndarray, within: np.ndarray) -> np.ndarray:
    """[h, w] bool: the connected part of a mask [h, w] bool that fills most of `within` [h, w] bool; empty where none
    does."""
    labels, _ = ndimage.label(mask)
    own = labels[within & mask]
    return labels == np.bincount(own).argmax() if len(own) else np.zeros_like(mask)


def _crossing(evidence: np.ndarray, row: np.ndarray, step: int, rows: np.ndarray) -> np.ndarray:
    """Heights [w] at which evidence [h, w] crosses 0 between each column's row [w] and the next one by step; halfway
    where it does not, as where the opening was made smoother."""
    column, beyond = np.arange(len(row)), np.clip(row + step, 0, len(rows) - 1)
    here, there = evidence[row, column], evidence[beyond, column]
    share = np.where((here < 0.0) & (there > 0.0), -here / np.maximum(there - here, 1e-9), 0.5)
    return rows[row] + share * (rows[beyond] - rows[row])


def _bowed(places: np.ndarray, way: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """[n] at growing places [n]: the lowest curve over heights [w] at growing way [w] that bends down all along, as
    lids do; where little moves, in the corners, evidence alone would dent it."""
    hull: list[int] = []
    for k in range(len(way)):
        while len(hull) > 1 and (way[hull[-1]] - way[hull[-2]]) * (heights[k] - heights[hull[-2]]) >= (
            heights[hull[-1]] - heights[hull[-2]]
        ) * (way[k] - way[hull[-2]]):
            hull.pop()
        hull.append(k)
    return np.interp(places, way[hull], heights[hull])


def _signed_distance(inside: np.ndarray) -> np.ndarray:
    """[h, w] mm from the border of inside [h, w] bool, negative within."""
    to_inside, to_outside = ndimage.distance_transform_edt(~inside), ndimage.distance_transform_edt(inside)
    return STEP_MM * np.where(inside, 0.5 - to_outside, to_inside - 0.5)


def _mean(values: np.ndarray) -> np.ndarray:
    """[N] over rows of values [K, N], NaN left out; 0 where all are."""
    known = np.isfinite(values)
    return np.where(known, values, 0.0).sum(0) / np.maximum(known.sum(0), 1)


def _median(values: np.ndarray) -> np.ndarray:
    """[N] over rows of values [K, N], NaN left out; NaN where all are."""
    found, known = np.full(values.shape[1], np.nan), np.isfinite(values).any(0)
    if known.any():
        found[known] = np.nanmedian(values[:, known], axis=0)
    return found
