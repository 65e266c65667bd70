"""What a colour chart in view says about the scale of the light.

A chart's patches give the irradiance over pi on its plane; the light that was solved, as far as the head lets it
through, predicts it up to the factor per channel that the light lacks. The light counts as distant. The part of the
sphere that the head covers returns the skin's mean radiance as the clip shows it.

Two things about the chart are not known well, so several cases are weighed against each other by how well they explain
the corners and the patches, and the spread of the factor between them counts:

- Its normal, from the grid's corners and the lens. Seen from afar, a plane and its mirror image about the line of
  sight look alike, and a plane that faces the camera shows its tilt only to second order.
- Its depth, since charts come in many sizes: some way before, beside or behind the head, which shades it differently.

Reference: [Collins2014] (cv2.SOLVEPNP_IPPE).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from shared.appearance.albedo_scale import ResolvedScale, most_likely_irradiance
from shared.appearance.light_tint import LightTint, describe_tints, tint_in_words
from shared.capture.chart import COLUMNS, CORNERS, GLARE_SIGMA, PATCHES, ChartObservation, reflectances
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import WORLD_FROM_CAMERA, fibonacci_sphere, invert_rigid, pixel_rays
from shared.imaging.color import LUMINANCE
from shared.rendering.envmap import cube_lookup, cube_resolution

CORNER_SIGMA_PX = 0.3
JITTERS = 12
LEAST_COSINE = 0.4
"""Of the angle between normal and line of sight: a chart turned further away shows its own reflection too strongly."""
DEPTHS_MM = np.array([-150.0, -110.0, -80.0, -60.0, -40.0, -20.0, 0.0, 20.0, 45.0, 75.0, 110.0])
"""Of the chart, relative to the head's origin between the ears, away from the camera; traced at these, and linear
between them in steps of STEP_MM."""
STEP_MM = 5.0
LIKELY_DEPTH_MM, DEPTH_SIGMA_MM = -40.0, 60.0
"""Where people hold a chart: between the ears and the tip of the nose, give or take a hand."""
MODEL_SIGMA = 0.03
CHANNEL_SIGMA = 0.01
"""Deviation of the log irradiance that the light's own errors leave on a plane beside the head: of all channels
together, and of each by itself."""
TEMPER = 3.0
"""Patches' deviations are shared between channels and neighbours: what the data say for a case counts this much
less."""
DIRECTIONS = 1536
LIKELY_LUMINANCE = (0.03, 0.85)
"""Of skin: the reference skins' from 0.055 to 0.68, and some room."""


@dataclass(frozen=True)
class ChartTransfer:
    """An observation with all that does not depend on the light. cosine [D, N] of N normals with the world's directions
    and their log weights [N]; free [11 * 24, D] float32: whether a direction is open at each depth and patch."""

    observation: ChartObservation
    cosine: np.ndarray
    log_weight: np.ndarray
    free: np.ndarray

    def log_factor(self, radiance: np.ndarray, skin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How much brighter the light along the directions [D, 3] should be: log factor [3], its covariance [3, 3].

        skin [3]: radiance of the head. radiance [D, 3] linear: the light along the directions.
        """
        count = self.cosine.shape[1]
        unit = 4.0 / len(radiance)
        lit = (self.cosine[:, :, None] * radiance[:, None]).reshape(len(radiance), -1).astype(np.float32)
        direct = unit * _between_depths((self.free @ lit).reshape(-1, PATCHES, count, 3))
        blocked = unit * _between_depths(((1.0 - self.free) @ self.cosine).reshape(-1, PATCHES, count, 1))
        reference = np.maximum(reflectances(), 0.0)[:, None]
        value = self.observation.values[:, None] - reference * blocked * skin
        weight = (self.observation.weight / self.observation.white**2)[:, None]
        factor, glare, variance = _line(reference * direct, value, weight,
                                        (GLARE_SIGMA * self.observation.white) ** -2.0)
        squared_error = weight * (value - factor[:, None] * reference * direct - glare[:, None]) ** 2
        error = squared_error.sum((1, 3)) + ((glare / (GLARE_SIGMA * self.observation.white)) ** 2).sum(-1)
        freedom = max(int((weight > 0).sum()) - 3, 1)
        variance_inflation = max(1.0, float(error.min()) / freedom)
        expected = ((_depths() - LIKELY_DEPTH_MM) / DEPTH_SIGMA_MM)[:, None]
        log_chance = self.log_weight - 0.5 * (expected**2 + error / (TEMPER * variance_inflation))
        chance = np.exp(log_chance - log_chance.max())
        chance = (chance / chance.sum())[..., None]
        factor = np.maximum(factor, 1e-6)
        log, relative = np.log(factor), variance_inflation * variance / factor**2
        mean = (chance * log).sum((0, 1))
        spread = np.einsum("dnk,dna,dnb->ab", chance, log - mean, log - mean)
        return mean, spread + np.diag((chance * relative).sum((0, 1)))


def _line(x: np.ndarray, y: np.ndarray, weight: np.ndarray, pull: np.ndarray) -> tuple[np.ndarray, ...]:
    """Slope and offset of y over x along axis 1 by weighted least squares, and the slope's variance; pull: precision
    of the offset about zero."""
    weight = np.broadcast_to(weight, x.shape)
    total, sx, sy = weight.sum(1) + pull, (weight * x).sum(1), (weight * y).sum(1)
    sxx, sxy = (weight * x * x).sum(1), (weight * x * y).sum(1)
    curvature = np.maximum(sxx - sx * sx / total, 1e-12)
    slope = (sxy - sx * sy / total) / curvature
    return slope, (sy - slope * sx) / total, 1.0 / curvature


def _depths() -> np.ndarray:
    """[D]: every STEP_MM of DEPTHS_MM."""
    return np.arange(DEPTHS_MM[0], DEPTHS_MM[-1] + 0.5 * STEP_MM, STEP_MM)


def _between_depths(values: np.ndarray) -> np.ndarray:
    """[11, ...] at DEPTHS_MM -> the same every STEP_MM."""
    depth = _depths()
    right = np.clip(np.searchsorted(DEPTHS_MM, depth), 1, len(DEPTHS_MM) - 1)
    part = (depth - DEPTHS_MM[right - 1]) / (DEPTHS_MM[right] - DEPTHS_MM[right - 1])
    part = part.reshape(-1, *[1] * (values.ndim - 1)).astype(values.dtype)
    return values[right - 1] * (1.0 - part) + values[right] * part


@dataclass(frozen=True)
class ChartStatement:
    """Views of a chart in the frames of a clip; light: which of several it stands in."""

    views: tuple[ChartTransfer, ...]
    light: int = 0

    def log_factor(self, light: np.ndarray, skin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How much brighter the light [6 n^2, 3] should be: log factor [3] and its covariance [3, 3].

        skin [3]: mean radiance of the head. The median over the views: what spoils some (a hand, a shadow passing by)
        spoils hardly all. Channels err together, so their ratios are known better than the whole.
        """
        directions, lookup = _sphere(cube_resolution(light))
        radiance = lookup @ light
        said = [view.log_factor(radiance, skin) for view in self.views]
        factors = np.stack([factor for factor, _ in said])
        factor = np.median(factors, axis=0)
        scatter = (factors - factor).T @ (factors - factor) / len(said) ** 2
        own = np.mean([covariance for _, covariance in said], axis=0)
        return factor, own + scatter + MODEL_SIGMA**2 + np.diag(np.full(3, CHANNEL_SIGMA**2))


@lru_cache(maxsize=4)
def _sphere(resolution: int):
    """Directions [D, 3] over the sphere and the look-up [D, 6 n^2] of a cubemap along them."""
    directions = fibonacci_sphere(DIRECTIONS)
    return directions, cube_lookup(directions, resolution)


def state_chart(
    observations: Sequence[ChartObservation],
    scene: RayScene,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    moves: str,
    light: int = 0,
) -> tuple[ChartStatement | None, str]:
    """What a chart says -> statement, or None and a warning ("" without any chart).

    scene: the head's mesh; camera_from_head [F, 4, 4], intrinsics [3, 3] of the pictures, or [F, 3, 3] of each; moves:
    what moves against the light, "head" or "camera"; light: which of several the chart stands in.
    """
    views, lenses = [], np.broadcast_to(intrinsics, (len(camera_from_head), 3, 3))
    for observation in observations:
        intrinsics = lenses[observation.frame]
        normals, log_weight = chart_normals(observation.corners, intrinsics)
        chance = np.exp(log_weight - log_weight.max())
        mean = chance @ normals / chance.sum()
        if -mean[2] > LEAST_COSINE:
            pose = camera_from_head[observation.frame]
            world_from_camera = pose[:3, :3].T if moves == "camera" else WORLD_FROM_CAMERA
            directions = _sphere(1)[0]
            cosine = np.maximum(directions @ (world_from_camera @ normals.T), 0.0).astype(np.float32)
            points = _patch_places(observation.corners, mean, intrinsics, pose[2, 3])
            free = _open_directions(points, scene, pose, directions @ world_from_camera)
            views.append(ChartTransfer(observation, cosine, log_weight, free))
    if views:
        return ChartStatement(tuple(views), light), ""
    return None, "the colour chart is turned away from the camera: not used" if observations else ""


def _patch_places(corners: np.ndarray, normal: np.ndarray, intrinsics: np.ndarray, head_depth: float) -> np.ndarray:
    """[11 * 24, 3] mm in camera space: the patches, with the chart's middle at the head's depth plus DEPTHS_MM."""
    from_grid = cv2.getPerspectiveTransform(CORNERS.astype(np.float32), corners.astype(np.float32))
    grid = np.stack(np.divmod(np.arange(PATCHES), COLUMNS)[::-1], 1) + 0.5
    pixels = cv2.perspectiveTransform(np.concatenate([grid, CORNERS[2:3] / 2]).reshape(-1, 1, 2), from_grid)[:, 0]
    rays = pixel_rays(pixels, intrinsics)
    along = (rays[-1] @ normal) / (rays[:-1] @ normal)
    return np.concatenate([rays[:-1] * (along * (head_depth + depth))[:, None] for depth in DEPTHS_MM])


def _open_directions(points: np.ndarray, scene: RayScene, camera_from_head: np.ndarray,
                     directions: np.ndarray) -> np.ndarray:
    """[N, D] float32, 1 where the head does not cover a direction [D, 3] as seen from a point [N, 3], camera space."""
    head_from_camera = invert_rigid(camera_from_head)
    origins = points @ head_from_camera[:3, :3].T + head_from_camera[:3, 3]
    towards = directions @ head_from_camera[:3, :3].T
    covered = scene.occluded(np.repeat(origins, len(towards), 0), np.tile(towards, (len(origins), 1)))
    return 1.0 - covered.reshape(len(origins), -1).astype(np.float32)


def chart_normals(corners: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals [N, 3] in camera space, towards the camera, that corners [4, 2] px allow, and their log weights [N]."""
    jitter = np.random.default_rng(0).normal(0.0, CORNER_SIGMA_PX, (JITTERS, 4, 2))
    jitter[0] = 0.0
    grid = np.column_stack([CORNERS, np.zeros(4)])
    normals, errors = [], []
    for shift in jitter:
        count, turns, _, error = cv2.solvePnPGeneric(grid, (corners + shift).reshape(4, 1, 2), intrinsics, None,
                                                     flags=cv2.SOLVEPNP_IPPE)
        for k in range(count):
            normal = cv2.Rodrigues(turns[k])[0][:, 2]
            normals.append(-normal if normal[2] > 0 else normal)
            errors.append(float(error[k][0]))
    # The error is the root mean square over eight coordinates, as many as make up chi squared.
    return np.array(normals), -4.0 * np.square(np.array(errors) / CORNER_SIGMA_PX)


def describe_scale(
    chart: ChartStatement | None,
    skin: np.ndarray,
    whites: dict | None = None,
    scale: ResolvedScale | None = None,
    tints: Sequence[LightTint | None] = (),
) -> dict:
    """albedo_scale of solve.json: what set the scale, and the skin's albedo [3] under it; whites: what the whites of
    the eyes said, None: nothing; scale: with its covariance, None: unknown; tints: what grey places said of each light.

    With a chart also what it said: the frames, the irradiance over pi on it, the deviation of its logarithm, and by
    which factor the albedo would be another by the priors alone (without highlights and whites).
    """
    priors = f"luminance and chroma of reference skins, {tint_in_words(tints)}"
    if whites is not None:
        priors += ", whites of the eyes that are nearly neutral and as bright as usual"
    alone = f"priors: {priors}, and the strength of highlights relative to their usual range"
    described = {
        "method": f"a colour chart in view, and far weaker priors: {priors}" if chart else alone,
        "skin_albedo": np.round(skin, 4).tolist(),
        "skin_luminance": round(float(skin @ LUMINANCE), 4),
        **({} if scale is None else scale.describe(skin)),
        **({} if whites is None else {"whites": whites}),
        **({"grey": said} if (said := describe_tints(tints)) else {}),
    }
    if chart is None:
        return described
    observations = [view.observation for view in chart.views]
    white, sigma = (np.median([getattr(observation, name) for observation in observations],
                              axis=0) for name in ("white", "log_sigma"))
    own = tints[chart.light : chart.light + 1]
    factor = white / np.exp(most_likely_irradiance(np.log(skin * white), tints=own))
    return described | {"chart": {
        "frames": [observation.frame_index for observation in observations],
        "irradiance_over_pi": np.round(white, 4).tolist(),
        "log_sigma": np.round(sigma, 4).tolist(),
        "priors_alone_factor": np.round(factor, 4).tolist(),
    }}


def scale_warnings(chart: ChartStatement | None, skin: np.ndarray) -> list[str]:
    """A warning where the skin's albedo [3] under a chart's scale is no skin's."""
    luminance = float(skin @ LUMINANCE)
    if chart is None or LIKELY_LUMINANCE[0] < luminance < LIKELY_LUMINANCE[1]:
        return []
    return [f"the colour chart gives the skin a luminance of {luminance:.2f}: does it stand in the face's own light?"]
