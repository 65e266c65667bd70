"""Where each eye looks in each frame: from the irises' centres, the poses, and what is known of eyes.

An eye turns about a fixed centre in the head, with the plane of the iris at a fixed distance before it. The line from
one to the other is the gaze. Both are those of the mesh's eyeballs (some 10.4 mm from the centre to the iris, as
[Fry1962] has it), corrected by the clip, so that these eyeballs show the irises where they were seen when the gaze
turns them. Gaze, centres and distance are solved together by Gauss-Newton steps: a centre that is a millimetre off
turns all gaze by 5 degrees, and only what the person looks at, and that both eyes look at one place, tells the two
apart.

What gaze does between frames is a random walk with heavy tails (Cauchy): it rests and jumps, so that noise is averaged
where it rests and a jump stays one. It rests on the camera or in the head, whichever the clip supports. The line of
sight lies some 5 degrees beside the axis through the iris' centre, and the cornea bends rays: neither is modelled, the
solved centres take up most of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from shared.compute.robust import ROBUST_SCALE, cauchy_weight
from shared.geometry.eyeballs import IRIS_MM, Eyeball, gaze_direction, gaze_towards
from shared.geometry.transforms import camera_centres, project

CENTRE_SIGMA_MM, DISTANCE_SIGMA_MM = np.array([1.2, 1.2, 1.5]), 0.5
"""How well a fitted head tells the centres, and the distance of the iris' plane from them."""
OFFSET_SIGMA, ELSEWHERE_SIGMA = np.radians([2.0, 10.0])
"""Of each eye's axis from what it rests on; of both together where that is a place of its own, not the camera."""
ODDS = {"camera": 3.0, "place": 1.0, "head": 1.0}
"""Of what a gaze may rest on, before the clip is seen: who films oneself looks into the lens. Eyeballs one millimetre
too high or low look five degrees beside it, and irises hardly tell the two apart."""
LOOKS = 3.0
"""All frames count as so many where they tell what they share: what is looked at lasts, and so does the network's
error, which puts an iris that looks aside up to a quarter too near to the middle of the lids."""
PAIR_SIGMA, REST_SIGMA, LEAST_STEP = np.radians([1.0, 1.0, 0.3])
"""Of the difference of both eyes about its mean; about what the gaze rests on; of a step between frames of a gaze that
rests."""
ROBUST = 2.5
"""Deviations beyond which a residual loses its pull."""
RESTS_DEG, RESTS_SHARE = 3.0, 0.6
"""A gaze rests on something if such a share of the frames lies so near to it."""
LEAST_NOISE, LEAST_FRAMES = 0.0125, 8
"""Of an iris' diameter: deviation of its centre at best."""
STEPS = 16
LEAST_FACING, SIZES = 0.8, 10.0
"""Irises that look narrower than such a share are not measured; all others count as so many measurements."""
IRIS_SYSTEMATIC, IRIS_SYSTEMATIC_PX = 0.03, 0.3
"""The network's error of an iris' radius, common to all frames: a share of it, and in pixels; eyes 12 px wide, half of
the iris under the lids, gave half a pixel too little."""


@dataclass(frozen=True)
class Gaze:
    """gaze and sigma [F, 2, 2] radians (shared.geometry.eyeballs), NaN where an eye is shut or not seen; own_sigma [F,
    2, 2]: what of the latter is each frame's own.

    kind: what the gaze rests on: "camera", "place" (one beside the camera), "head" (one that turns with it), or else
    "wandering". centres [2, 3] mm of rotation in head space and centre_sigma [2, 3]; iris_distance_mm: from there to
    the iris' plane. iris_radius_mm under the head's scale, and its deviation, that of the network included. error_px
    [F, 2]: between the iris' centre as seen and as this shows it; noise_px: deviation of the former in each of x and y.
    """

    gaze: np.ndarray
    sigma: np.ndarray
    own_sigma: np.ndarray
    kind: str
    centres: np.ndarray
    centre_sigma: np.ndarray
    iris_distance_mm: float
    iris_radius_mm: float
    iris_radius_sigma_mm: float
    error_px: np.ndarray
    noise_px: float


def iris_distance(eyeballs: Sequence[Eyeball]) -> float:
    """From the centres of eyeballs to the planes of their irises, mm: where a rim as large as an iris cuts them."""
    radius = np.mean([ball.radius for ball in eyeballs])
    return float(np.sqrt(max(radius**2 - IRIS_MM**2, IRIS_MM**2)))


def solve_gaze(
    iris_px: np.ndarray,
    counts: np.ndarray,
    centres: np.ndarray,
    distance_mm: float,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    time_s: np.ndarray,
) -> Gaze | None:
    """Gaze of both eyes; None where too few frames show them.

    iris_px [F, 2, 5, 2] px: centre and rim of the right and left iris (shared.capture.iris); counts [F, 2] bool: eyes
    that are open and seen; centres [2, 3] mm of the eyeballs, and distance_mm of the irises' planes from them,
    both to begin with; camera_from_head [F, 4, 4]; intrinsics [3, 3]; time_s [F].
    """
    counts = counts & np.isfinite(iris_px[:, :, 0]).all(-1)
    if (counts.sum(0) < LEAST_FRAMES).any():
        return None
    noise_px = _noise_px(iris_px, counts, centres, camera_from_head, intrinsics)
    clip = _Clip(iris_px[:, :, 0], counts, centres, distance_mm, camera_from_head, intrinsics, time_s, noise_px)
    to_camera = clip.to_camera()
    usual = to_camera.mean(0)
    in_head = np.broadcast_to(0.5 * (usual + usual.mean(0)), to_camera.shape)  # between the camera and far away
    fixations = {
        "camera": _Fixation(clip, to_camera, shared_prior(OFFSET_SIGMA)),
        "place": _Fixation(clip, to_camera, shared_prior(ELSEWHERE_SIGMA)),
        "head": _Fixation(clip, in_head, shared_prior(ELSEWHERE_SIGMA)),
    }
    kind = max(fixations, key=lambda name: fixations[name].evidence + np.log(ODDS[name]))
    if fixations[kind].share >= RESTS_SHARE:
        state = _Solution(clip, fixations[kind], rests=True)
    else:
        kind, calmest = "wandering", min((fixations["place"], fixations["head"]), key=lambda fixation: fixation.step)
        state = _Solution(clip, calmest, rests=False)
    state.solve()
    gaze, (sigma, own_sigma) = state.gaze(), state.sigma()
    for values in (gaze, sigma, own_sigma):
        values[~counts] = np.nan
    radius, radius_sigma = iris_radius(
        iris_px, counts, gaze, state.centres, state.distance, camera_from_head, intrinsics
    )
    error = np.where(counts, np.linalg.norm(state.residuals(), axis=-1), np.nan)
    centre_sigma = np.sqrt(state.shared_covariance().diagonal()[:6]).reshape(2, 3)
    return Gaze(gaze, sigma, own_sigma, kind, state.centres, centre_sigma, state.distance, radius, radius_sigma, error,
                float(np.median(clip.noise_px[counts])))


def iris_radius(
    iris_px: np.ndarray,
    counts: np.ndarray,
    gaze: np.ndarray,
    centres: np.ndarray,
    distance_mm: float,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
) -> tuple[float, float]:
    """Radius of the irises in mm and its deviation, from their rims beside the centre, which no lid hides.

    iris_px [F, 2, 5, 2] px, counts [F, 2] bool, centres [2, 3] mm, distance_mm and the rest as in solve_gaze; gaze [F,
    2, 2]. Of a disc of radius 1 with the unit normal n, at depth z on the line of sight (x, y, 1), the extent along
    a line a of the picture is f / z times the length of what w = (a, -a (x, y)) has across n.
    """
    across = iris_px[:, :, 1] - iris_px[:, :, 3]
    width_px = np.linalg.norm(across, axis=-1)
    line = across / np.maximum(width_px, 1e-9)[..., None]
    normal = np.einsum("fij,fkj->fki", camera_from_head[:, :3, :3], gaze_direction(gaze))
    pixels, depth = project(centres, camera_from_head, intrinsics)
    depth = depth + distance_mm * normal[..., 2]
    sight = (pixels - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]]
    w = np.concatenate([line, -(line * sight).sum(-1, keepdims=True)], axis=-1)
    share = np.sqrt(np.square(w).sum(-1) - np.square((w * normal).sum(-1)))
    seen = counts & (share > LEAST_FACING)
    if not seen.any():
        return float("nan"), float("nan")
    pixel_mm = depth / intrinsics[0, 0]
    radii = (0.5 * width_px * pixel_mm / share)[seen]
    middle = float(np.median(radii))
    spread = ROBUST_SCALE * float(np.median(np.abs(radii - middle))) / np.sqrt(min(len(radii), SIZES))
    systematic = np.hypot(IRIS_SYSTEMATIC * middle, IRIS_SYSTEMATIC_PX * np.median(pixel_mm[seen]))
    return middle, float(np.hypot(spread, systematic))


def _noise_px(
    iris_px: np.ndarray, counts: np.ndarray, centres: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """[F, 2] px: deviation of each iris' centre. What all have, from how one eye jitters against the other; more of an
    iris that looks narrow, as from the side, and where the rim's middle lies elsewhere, which a lid or a reflection
    does."""
    centre, rim = iris_px[:, :, 0], 0.5 * (iris_px[:, :, 1] + iris_px[:, :, 3])
    turned = centre - project(centres, camera_from_head, intrinsics)[0]
    both = counts.all(1)
    jitter = np.diff(turned[:, 0] - turned[:, 1], n=2, axis=0)[both[2:] & both[1:-1] & both[:-2]]
    width = np.linalg.norm(iris_px[:, :, 1] - iris_px[:, :, 3], axis=-1)
    base = LEAST_NOISE * float(np.median(width[counts]))
    if len(jitter):
        base = max(base, ROBUST_SCALE * float(np.median(np.abs(jitter))) / np.sqrt(12.0))
    beside = np.linalg.norm(rim - centre, axis=-1)
    usual_width, usual = np.median(width[counts]), np.median(beside[counts])
    narrower = np.square(usual_width / np.maximum(width, 0.2 * usual_width))
    noise = np.hypot(base * np.maximum(narrower, 1.0), np.clip(beside - 2.0 * usual, 0.0, None))
    return np.where(counts, noise, base)


def shared_prior(together: float) -> np.ndarray:
    """[11, 11] inverse covariance of the shared unknowns: shifts of both centres (6) and of the iris' distance, mm, and
    offsets of the right and left eye's axis (4), radians; together: deviation of their mean."""
    prior = np.zeros((11, 11))
    prior[:7, :7] = np.diag(np.concatenate([np.tile(CENTRE_SIGMA_MM, 2), [DISTANCE_SIGMA_MM]]) ** -2.0)
    mean, apart = np.full((2, 2), 0.25), np.array([[0.25, -0.25], [-0.25, 0.25]])
    inverse = 2.0 * mean / together**2 + 2.0 * apart / OFFSET_SIGMA**2
    prior[7:, 7:] = np.kron(inverse, np.eye(2))
    return prior


@dataclass(frozen=True)
class _Clip:
    """iris [F, 2, 2] px and its deviation noise_px [F, 2]; counts [F, 2]; the rest as in solve_gaze."""

    iris: np.ndarray
    counts: np.ndarray
    centres: np.ndarray
    distance: float
    poses: np.ndarray
    intrinsics: np.ndarray
    time_s: np.ndarray
    noise_px: np.ndarray

    def to_camera(self) -> np.ndarray:
        """[F, 2, 2] gaze of eyes that look into the camera."""
        return gaze_towards(camera_centres(self.poses)[:, None] - self.centres)

    def predict(self, gaze: np.ndarray, parameters: np.ndarray) -> tuple[np.ndarray, ...]:
        """Residuals [F, 2, 2] px, their slopes by gaze [F, 2, 2, 2], by the eye's centre [F, 2, 2, 3] and by the
        distance of the iris [F, 2, 2]; parameters [7]: shifts of the centres (6) and of the distance, mm."""
        distance = self.distance + parameters[6]
        direction = gaze_direction(gaze)
        places = self.centres + parameters[:6].reshape(2, 3) + distance * direction
        rotation = self.poses[:, None, :3, :3]
        in_camera = (rotation @ places[..., None])[..., 0] + self.poses[:, None, :3, 3]
        focal, depth = self.intrinsics[[0, 1], [0, 1]], in_camera[..., 2:]
        ray = in_camera[..., :2] / depth
        slopes = (focal / depth)[..., None] * (rotation[..., :2, :] - ray[..., None] * rotation[..., 2:, :])
        residuals = np.where(self.counts[..., None], self.iris - (focal * ray + self.intrinsics[:2, 2]), 0.0)
        by_gaze = distance * slopes @ _direction_slope(gaze)
        return residuals, by_gaze, slopes, (slopes @ direction[..., None])[..., 0]


def _direction_slope(gaze: np.ndarray) -> np.ndarray:
    """[..., 3, 2]: derivative of gaze_direction by yaw and pitch."""
    yaw, pitch = gaze[..., 0], gaze[..., 1]
    sy, cy, sp, cp = np.sin(yaw), np.cos(yaw), np.sin(pitch), np.cos(pitch)
    by_yaw = np.stack([cy * cp, np.zeros_like(yaw), -sy * cp], axis=-1)
    by_pitch = np.stack([-sy * sp, cp, -cy * sp], axis=-1)
    return np.stack([by_yaw, by_pitch], axis=-1)


def _shared_rows(by_gaze: np.ndarray, by_centre: np.ndarray, by_distance: np.ndarray) -> np.ndarray:
    """[F, 2, 2, 11]: slopes of the pixels by the shared unknowns; see _Clip.predict."""
    rows = np.zeros(by_distance.shape + (11,))
    for eye in range(2):
        rows[:, eye, :, 3 * eye : 3 * eye + 3] = by_centre[:, eye]
        rows[:, eye, :, 7 + 2 * eye : 9 + 2 * eye] = by_gaze[:, eye]
    rows[..., 6] = by_distance
    return rows


class _Fixation:
    """The gaze held to a reference [F, 2, 2] in all frames: only the shared unknowns [11] are solved, under a prior
    [11, 11]. share: of the eyes seen that lie near; evidence: logarithm of this hypothesis', in Laplace's
    approximation; away [F, 2, 2]: what would explain the rest; step: deviation of its course's steps, less the noise,
    radians."""

    def __init__(self, clip: _Clip, reference: np.ndarray, prior: np.ndarray) -> None:
        self.reference, self.prior, self.parameters = reference, prior, np.zeros(11)
        for step in range(STEPS):
            residuals, *slopes = clip.predict(self._gaze(), self.parameters)
            rows = _shared_rows(*slopes)
            limit_px = np.radians(RESTS_DEG) * np.sqrt(np.abs(np.linalg.det(slopes[0])))
            off = np.linalg.norm(residuals, axis=-1)
            told = min(1.0, LOOKS / (0.5 * clip.counts.sum())) * clip.counts / np.square(0.5 * limit_px)
            weight = cauchy_weight(off, limit_px * max(1.0, 2.0 ** (4 - step)), told)
            pull = weight[..., None, None] * rows
            normal = np.einsum("feri,ferj->ij", pull, rows) + prior
            right = np.einsum("feri,fer->i", pull, residuals) - prior @ self.parameters
            self.parameters = self.parameters + np.linalg.solve(normal, right)
        self.share = float((off < limit_px)[clip.counts].mean())
        loss = (told * np.square(limit_px) * np.log1p(np.square(off / limit_px))).sum()
        volume = np.linalg.slogdet(normal)[1] - np.linalg.slogdet(prior)[1]
        self.evidence = -0.5 * float(loss + self.parameters @ prior @ self.parameters + volume)
        self.away = np.linalg.solve(slopes[0], residuals[..., None])[..., 0]
        noise = np.median((clip.noise_px / limit_px)[clip.counts]) * np.radians(RESTS_DEG)
        self.step = _step_deviation(self.away, clip.counts, noise)

    def _gaze(self) -> np.ndarray:
        return self.reference + self.parameters[7:].reshape(2, 2)


def _step_deviation(away: np.ndarray, counts: np.ndarray, noise: float) -> float:
    """Radians, LEAST_STEP at least: of the steps of a course [F, 2, 2] common to both eyes, whose noise [each] is
    independent."""
    steps = np.diff(away.mean(1), axis=0)[counts[1:].all(1) & counts[:-1].all(1)]
    if not len(steps):
        return float(LEAST_STEP)
    variance = np.square(ROBUST_SCALE * np.median(np.abs(steps))) - np.square(noise)
    return float(np.sqrt(max(variance, LEAST_STEP**2)))


class _Solution:
    """Gaze of all frames about a fixation; rests: it mostly lies on it."""

    def __init__(self, clip: _Clip, fixation: _Fixation, rests: bool) -> None:
        self.clip, self.rests, self.reference, self.step = clip, rests, fixation.reference, fixation.step
        self.parameters, self.away = fixation.parameters, np.zeros_like(fixation.away)
        # The normal equations count every frame; all of them tell the shared unknowns as LOOKS would.
        self.tempered = max(1.0, 0.5 * clip.counts.sum() / LOOKS)
        self.prior = self.tempered * fixation.prior

    def gaze(self) -> np.ndarray:
        """[F, 2, 2]"""
        return self.reference + self.parameters[7:].reshape(2, 2) + self.away

    @property
    def centres(self) -> np.ndarray:
        """[2, 3] mm"""
        return self.clip.centres + self.parameters[:6].reshape(2, 3)

    @property
    def distance(self) -> float:
        """Of the iris from the centre, mm."""
        return float(self.clip.distance + self.parameters[6])

    def residuals(self) -> np.ndarray:
        """[F, 2, 2] px"""
        return self.clip.predict(self.gaze(), self.parameters)[0]

    def solve(self) -> None:
        """Gauss-Newton steps; Cauchy scales begin wide, so that where the gaze jumps is found."""
        for step in range(STEPS):
            banded, right, border, normal, tail = self._equations(wide=max(1.0, 2.0 ** (5 - step)))
            self._factor(banded, border, normal)
            inner = cho_solve_banded(self.factor, right)
            shared = np.linalg.solve(self.schur, tail - border.T @ inner)
            self.away += (inner - self.solved_border @ shared).reshape(self.away.shape)
            self.parameters = self.parameters + shared

    def _equations(self, wide: float):
        """Normal equations: of the frames banded [8, 4 F], right side [4 F], border [4 F, 11], of the shared unknowns
        [11, 11] and [11]."""
        clip, count = self.clip, len(self.away)
        residuals, *slopes = clip.predict(self.gaze(), self.parameters)
        by_gaze, shared, sigma = slopes[0], _shared_rows(*slopes), clip.noise_px
        off = np.linalg.norm(residuals, axis=-1)
        weight = cauchy_weight(off, ROBUST * wide * sigma, clip.counts / sigma**2)
        pull = weight[..., None, None] * shared
        normal = np.einsum("feri,ferj->ij", pull, shared) + self.prior
        tail = np.einsum("feri,fer->i", pull, residuals) - self.prior @ self.parameters
        blocks, right, border = np.zeros((count, 4, 4)), np.zeros((count, 4)), np.zeros((count, 4, 11))
        for eye in range(2):
            own, turned = slice(2 * eye, 2 * eye + 2), np.swapaxes(weight[:, eye, None, None] * by_gaze[:, eye], 1, 2)
            blocks[:, own, own] = turned @ by_gaze[:, eye]
            right[:, own] = (turned @ residuals[:, eye, :, None])[..., 0]
            border[:, own] = turned @ shared[:, eye]
        steps = self._add_priors(blocks, right, wide)
        return _banded(blocks, steps), right.ravel(), border.reshape(4 * count, 11), normal, tail

    def _add_priors(self, blocks: np.ndarray, right: np.ndarray, wide: float) -> np.ndarray:
        """Adds to blocks [F, 4, 4] and right [F, 4] what is known of gaze; couplings of neighbours [F - 1, 4, 4]."""
        apart, mean = self.away[:, 0] - self.away[:, 1], self.away.mean(1)
        pair, both = np.kron([[1.0, -1.0], [-1.0, 1.0]], np.eye(2)), np.kron(np.full((2, 2), 0.25), np.eye(2))

        def add(frames: slice, weight: np.ndarray, shape: np.ndarray, pull: np.ndarray) -> None:
            blocks[frames] += weight[:, None, None] * shape
            right[frames] += weight[:, None] * pull

        weight = cauchy_weight(np.linalg.norm(apart, axis=-1), ROBUST * wide * PAIR_SIGMA, 1.0 / PAIR_SIGMA**2)
        add(slice(None), weight, pair, np.concatenate([-apart, apart], axis=1))
        if self.rests:
            scale = ROBUST * wide * REST_SIGMA
            weight = cauchy_weight(np.linalg.norm(mean, axis=-1), scale, 1.0 / REST_SIGMA**2)
        else:
            weight = np.full(len(mean), 1.0 / (self.tempered * ELSEWHERE_SIGMA**2))
        add(slice(None), weight, both, -0.5 * np.tile(mean, 2))
        step, span = np.diff(mean, axis=0), np.diff(self.clip.time_s)
        sigma = self.step * np.sqrt(np.maximum(span / np.median(span), 0.1))
        weight = cauchy_weight(np.linalg.norm(step, axis=-1), ROBUST * wide * sigma, 1.0 / sigma**2)
        add(slice(0, -1), weight, both, 0.5 * np.tile(step, 2))
        add(slice(1, None), weight, both, -0.5 * np.tile(step, 2))
        return -weight[:, None, None] * both

    def _factor(self, banded: np.ndarray, border: np.ndarray, normal: np.ndarray) -> None:
        self.factor = cholesky_banded(banded, lower=True), True
        self.solved_border = cho_solve_banded(self.factor, border)
        self.schur = normal - border.T @ self.solved_border

    def sigma(self) -> tuple[np.ndarray, np.ndarray]:
        """[F, 2, 2] radians with the shared unknowns' deviation, and without: from the inverse of the normal
        equations."""
        size = self.away.size
        variance = np.empty(size)
        for start in range(0, size, 512):
            stop = min(start + 512, size)
            unit = np.eye(size, stop - start, -start)
            variance[start:stop] = cho_solve_banded(self.factor, unit)[start:stop].diagonal()
        offset = np.zeros((size, 11))
        offset[np.arange(size), 7 + np.arange(size) % 4] = 1.0
        lever = offset - self.solved_border
        shared = np.einsum("ij,jk,ik->i", lever, self.shared_covariance(), lever)
        return tuple(np.sqrt(part).reshape(self.away.shape) for part in (variance + shared, variance))

    def shared_covariance(self) -> np.ndarray:
        """[11, 11] of the shared unknowns, mm and radians."""
        return self.tempered * np.linalg.inv(self.schur)


def _banded(blocks: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Lower banded form [8, 4 F] of a block tridiagonal matrix: blocks [F, 4, 4], couplings [F - 1, 4, 4]."""
    count = len(blocks)
    banded = np.zeros((8, 4 * count))
    for row in range(4):
        for column in range(4):
            if row >= column:
                banded[row - column, column::4] = blocks[:, row, column]
            banded[4 + row - column, column : 4 * (count - 1) : 4] += steps[:, row, column]
    return banded
