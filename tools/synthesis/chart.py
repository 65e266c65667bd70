"""A colour chart beside the synthetic head: a matte plane that stands still before the camera, in the same light.

Its irradiance is traced per shot: the light that the head does not block, and what the head reflects onto it. What the
chart takes from the head and reflects onto it is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from shared.capture.chart import COLUMNS, CORNERS, PATCHES, ROWS, reflectances
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import (
    camera_centres,
    fibonacci_sphere,
    pixel_rays,
    project,
    rigid,
    rotation_from_vector,
)
from shared.imaging.texture import sample_bilinear
from tools.synthesis.irradiance import SyntheticShot
from tools.synthesis.light import EnvironmentLight
from tools.synthesis.sampling import shifted_hammersley
from tools.synthesis.surface import SyntheticSurface

PITCH_MM, GAP, BORDER = 25.0, 0.12, 0.3
"""Distance of the patches, the gap between them and the border around them (both in pitches)."""
FRAME_REFLECTANCE = 0.03
BESIDE_MM = 175.0
NODES = (7, 5)
DIRECTIONS, LAMP_SAMPLES = 2048, 64


@dataclass(frozen=True)
class PlacedChart:
    """camera_from_chart [4, 4]: the chart's x along the rows, y down, z away from the viewer; origin in its middle."""

    camera_from_chart: np.ndarray

    def points(self, grid: np.ndarray) -> np.ndarray:
        """Grid coordinates [N, 2] (see shared.capture.chart) -> [N, 3] mm in camera space."""
        flat = (grid - [COLUMNS / 2, ROWS / 2]) * PITCH_MM
        return np.column_stack([flat, np.zeros(len(flat))]) @ self.camera_from_chart[:3, :3].T + (
            self.camera_from_chart[:3, 3])


def place_chart(distance_mm: float, height_mm: float, seed: int) -> PlacedChart:
    """Beside the head at its depth, facing the camera but for some degrees; height_mm: as of head.head_turn."""
    rng = np.random.default_rng([seed, 4])
    place = np.array([BESIDE_MM, height_mm - 15.0, distance_mm - 20.0])
    towards = np.arctan2(place[0], place[2])  # turning about y by this makes the normal point at the camera
    nod, turn, roll = np.radians(rng.uniform(-1.0, 1.0, 3) * [8.0, 14.0, 6.0])
    rotation = rotation_from_vector(np.array([0.0, towards + turn, 0.0])) @ rotation_from_vector(
        np.array([nod, 0.0, 0.0])) @ rotation_from_vector(np.array([0.0, 0.0, roll]))
    return PlacedChart(rigid(rotation, place))


def add_chart(picture: np.ndarray, chart: PlacedChart, surface: SyntheticSurface, light: EnvironmentLight,
              irradiance: np.ndarray,
              shot: SyntheticShot, intrinsics: np.ndarray, sub: int) -> None:
    """Draws the chart into a shot's radiance [H, W, 3], behind the head where that hides it; sub^2 rays per pixel.

    irradiance [size, size, 3]: of the head in this shot.
    """
    height, width = picture.shape[:2]
    outline = CORNERS + BORDER * np.sign(CORNERS - [COLUMNS / 2, ROWS / 2])
    pixels, _ = project(chart.points(outline), np.eye(4), intrinsics)
    low = np.clip(np.floor(pixels.min(0)), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(pixels.max(0)), 0, [width, height]).astype(int)
    box = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), -1)
    white = chart_irradiance(chart, surface, light, irradiance, shot) / np.pi
    seen, colour = np.zeros(box.shape[:2]), np.zeros((*box.shape[:2], 3))
    for offset in np.ndindex(sub, sub):
        points = box.reshape(-1, 2) + (np.array(offset[::-1]) + 0.5) / sub
        covered, values = _shade(chart, surface.scene, white, shot, intrinsics, points)
        seen += covered.reshape(seen.shape)
        colour += values.reshape(colour.shape)
    part = picture[low[1]:high[1], low[0]:high[0]]
    part *= (1.0 - seen / sub**2)[..., None]
    part += colour / sub**2


def _shade(chart: PlacedChart, head: RayScene, white: np.ndarray, shot: SyntheticShot, intrinsics: np.ndarray,
           pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image points [N, 2] -> bool [N], whether the chart is seen there, and its radiance [N, 3] (0 elsewhere)."""
    rays = pixel_rays(pixels, intrinsics)
    rotation, origin = chart.camera_from_chart[:3, :3], chart.camera_from_chart[:3, 3]
    normal = rotation[:, 2]
    depth = (origin @ normal) / (rays @ normal)
    grid = ((rays * depth[:, None] - origin) @ rotation)[:, :2] / PITCH_MM + [COLUMNS / 2, ROWS / 2]
    covered = ((grid > -BORDER) & (grid < np.array([COLUMNS, ROWS]) + BORDER)).all(1)
    directions = (rays[covered] @ shot.camera_from_head[:3, :3]).astype(np.float32)
    origins = np.broadcast_to(camera_centres(shot.camera_from_head), directions.shape)
    _, _, distance = head.intersect(origins, directions)
    covered[covered] = ~(distance < depth[covered])
    cell = np.floor(grid).astype(int)
    in_patch = covered & (np.abs(grid - cell - 0.5) < 0.5 - GAP / 2).all(1)
    in_patch &= ((cell >= 0) & (cell < [COLUMNS, ROWS])).all(1)
    reflectance = np.where(covered, FRAME_REFLECTANCE, 0.0)[:, None] * np.ones(3)
    patch = np.clip(cell[:, 1] * COLUMNS + cell[:, 0], 0, PATCHES - 1)
    reflectance[in_patch] = np.maximum(reflectances(), 0.0)[patch[in_patch]]
    place = np.clip(grid / [COLUMNS, ROWS], 0.0, 1.0)[:, ::-1] * (np.array(NODES[::-1]) - 1)
    lit = np.stack([map_coordinates(white[..., c], place.T, order=1) for c in range(3)], -1)
    return covered, reflectance * lit


def chart_irradiance(chart: PlacedChart, surface: SyntheticSurface, light: EnvironmentLight, irradiance: np.ndarray,
                     shot: SyntheticShot) -> np.ndarray:
    """[5, 7, 3] irradiance at evenly spread points of the grid."""
    columns, rows = (np.linspace(0, length, count) for length, count in zip((COLUMNS, ROWS), NODES, strict=True))
    grid = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    turn, shift = shot.camera_from_head[:3, :3], shot.camera_from_head[:3, 3]
    origins = ((chart.points(grid) - shift) @ turn).astype(np.float32)
    normal = -chart.camera_from_chart[:3, 2] @ turn
    world = shot.world_from_head
    directions = fibonacci_sphere(DIRECTIONS)
    directions = directions[directions @ normal > 0].astype(np.float32)
    samples, weights = light.sample_lamps(shifted_hammersley(LAMP_SAMPLES, 1, np.random.default_rng(shot.seed))[0])
    samples = (samples @ world).astype(np.float32)
    exact = light.lamp_irradiance(world @ normal)
    sent = np.maximum(samples @ normal, 0.0)[:, None] * weights
    total = np.zeros((len(grid), 3))
    for k, origin in enumerate(origins):
        index, uv, free = surface.hits(np.broadcast_to(origin, directions.shape), directions)
        incident = np.where(free[:, None], light.smooth_radiance(directions @ world.T.astype(np.float32)), 0.0)
        incident[index] = surface.albedo(uv) * sample_bilinear(irradiance, uv) / np.pi
        total[k] = (incident * (directions @ normal)[:, None]).sum(0) * (4 * np.pi / DIRECTIONS)
        open_to = ~surface.scene.occluded(np.broadcast_to(origin, samples.shape), samples)
        total[k] += exact * (sent[open_to].sum(0) / np.maximum(sent.sum(0), 1e-12))
    return total.reshape(NODES[1], NODES[0], 3)
