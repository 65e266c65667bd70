"""Procedural light: lat-long environment maps, and the two ways in which the tracer samples them.

An environment is split in two: what exceeds `LAMP_THRESHOLD` times the mean (lamps, windows, the sun) is sampled by
importance, the smooth rest by uniform or lobe-shaped directions. The two parts add up to the map exactly, so nothing is
lost and neither part is noisy. Lamps may stand at a distance (LampSphere); the smooth rest is always far away.

References: Pharr, Jakob and Humphreys, Physically Based Rendering, 4th ed., 12.5 (sampling of infinite area lights).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from shared.compute.smooth_step import smooth_step
from shared.rendering.envmap import latlong_directions, latlong_lookup

LAMP_THRESHOLD = 3.0
TABLE_HEIGHT = 256
IRRADIANCE_ROWS, IRRADIANCE_COLUMNS = 49, 96


@dataclass(frozen=True)
class LampSphere:
    """Where near lamps stand: each in its direction, distance_mm from one centre [3] mm. A lamp is small and shines
    alike to all sides; the map says what of it arrives at the centre."""

    centre: np.ndarray
    distance_mm: float

    def seen_from(self, points: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lamps in the directions [K, 3], or [N, K, 3], as points [N, 3] mm see them: unit directions [N, K, 3], and
        what arrives there of one relative to what arrives at the centre, (distance from the centre / from the point)^2
        [N, K]. All in the centre's space."""
        towards = directions + ((self.centre - points) / self.distance_mm)[:, None]
        square = np.square(towards).sum(-1)
        return (towards / np.sqrt(square)[..., None]).astype(np.float32), (1.0 / square).astype(np.float32)

    def met_by(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Rays from points [N, 3] mm within the sphere along unit directions [N, 3] -> unit directions [N, 3] in which
        its centre sees where they meet it."""
        arm = (points - self.centre) / self.distance_mm
        along = (arm * directions).sum(1)
        way = np.sqrt(np.maximum(along**2 + 1.0 - (arm**2).sum(1), 0.0)) - along
        return arm + way[:, None] * directions


class EnvironmentLight:
    """Incident radiance: image [H, 2 H, 3], linear, read bilinearly; directions are in world space. lamps_at: where its
    lamps stand in world space, None: far away; the image is what arrives at the centre of these then."""

    def __init__(self, image: np.ndarray, lamps_at: LampSphere | None = None):
        self.lamps_at = lamps_at
        self.image = np.asarray(image, np.float32)
        self._table = latlong_lookup(self.image, latlong_directions(TABLE_HEIGHT)).astype(np.float32)
        edges = np.cos(np.pi * np.arange(TABLE_HEIGHT + 1) / TABLE_HEIGHT)
        self._solid_angle = (edges[:-1] - edges[1:]) * np.pi / TABLE_HEIGHT
        luminance = self._table.mean(-1)
        mean = (luminance.mean(1) * self._solid_angle).sum() * 2 * TABLE_HEIGHT / (4 * np.pi)
        share = np.minimum(1.0, LAMP_THRESHOLD * mean / np.maximum(luminance, 1e-12))[..., None]
        self._smooth = (self._table * share).astype(np.float32)
        self._lamps = self._table - self._smooth
        self._lamp_irradiance = self._integrate_lamps()

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """[..., 3] unit directions -> [..., 3] all of the light."""
        return self._look_up(self._table, directions)

    def smooth_radiance(self, directions: np.ndarray) -> np.ndarray:
        """[..., 3] unit directions -> [..., 3] the light without the excess of its lamps."""
        return self._look_up(self._smooth, directions)

    def lamp_radiance(self, directions: np.ndarray) -> np.ndarray:
        """[..., 3] unit directions -> [..., 3] the excess of the lamps alone."""
        return self._look_up(self._lamps, directions)

    def lamp_irradiance(self, normals: np.ndarray) -> np.ndarray:
        """[..., 3] unit normals in world space -> [..., 3] irradiance of the lamps when nothing blocks them."""
        return self._look_up(self._lamp_irradiance, normals)

    def main_lamp(self) -> np.ndarray:
        """[3] unit world direction of the strongest lamp: the mean of what shines within 30 degrees of the brightest.
        """
        directions = latlong_directions(TABLE_HEIGHT)
        power = self._lamps.mean(-1) * self._solid_angle[:, None]
        brightest = directions.reshape(-1, 3)[self._lamps.mean(-1).argmax()]
        mean = (power * (directions @ brightest > np.cos(np.radians(30.0)))).ravel() @ directions.reshape(-1, 3)
        return mean / np.linalg.norm(mean)

    def _integrate_lamps(self) -> np.ndarray:
        """Lat-long table of lamp_irradiance: every lamp pixel on every normal of a coarse grid, then interpolated.

        The grid's first and last rows are the poles themselves, so that no row has to be extrapolated.
        """
        row, column = np.nonzero(self._lamps.max(-1) > 0)
        directions = latlong_directions(TABLE_HEIGHT)[row, column].astype(np.float32)
        power = self._lamps[row, column] * self._solid_angle[row, None].astype(np.float32)
        polar = np.linspace(0, np.pi, IRRADIANCE_ROWS)
        azimuth = np.arange(IRRADIANCE_COLUMNS) * (2 * np.pi / IRRADIANCE_COLUMNS)
        normals = _spherical(polar[:, None], azimuth[None]).astype(np.float32)
        coarse = np.stack([np.maximum(line @ directions.T, 0) @ power for line in normals])
        rows = (np.arange(TABLE_HEIGHT) + 0.5) / TABLE_HEIGHT * (IRRADIANCE_ROWS - 1)
        columns = (np.arange(2 * TABLE_HEIGHT) + 0.5) / (2 * TABLE_HEIGHT) * IRRADIANCE_COLUMNS
        grid = np.meshgrid(rows, columns, indexing="ij")
        fine = [map_coordinates(coarse[..., k], grid, order=1, mode="grid-wrap") for k in range(3)]
        return np.stack(fine, -1).astype(np.float32)

    @staticmethod
    def _look_up(table: np.ndarray, directions: np.ndarray) -> np.ndarray:
        u = np.arctan2(directions[..., 0], -directions[..., 2]) * np.float32(TABLE_HEIGHT / np.pi)
        v = np.arccos(np.clip(directions[..., 1], -1.0, 1.0)) * np.float32(TABLE_HEIGHT / np.pi)
        column = np.floor(u).astype(np.int32) % (2 * TABLE_HEIGHT)
        return table[np.minimum(v.astype(np.int32), TABLE_HEIGHT - 1), column]

    def sample_lamps(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points [N, 2] of the unit square -> world directions [N, 3] and radiance over density [N, 3].

        The mean of f(direction) * weight over well spread points estimates the integral of f times the lamps' light.
        Without lamps the weights are zero.
        """
        power = self._lamps.mean(-1) * self._solid_angle[:, None]
        total = power.sum()
        if total <= 0:
            return np.tile([0.0, 1.0, 0.0], (len(points), 1)), np.zeros((len(points), 3))
        row, row_part = _invert(power.sum(1) / total, points[:, 0])
        conditional = power[row] / power[row].sum(1, keepdims=True)
        column, column_part = (np.array(x) for x in zip(*map(_invert_one, conditional, points[:, 1]), strict=True))
        # Within a row the density is uniform in the cosine of the polar angle.
        edges = np.cos(np.pi * np.arange(TABLE_HEIGHT + 1) / TABLE_HEIGHT)
        up = edges[row] + (edges[row + 1] - edges[row]) * row_part
        azimuth = (column + column_part) * np.pi / TABLE_HEIGHT
        directions = _spherical(np.arccos(np.clip(up, -1.0, 1.0)), azimuth)
        density = power[row, column] / total / self._solid_angle[row]
        return directions, self._lamps[row, column] / density[:, None]


def _spherical(polar: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Unit directions [..., 3] of a lat-long map's angles: polar from +y, azimuth 2 pi u."""
    polar, azimuth = np.broadcast_arrays(polar, azimuth)
    ring = np.sin(polar)
    return np.stack([np.sin(azimuth) * ring, np.cos(polar), -np.cos(azimuth) * ring], -1)


def _invert(probability: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cell and position within it, in [0, 1), of each point under a discrete distribution [K]."""
    cumulative = np.concatenate([[0.0], np.cumsum(probability)])
    cumulative /= cumulative[-1]
    cell = np.clip(np.searchsorted(cumulative, points, side="right") - 1, 0, len(probability) - 1)
    width = np.maximum(cumulative[cell + 1] - cumulative[cell], 1e-30)
    return cell, np.clip((points - cumulative[cell]) / width, 0.0, 1.0)


def _invert_one(probability: np.ndarray, point: float) -> tuple[int, float]:
    cell, part = _invert(probability, np.array([point]))
    return int(cell[0]), float(part[0])


def procedural_environment(name: str, seed: int, height: int = 64) -> np.ndarray:
    """[height, 2 height, 3] float32 radiance of a made-up place; name: one of ENVIRONMENTS. Scale is arbitrary."""
    rng = np.random.default_rng([seed, *name.encode()])
    directions = latlong_directions(height, 4)
    fine = ENVIRONMENTS[name](directions, rng)
    blocks = fine.reshape(height, 4, 2 * height, 4, 3).mean((1, 3))
    return np.maximum(blocks, 0.0).astype(np.float32)


def _room(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A room: pale walls and a warm floor, a window at the side, a ceiling lamp, a reading lamp on the other side."""
    light = _gradient(directions, floor=(0.12, 0.095, 0.07), horizon=(0.22, 0.20, 0.18), zenith=(0.30, 0.29, 0.28))
    light *= _clouds(directions, rng, strength=0.35)
    side = rng.choice([-1.0, 1.0])
    light += _panel(directions, side * rng.uniform(45, 65), rng.uniform(8, 18), 40, 52) * [6.6, 7.2, 8.0]
    light += _panel(directions, rng.uniform(-30, 30), 72, 44, 24) * [2.6, 2.35, 2.0]
    light += _disc(directions, -side * rng.uniform(60, 80), rng.uniform(0, 25), 11) * [6.0, 4.2, 2.6]
    light += _panel(directions, 180 + side * 35, 5, 50, 34) * [0.9, 0.8, 0.7]
    return light


def _studio(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A dark grey studio: a large key light, a weaker fill and a rim light from behind."""
    light = _gradient(directions, floor=(0.06, 0.06, 0.06), horizon=(0.11, 0.11, 0.115), zenith=(0.10, 0.10, 0.11))
    side = rng.choice([-1.0, 1.0])
    light += _panel(directions, side * rng.uniform(35, 50), rng.uniform(22, 32), 42, 42) * [7.5, 7.3, 7.0]
    light += _panel(directions, -side * rng.uniform(45, 60), 5, 50, 60) * [1.3, 1.4, 1.6]
    light += _panel(directions, 180 - side * 50, 25, 24, 50) * [3.0, 3.0, 3.2]
    return light


def _sky(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Outdoors: clouded sky over grass and earth with a low, hazy sun."""
    light = _gradient(directions, floor=(0.13, 0.12, 0.07), horizon=(0.95, 0.93, 0.90), zenith=(0.42, 0.58, 0.85))
    above = np.clip(directions[..., 1:2] * 3.0, 0.0, 1.0)
    light *= 1.0 + above * (_clouds(directions, rng, strength=0.7) - 1.0)
    light += _disc(directions, rng.uniform(25, 55) * rng.choice([-1.0, 1.0]), rng.uniform(25, 40), 4) * [60, 52, 40]
    return light


def _lamp(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One small strong lamp at the side in a nearly dark room: half of the face black, cast shadows with hard edges."""
    light = np.full((*directions.shape[:-1], 3), 0.02)
    side = rng.choice([-1.0, 1.0])
    light += _disc(directions, side * rng.uniform(66, 74), rng.uniform(10, 25), 4) * [260.0, 245.0, 220.0]
    return light


def _cap(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A lamp above the forehead and nothing else, as on a cap or a helmet."""
    return _disc(directions, 0.0, 40.0, 7) * [60.0, 58.0, 54.0]


def _even(directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Nearly the same from all sides, as between white sheets: a little brighter above than below."""
    return _gradient(directions, floor=(0.85, 0.84, 0.83), horizon=(1.0, 1.0, 1.0), zenith=(1.1, 1.1, 1.1))


ENVIRONMENTS = {"room": _room, "studio": _studio, "sky": _sky, "lamp": _lamp, "cap": _cap, "even": _even}


def _gradient(directions: np.ndarray, floor: tuple, horizon: tuple, zenith: tuple) -> np.ndarray:
    """Colour by height: floor below, blending into the horizon, then up to the zenith."""
    up = directions[..., 1:2]
    below = np.clip(0.5 - up * 4.0, 0.0, 1.0)
    above = np.clip(up, 0.0, 1.0)
    return below * np.array(floor) + (1 - below) * ((1 - above) * np.array(horizon) + above * np.array(zenith))


def _clouds(directions: np.ndarray, rng: np.random.Generator, strength: float) -> np.ndarray:
    """[..., 1] soft random pattern around 1: a few octaves of plane waves over the sphere."""
    pattern = np.zeros(directions.shape[:-1])
    for octave in range(4):
        for _ in range(5):
            wave = rng.normal(size=3) * 2.2 * 1.8**octave
            pattern += np.sin(directions @ wave + rng.uniform(0, 2 * np.pi)) / (1.6**octave * 5)
    return np.exp(strength * pattern)[..., None]


def _frame(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Rows right, up, forward of a lamp; azimuth 0 is in front of the face, positive to the right."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    forward = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    return np.stack([right, np.cross(forward, right), forward])


def _panel(directions: np.ndarray, azimuth_deg: float, elevation_deg: float, width_deg: float,
           height_deg: float) -> np.ndarray:
    """[..., 1] rectangular area light, 1 inside, with an edge about 3 degrees soft."""
    local = directions @ _frame(azimuth_deg, elevation_deg).T
    angle = np.degrees(np.arctan2(local[..., :2], np.maximum(local[..., 2:], 1e-3)))
    inside = _ramp(0.5 * np.array([width_deg, height_deg]) - np.abs(angle)).prod(-1)
    return np.where(local[..., 2] > 0.05, inside, 0.0)[..., None]


def _disc(directions: np.ndarray, azimuth_deg: float, elevation_deg: float, radius_deg: float) -> np.ndarray:
    """[..., 1] round lamp, 1 inside."""
    cosine = directions @ _frame(azimuth_deg, elevation_deg)[2]
    return _ramp(radius_deg - np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))[..., None]


def _ramp(inside_deg: np.ndarray) -> np.ndarray:
    return smooth_step(inside_deg / 3.0 + 0.5)
