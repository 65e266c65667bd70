"""How far out hair reaches, by the outlines of a clip's frames: a visual hull, smooth where no outline tells.

Along a ray of the grid a frame says where the person ends [Laurentini1994]. Where the surface is seen edge-on there
hair ends, too; elsewhere it ends somewhere before. What frames say so is met by the smoothest surface (least bending)
that stays outside the neck.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from shared.geometry.mesh import normalised
from shared.geometry.transforms import camera_centres, project
from shared.hair.shell_grid import ShellGrid
from shared.imaging.image_sampling import remap
from shared.imaging.views import Views

FARTHEST_MM, STEP_MM = 90.0, 3.0
EDGE_ON, WIDEST = 0.18, 0.4
"""Cosine to the view at which a place counts by 1 / e as seen edge-on, and from which on it doesn't count."""
FIRST_MM, LEAST_MM = 8.0, 1.0
"""Thickness to begin with, and the least."""
QUANTILE, LEAST_WEIGHT = 0.3, 0.02
"""Of what edge-on frames say, since each says at least so much; and the mean weight below which nobody does."""
BENDING, PULL = 0.4, 3e-3
"""Weights of bending and of what hair is expected to do, beside that of one outline seen in all frames."""
ROUNDS, OUTSIDE = 3, 3.0
"""Of the surface's normals; weight of the neck where hair would lie within. On the skull it is the head that gives way:
what hair hides of it nobody has seen."""


def hull_radius(grid: ShellGrid, solids: Mapping[int, np.ndarray], views: Views,
                held: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """[R, C] mm along the grid's rays to the shell, and how much frames say of it [R, C]. solids {frame: [H, W]
    float32}: where the person is, clothes left out, 1, or not, 0; held [R, C] bool: where it lies on the head."""
    radius, said = grid.base + FIRST_MM, np.zeros(grid.base.shape)
    for _ in range(ROUNDS):
        ends, weights = [], []
        for f, solid in solids.items():
            end, weight = _said_by_frame(grid, radius, solid, views.camera_from_head[f], views.intrinsics[f])
            ends.append(end)
            weights.append(weight)
        thickness, said = _lowest(np.stack(ends), np.stack(weights))
        radius = _smoothest(grid, thickness, said, held)
    return radius, said


def _said_by_frame(grid: ShellGrid, radius: np.ndarray, solid: np.ndarray, pose: np.ndarray, lens: np.ndarray
                   ) -> tuple[np.ndarray, np.ndarray]:
    """Thickness [R, C] mm at which rays leave the person in a frame, and its weight [R, C]: 0 where they don't, or are
    not seen edge-on."""
    places = grid.at(radius)
    towards = normalised(camera_centres(pose[None])[0] - places)
    cosine = (grid.normals(radius) * towards).sum(-1)
    thickness, weight = np.zeros(cosine.shape), np.zeros(cosine.shape)
    steps = np.arange(0.0, FARTHEST_MM, STEP_MM)
    row, column = np.nonzero(np.abs(cosine) < WIDEST)
    along = grid.base[row, column, None] + steps
    starts, rays = grid.centres[row, column], grid.rays[row, column]
    pixels, depth = project((starts[:, None] + along[..., None] * rays[:, None]).reshape(-1, 3), pose, lens)
    height, width = solid.shape
    inside = ((pixels > 1.0) & (pixels < [width - 1.0, height - 1.0])).all(1).reshape(along.shape)
    share = remap(solid, pixels).reshape(along.shape)
    beside = share < 0.5
    first = beside.argmax(1)
    n = np.arange(len(first))
    ends = beside.any(1) & inside[n, first] & (first > 0)
    before, after = share[n, np.maximum(first - 1, 0)], share[n, first]
    cut = steps[np.maximum(first - 1, 0)] + STEP_MM * (before - 0.5) / np.maximum(before - after, 1e-6)
    never = beside[:, 0] & inside[:, 0] & (row < grid.domed)  # lower down it only says that no hair hangs there
    thickness[row, column] = np.where(never, 0.0, cut)
    weight[row, column] = np.where(ends | never, np.exp(-np.square(cosine[row, column] / EDGE_ON)), 0.0)
    return thickness, weight


def _lowest(ends: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[F, R, C] -> a low quantile of what frames say, and their mean weight, [R, C]."""
    told = np.where(weights > 0.0, ends, np.inf)
    order = np.argsort(told, axis=0)
    sums = np.cumsum(np.take_along_axis(weights, order, 0), axis=0)
    place = (sums >= QUANTILE * np.maximum(sums[-1:], 1e-9)).argmax(0)
    found = np.take_along_axis(np.take_along_axis(told, order, 0), place[None], 0)[0]
    said = np.where(np.isfinite(found), weights.mean(0), 0.0)
    return np.where(np.isfinite(found), found, 0.0), np.where(said > LEAST_WEIGHT, said, 0.0)


def _smoothest(grid: ShellGrid, thickness: np.ndarray, said: np.ndarray, held: np.ndarray | None) -> np.ndarray:
    """[R, C] mm: the radius that bends least, near base + thickness [R, C] as far as that is said [R, C]. Unsaid, hair
    is as thick as in the middle, and hangs straight down."""
    told = said[: grid.domed] > 0
    usual = float(np.median(thickness[: grid.domed][told])) if told.any() else FIRST_MM
    expected = grid.base + usual
    expected[grid.domed:] = expected[grid.domed - 1]
    known, right = said + PULL, said * (grid.base + thickness) + PULL * expected
    if held is not None:
        known, right = np.where(held, 1.0, known), np.where(held, grid.base + LEAST_MM, right)
    low = np.zeros_like(thickness)
    radius = grid.base
    for _ in range(ROUNDS):
        total = known + low
        radius = grid.smoothest((right + low * (grid.base + LEAST_MM)) / total, total, BENDING)
        low[grid.domed:] = np.where(radius < grid.base + LEAST_MM, OUTSIDE, low)[grid.domed:]
    return radius
