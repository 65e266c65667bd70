"""What the whites of the eyes say about the scale of the light.

The white of an eye is nearly neutral and about as bright in all people, while skin is not: where a clip shows it, its
albedo under the light as it was solved says by which factor that light is off. The white is narrow and lies in the
lids' shadow, beside lashes and under tears: only samples well within the lids and beyond the iris count, each under the
light that reaches its place, the median of them, and with the deviation that eyes of known albedo have. Beside dark
skin it is often burnt out. What is not would be its shaded part: so clipped samples count as brighter than any other,
and where the median is among them nothing is said.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from shared.compute.robust import ROBUST_SCALE
from shared.geometry.eyeballs import IRIS_MM, gaze_direction
from shared.geometry.mesh import interpolate, normalised
from shared.geometry.raycast import RAY_START_MM, RayScene
from shared.geometry.transforms import camera_centres, fibonacci_sphere, project
from shared.imaging.image_sampling import Picture, Samples, sample_colours, sample_saturation
from shared.imaging.turning_eyes import TurningEyes, depth_in_polygon
from shared.imaging.views import Views
from shared.rendering.transfer import Points

DIRECTIONS = 1600
"""Over a whole eyeball, evenly: a place about every millimetre."""
LIMBUS_MM = 1.2
"""Beyond the iris' rim the white begins to be white."""
WITHIN_MM, WITHIN_PX = 0.8, 1.5
"""So far within the lids' opening a sample shows the white alone: lashes, tears and blur are at its border."""
LEAST_COSINE = 0.35
LEAST_FRAMES, LEAST_PLACES = 4, 8
"""A place counts that is seen in so many frames; of fewer places nothing is said."""
USUAL_ALBEDO = 0.5
"""Of the white as it is measured here."""
INDEPENDENT = 4.0
"""The whites beside both irises, two of each."""
LEVEL_SIGMA, TINT_SIGMA = 0.3, 0.15
"""Standard deviations of its log albedo, as it is measured: of the mean of the channels, and of a ratio of two. Three
synthetic heads whose whites have 0.62, 0.55, 0.51 measured 0.37 to 0.69 in red once the light's scale was taken from
the truth."""


class WhitesSeen:
    """Collects what the frames of some views show of the whites: look(f, picture) for every frame, then samples().

    places: points of both eyeballs, the right one's first.
    """

    def __init__(self, eyes: TurningEyes, scene: RayScene, views: Views):
        self._views, self._scene = views, scene
        self._cameras = camera_centres(views.camera_from_head)
        directions = fibonacci_sphere(DIRECTIONS)
        directions = directions[directions[:, 2] > 0.0]
        self._side = np.repeat([0, 1], len(directions))
        self._iris = np.array([np.arcsin((IRIS_MM + LIMBUS_MM) / ball.radius) for ball in eyes.balls])
        on_mesh = [eyes.place(side, directions) for side in (0, 1)]
        positions = [interpolate(eyes.mesh.vertices, eyes.mesh.faces, face, bary) for face, bary in on_mesh]
        self.places = Points(np.concatenate(positions), np.concatenate([directions, directions]))
        shape = len(self.places), len(views)
        self._colours, self._weight = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
        self._saturation, self._towards = np.zeros((*shape, 3), np.int8), np.zeros((*shape, 3), np.float32)

    def look(self, f: int, picture: Picture) -> None:
        """Frame f of the views."""
        gaze, lids_px, places = self._views.gaze[f], self._views.lids_px[f], self.places
        lens = self._views.intrinsics[f]
        pixels, depth = project(places.positions, self._views.camera_from_head[f], lens)
        towards = normalised(self._cameras[f] - places.positions)
        cosine = (towards * places.normals).sum(1)
        self._towards[:, f] = towards
        axes = gaze_direction(np.where(np.isfinite(gaze), gaze, 0.0))[self._side]
        white = (places.normals * axes).sum(1) < np.cos(self._iris[self._side])
        known = (np.isfinite(gaze).all(1) & np.isfinite(lids_px).all((1, 2)))[self._side]
        rows = np.nonzero(white & known & (cosine > LEAST_COSINE) & (depth > 0.0))[0]
        within = np.concatenate([
            depth_in_polygon(pixels[rows[self._side[rows] == side]], lids_px[side]) for side in (0, 1)
        ])
        rows = rows[within > np.maximum(WITHIN_PX, WITHIN_MM * lens[0, 0] / depth[rows])]
        start = places.positions[rows] + RAY_START_MM * places.normals[rows]
        rows = rows[~self._scene.occluded(start, towards[rows])]
        if not len(rows):
            return
        self._saturation[rows, f] = sample_saturation(picture.saturation, pixels[rows])
        self._colours[rows, f] = sample_colours(picture, pixels[rows])
        self._weight[rows, f] = np.square(cosine[rows]) * (self._saturation[rows, f] >= 0).all(1)

    def looked_at(self, pictures: Iterable[Picture]) -> Iterator[Picture]:
        """Pictures of all frames in order, handed on."""
        for f, picture in enumerate(pictures):
            self.look(f, picture)
            yield picture

    def samples(self, fitted: np.ndarray) -> tuple[np.ndarray, Samples]:
        """Which of the places [n] count, by the fitted frames [F] bool, and their samples [n, F]; none where too few
        do."""
        rows = np.nonzero((self._weight[:, fitted] > 0.0).sum(1) >= LEAST_FRAMES)[0]
        rows = rows if len(rows) >= LEAST_PLACES else rows[:0]
        weight = self._weight[rows] * fitted
        return rows, Samples(self._colours[rows], weight, self._saturation[rows], self._towards[rows])


def whites_statement(samples: Samples, irradiance: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """How much brighter the light should be for the whites to have their usual albedo: log factor [3], and its
    covariance [3, 3]; None where too many are burnt out. samples [P, F] of them under irradiance over pi [3, P, F].

    Their albedo is the slope of radiance over irradiance with the least absolute deviations, which is the median of the
    ratios weighted by the irradiance: what lies in shadow says little. Errors of shading are shared by neighbours: all
    samples count as few. What scatters the ratios has a colour, a lid's own or that of the light it sends on: their
    scatter leaves the tint as open as the level.
    """
    lower, albedo = np.log(albedo_of_whites(samples, irradiance, (0.25, 0.5)))
    if not np.isfinite(albedo).all():
        return None
    spread = ROBUST_SCALE * float((albedo - lower).mean())
    scatter = spread**2 / INDEPENDENT
    tint = 0.5 * (TINT_SIGMA**2 + scatter) * np.eye(3)
    return albedo - np.log(USUAL_ALBEDO), LEVEL_SIGMA**2 + scatter + tint


def albedo_of_whites(samples: Samples, irradiance: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """[n, 3]: quantiles, shares [n], of the ratio of radiance and irradiance over pi [3, P, F], weighted by it; a
    clipped ratio is greater than any: inf."""
    found = np.empty((len(shares), 3))
    for c, light in enumerate(irradiance):
        weight = (samples.weight * light).ravel()
        ratio = samples.colours[..., c].ravel() / np.maximum(light.ravel(), 1e-6)
        ratio[samples.saturation[..., c].ravel() > 0] = np.inf
        order = np.argsort(ratio)
        total = np.cumsum(weight[order])
        found[:, c] = ratio[order[np.searchsorted(total, np.array(shares) * total[-1])]]
    return np.maximum(found, 1e-4)


def describe_whites(places: int, log_factor: np.ndarray, covariance: np.ndarray) -> dict:
    """albedo_scale.whites of solve.json: of a whites_statement, log_factor [3] and covariance [3, 3], and the number of
    places that it is about."""
    return {
        "places": places,
        "albedo": np.round(USUAL_ALBEDO * np.exp(log_factor), 4).tolist(),
        "usual": USUAL_ALBEDO,
        "log_sigma": round(float(np.sqrt(covariance.mean())), 4),
    }
