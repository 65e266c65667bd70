"""Irises followed by their own texture: what the iris network says of an eye that looks aside or down is corrected.

The network puts irises that look aside up to a quarter too near to the middle of the lids, and those that a lid half
hides too far from it. What is seen of an eyeball in all frames, laid over each other as the gaze turns it, gives a
mean picture of iris and white; each frame's gaze is then moved until the frame agrees with it (Gauss-Newton steps on
the brightness, [Baker2004]), and the mean is made anew. Only what lies within the lids counts, and what differs from
the mean by much, like lids, lashes and catchlights, counts little. What the network is off by in all frames alike the
last mean tells, in which the irises' rims are plain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from shared.capture.iris import LOWER_LID, UPPER_LID, EyePicture, SeenEyes
from shared.compute.robust import ROBUST_SCALE, cauchy_weight
from shared.geometry.atlas import sample
from shared.geometry.eyeballs import gaze_rotation
from shared.geometry.mesh import normalised
from shared.geometry.transforms import camera_centres, project, projection_slope
from shared.tracking.iris_rim import MeanPicture, fit_rims

REACH_MM, LEAST_SPACING_MM, SPACING_PX = 8.5, 0.35, 0.7
"""Of the mean picture about the iris' centre; between its samples, at least and in pixels."""
BLUR_PX = 0.5
LID_MM = 2.0
"""From the lids' margins: a sample that lies nearer counts less, since their shadow moves with them."""
LEAST_FACING = 0.3, 0.6
"""Cosine at which the eyeball's surface begins to count, and from which on it does in full."""
ROUNDS, STEP = 6, 1.7
"""Times that all frames are moved, by so much of a Gauss-Newton step: the mean, made of frames that lie apart, holds
each one back."""
OUTLIER = 1.7
"""Deviations beyond which a sample loses its pull."""
CORRELATED_MM = 2.6
"""Across: so large an area of what a frame differs by counts as one sample, since shading and lids are behind it."""
NETWORK_SIGMA = np.radians(4.0)
"""How far the network's gaze may be off."""
MEANS, LEAST_NOISE = 4, 1.0
"""Times that the mean is made anew as outliers lose their pull; deviation of brightness at best, 8-bit codes."""
HOLDS_GAIN = 100.0
"""Codes squared by which the mean must vary where a frame sees it, for its gain to be its own."""
LARGEST_STEP = np.radians(3.0)
LEAST_SEEN, WELL_SEEN, WELL_KNOWN = 0.15, 0.5, 0.3
"""Of what the best seen sample is seen: what is seen less has no mean, and what is seen more a good one. Share of a
good one from which on places are compared with it."""


@dataclass(frozen=True, eq=False)
class EyeView:
    """A frame's view of an eye: layers [h, w, 4] float32: its brightness in 8-bit codes, the slopes of that along x and
    y, and how much a pixel lies within the lids, 0 to 1; corner [2] px; pose [4, 4]; camera [3] in head space."""

    layers: np.ndarray
    corner: np.ndarray
    pose: np.ndarray
    camera: np.ndarray

    def brightness(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Brightness [N] at pixels [N, 2] of the frame, and whether they lie in this cut-out of it, [N] bool."""
        within = pixels - self.corner
        inside = ((within > 0.5) & (within < np.array(self.layers.shape[1::-1]) - 0.5)).all(1)
        return sample(np.ascontiguousarray(self.layers[..., 0]), within[None])[0], inside


def follow_irises(
    seen: SeenEyes,
    gaze: np.ndarray,
    centres: np.ndarray,
    distance_mm: float,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
) -> np.ndarray:
    """Irises [F, 2, 5, 2] px moved to where their texture is seen; as they were where gaze [F, 2, 2] is NaN.

    seen: eyes of F frames, with pictures; gaze [F, 2, 2] radians, centres [2, 3] mm and distance_mm as solved from its
    irises (shared.tracking.gaze); camera_from_head [F, 4, 4]; intrinsics [3, 3].
    """
    followed = seen.iris_px.copy()
    for side, frames, ball, eyes in eyeball_views(seen, gaze, centres, distance_mm, camera_from_head, intrinsics):
        turned = ball.aligned(eyes, gaze[frames, side])
        now = ball.shown(np.array([0.0, 0.0, distance_mm]), turned, camera_from_head[frames])
        followed[frames, side] += (now - followed[frames, side, 0])[:, None]
    return followed


def lay_on_rims(
    seen: SeenEyes,
    gaze: np.ndarray,
    centres: np.ndarray,
    distance_mm: float,
    radius_mm: float,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
) -> np.ndarray:
    """Irises [F, 2, 5, 2] px whose circles are moved and grown, by the same in all frames, to where the mean pictures
    show them, see shared.tracking.iris_rim.

    radius_mm: what the circles have now; seen, gaze [F, 2, 2] radians, centres [2, 3] mm, distance_mm,
    camera_from_head [F, 4, 4] and intrinsics [3, 3] as in follow_irises."""
    laid = seen.iris_px.copy()
    balls = list(eyeball_views(seen, gaze, centres, distance_mm, camera_from_head, intrinsics))
    pictures = [ball.mean_picture(eyes, gaze[frames, side]) for side, frames, ball, eyes in balls]
    known = [k for k, picture in enumerate(pictures) if picture is not None]
    if not known:
        return laid
    rims, rim_mm = fit_rims([pictures[k] for k in known], radius_mm)
    ahead = np.array([0.0, 0.0, distance_mm])
    for k, (across, up) in zip(known, rims, strict=True):
        side, frames, ball, _ = balls[k]
        beside = np.array([across, up, np.sqrt(distance_mm**2 - across**2 - up**2)])
        poses = camera_from_head[frames]
        step = ball.shown(beside, gaze[frames, side], poses) - ball.shown(ahead, gaze[frames, side], poses)
        irises = laid[frames, side]
        grown = irises[:, :1] + rim_mm / radius_mm * (irises - irises[:, :1])
        laid[frames, side] = grown + step[:, None]
    return laid


def eyeball_views(
    seen: SeenEyes,
    gaze: np.ndarray,
    centres: np.ndarray,
    distance_mm: float,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
) -> Iterator[tuple[int, np.ndarray, ViewedBall, list[EyeView]]]:
    """Side, frames [K] in which the eye has a gaze, the eyeball and its views in these frames.

    seen, gaze [F, 2, 2] radians, centres [2, 3] mm, distance_mm, camera_from_head [F, 4, 4] and intrinsics [3, 3] as in
    follow_irises."""
    for side, centre in enumerate(centres):
        frames = np.nonzero(np.isfinite(gaze[:, side]).all(-1))[0]
        if not len(frames):
            continue
        poses = camera_from_head[frames]
        depth = float(np.median(project(centre[None], poses, intrinsics)[1]))
        ball = ViewedBall(centre, distance_mm, intrinsics, depth / intrinsics[0, 0])
        yield side, frames, ball, [
            ball.view(seen.pictures[frame][side], seen.lids_px[frame, side], pose)
            for frame, pose in zip(frames, poses, strict=True)
        ]


class ViewedBall:
    """An eyeball: its samples about the iris' centre, in the space in which it looks along +z.

    pixel_mm: a pixel's width at the eye."""

    def __init__(self, centre: np.ndarray, distance_mm: float, intrinsics: np.ndarray, pixel_mm: float) -> None:
        """centre [3] mm; distance_mm: of the iris' centre from it; intrinsics [3, 3]; pixel_mm: a pixel's width at the
        eye."""
        self._centre, self._radius, self._intrinsics, self.pixel_mm = centre, distance_mm, intrinsics, pixel_mm
        spacing = max(LEAST_SPACING_MM, SPACING_PX * pixel_mm)
        along = np.arange(-REACH_MM, REACH_MM + 1e-6, spacing)
        across = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
        off = np.linalg.norm(across, axis=1)
        inside = off < min(REACH_MM, 0.95 * distance_mm)
        height = np.sqrt(distance_mm**2 - off[inside] ** 2)
        self._local = np.column_stack([across[inside], height])
        self._spacing_mm, self._share = spacing, min((spacing / CORRELATED_MM) ** 2, 1.0)

    def view(self, picture: EyePicture, lids_px: np.ndarray, camera_from_head: np.ndarray) -> EyeView:
        """The eye in a frame: its picture, lids_px [16, 2] px, the pose [4, 4]."""
        light = cv2.GaussianBlur(picture.grey.astype(np.float32), (0, 0), BLUR_PX)
        outline = lids_px[[*LOWER_LID, *UPPER_LID[-2:0:-1]]] - picture.corner
        within = np.zeros(light.shape, np.uint8)
        cv2.fillPoly(within, [np.rint(16.0 * (outline - 0.5)).astype(np.int32)], 1, lineType=cv2.LINE_8, shift=4)
        depth = cv2.distanceTransform(within, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * self.pixel_mm
        slopes = (cv2.Sobel(light, cv2.CV_32F, *way, ksize=3, scale=1 / 8) for way in ((1, 0), (0, 1)))
        layers = np.stack([light, *slopes, np.clip(depth / LID_MM, 0.0, 1.0)], axis=-1).astype(np.float32)
        return EyeView(layers, picture.corner, camera_from_head, camera_centres(camera_from_head))

    def pixels(self, places: np.ndarray, eye: EyeView) -> np.ndarray:
        """[N, 2] px of the frame: places [N, 3] mm in head space."""
        return project(places, eye.pose, self._intrinsics)[0]

    def shown(self, local: np.ndarray, gaze: np.ndarray, camera_from_head: np.ndarray) -> np.ndarray:
        """[F, 2] px: where frames with gaze [F, 2] and poses [F, 4, 4] show a place local [3] mm of the eyeball's
        space."""
        places = self._centre + np.einsum("fij,j->fi", gaze_rotation(gaze), local)
        return np.stack([project(place[None], pose, self._intrinsics)[0][0] for place, pose in
                         zip(places, camera_from_head, strict=True)])  # fmt: skip

    def mean_picture(self, eyes: list[EyeView], gaze: np.ndarray) -> MeanPicture | None:
        """What eyes [F] that look along gaze [F, 2] show of the eyeball in the mean; None where lids hide all."""
        samples = [self._samples(eye, own) for eye, own in zip(eyes, gaze, strict=True)]
        light, _, weight = (np.stack(part) for part in zip(*samples, strict=True))
        if not weight.any():
            return None
        against = _against_mean(light, weight)
        mean, total = against.mean, against.total
        known = total > LEAST_SEEN * total.max()
        share = np.minimum(total[known] / (WELL_SEEN * total.max()), 1.0)
        return MeanPicture(self._local[known, :2], mean[known], share, self._spacing_mm)

    def off_mean(self, eyes: list[EyeView], gaze: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, float]:
        """By how much eyes [F] that look along gaze [F, 2] differ at places [N, 3] mm in head space from their mean
        picture, in its codes: [F, N], NaN where a place is not on the eyeball, not in the picture, or the mean not
        known; and the deviation of what lies within the lids."""
        samples = [self._samples(eye, own) for eye, own in zip(eyes, gaze, strict=True)]
        light, _, weight = (np.stack(part) for part in zip(*samples, strict=True))
        if not weight.any():
            return np.full((len(eyes), len(places)), np.nan), np.nan
        against = _against_mean(light, weight)
        raster = self._rastered(against)
        off = np.full((len(eyes), len(places)), np.nan)
        for f, (eye, own) in enumerate(zip(eyes, gaze, strict=True)):
            local = self._behind(places, eye) @ gaze_rotation(own)
            mean, known = sample(raster, ((local[:, :2] + REACH_MM) / self._spacing_mm + 0.5)[None])[0].T
            seen, inside = eye.brightness(self.pixels(places, eye))
            use = (known > WELL_KNOWN) & (local[:, 2] > 0.0) & inside
            off[f, use] = (seen[use] - against.offset[f]) / against.gain[f] - mean[use] / known[use]
        return off, float(np.median(against.noise / against.gain))

    def _behind(self, places: np.ndarray, eye: EyeView) -> np.ndarray:
        """[N, 3] mm from the centre: where the lines of sight of places [N, 3] meet the ball; NaN where none does."""
        sight = normalised(places - eye.camera)
        away = self._centre - eye.camera
        nearest = sight @ away
        beside = away @ away - nearest**2
        front = np.sqrt(np.where(beside < self._radius**2, self._radius**2 - beside, np.nan))
        return (nearest - front)[:, None] * sight - away

    def _rastered(self, against: _AgainstMean) -> np.ndarray:
        """[n, n, 2] float32: the mean picture on its raster, each place by how well it is known, and that, 0 to 1."""
        count = int(2.0 * REACH_MM / self._spacing_mm + 1e-6) + 1
        raster = np.zeros((count, count, 2), np.float32)
        column, row = np.rint((self._local[:, :2] + REACH_MM) / self._spacing_mm).astype(int).T
        known = np.where(against.total > LEAST_SEEN * against.total.max(),
                         np.minimum(against.total / (WELL_SEEN * against.total.max()), 1.0), 0.0)
        raster[row, column] = np.stack([against.mean * known, known], axis=1)
        return raster

    def aligned(self, eyes: list[EyeView], gaze: np.ndarray) -> np.ndarray:
        """Gaze [F, 2] with which all eyes [F] agree best; gaze [F, 2]: the network's. Their median stays: a mean
        picture tells nothing of it. All stay where lids leave nothing to look at."""
        found = gaze.copy()
        for _ in range(ROUNDS):
            samples = [self._samples(eye, own) for eye, own in zip(eyes, found, strict=True)]
            light, slopes, weight = (np.stack(part) for part in zip(*samples, strict=True))
            if not weight.any():
                return found
            against = _against_mean(light, weight)
            told = against.counts * (self._share / against.noise**2)
            normal = np.einsum("fn,fni,fnj->fij", told, slopes, slopes) + np.eye(2) / NETWORK_SIGMA**2
            right = np.einsum("fn,fni->fi", told * against.residual, slopes) + (found - gaze) / NETWORK_SIGMA**2
            step = np.linalg.solve(normal, right[..., None])[..., 0]
            found -= np.clip(STEP * step, -LARGEST_STEP, LARGEST_STEP)
            found -= np.median(found - gaze, axis=0)
        return found

    def _samples(self, eye: EyeView, gaze: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """An eye that looks along gaze [2]: brightness [N] of its samples, the slopes [N, 2] of that by the gaze, and
        how much they count, [N]."""
        arm = self._local @ gaze_rotation(gaze).T
        places = self._centre + arm
        pixels = project(places, eye.pose, self._intrinsics)[0] - eye.corner
        seen = sample(eye.layers, pixels[None])[0]
        slope = projection_slope(places, eye.pose, self._intrinsics)
        axes = np.array([[0.0, 1.0, 0.0], [-np.cos(gaze[0]), 0.0, np.sin(gaze[0])]])
        moved = np.stack([np.cross(axis, arm) for axis in axes], axis=-1)
        by_gaze = np.einsum("ni,nij,njk->nk", seen[:, 1:3], slope, moved)
        sight = eye.camera - places
        facing = (arm * sight).sum(1) / (self._radius * np.linalg.norm(sight, axis=1))
        low, high = LEAST_FACING
        return seen[:, 0], by_gaze, seen[:, 3] * np.clip((facing - low) / (high - low), 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class _AgainstMean:
    """What brightness [F, N] differs by from the mean over the frames under each frame's own light, a gain and an
    offset: residual [F, N]; counts [F, N]: what it counts, less for outliers and none where there is no mean; noise,
    gain and offset [F, 1]: deviation of the rest and the light; mean [N]; total [N]: what all frames count there."""

    residual: np.ndarray
    counts: np.ndarray
    noise: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    mean: np.ndarray
    total: np.ndarray


def _against_mean(light: np.ndarray, weight: np.ndarray) -> _AgainstMean:
    """Of brightness light [F, N], whose samples count weight [F, N]."""
    counts, level = weight, (weight * light).sum(1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-9)
    gain, offset = np.maximum(level, 1.0) / max(float(np.median(level)), 1.0), np.zeros_like(level)
    for _ in range(MEANS):
        total = counts.sum(0)
        mean = (counts * (light - offset) / gain).sum(0) / np.maximum(total, 1e-9)
        known = weight * (total > LEAST_SEEN * total.max())
        residual = light - gain * mean - offset
        spread = np.median(np.abs((residual / gain)[weight > 0.5 * weight.max()]))
        noise = max(ROBUST_SCALE * float(spread), LEAST_NOISE) * gain
        counts = known * cauchy_weight(residual, OUTLIER * noise) ** 2
        gain, offset = _light(light, mean, counts, gain)
    return _AgainstMean(light - gain * mean - offset, counts, noise, gain, offset, mean, total)


def _light(light: np.ndarray, mean: np.ndarray, counts: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset [F, 1] that turn the mean [N] into brightness [F, N], by least squares with weights counts [F,
    N]; a tenth of what counts holds the gain [F, 1] to what it was."""
    total = counts.sum(1, keepdims=True) + 1e-9
    middle, usual = (counts * mean).sum(1, keepdims=True) / total, (counts * light).sum(1, keepdims=True) / total
    around = counts * (mean - middle)
    spread = (around * (mean - middle)).sum(1, keepdims=True) + total * HOLDS_GAIN
    gain = ((around * light).sum(1, keepdims=True) + gain * total * HOLDS_GAIN) / spread
    return gain, usual - gain * middle
