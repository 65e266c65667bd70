"""How far lids are off, on openings whose borders are known."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import FACING, two_balls

from shared.geometry.raycast import RayScene
from shared.geometry.transforms import camera_centres, rigid
from tools.scoring.lid_margins import (
    LEAST_PIXELS,
    border_offsets,
    lid_margin_errors,
    opening_of_result,
    opening_of_truth,
)

LENS, DEPTH_MM = np.array([[900.0, 0, 100], [0, 900.0, 50], [0, 0, 1]]), 400.0
POSE = rigid(FACING, np.array([0.0, 0.0, DEPTH_MM]))
CENTRES, RADIUS = np.array([[-25.0, 0.0, 0.0], [25.0, 0.0, 0.0]]), 12.0
SKIN_MM, HOLE_MM = 13.0, 7.0
"""A plane of skin so far before the eyes' centres, and the radius of its holes."""


def disc(radius: float, middle: tuple[float, float] = (60.0, 60.0)) -> np.ndarray:
    row, column = np.indices((120, 120))
    return np.hypot(row + 0.5 - middle[0], column + 0.5 - middle[1]) < radius


def rays(shape: tuple[int, int] = (100, 200)) -> np.ndarray:
    v, u = np.indices(shape) + 0.5
    return np.stack([(u - 100) / 900, (v - 50) / 900, np.ones_like(u)], -1)


def true_depth() -> np.ndarray:
    """[H, W] mm: balls behind skin with a round hole before each, closed form."""
    ray = rays()
    unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    depth = np.full(ray.shape[:2], DEPTH_MM - SKIN_MM)
    for centre in CENTRES:
        away = POSE[:3, :3] @ centre + POSE[:3, 3]
        along = unit @ away
        squared = RADIUS**2 - away @ away + along**2
        front = (along - np.sqrt(np.maximum(squared, 0.0))) * unit[..., 2]
        hole = np.linalg.norm((ray * (DEPTH_MM - SKIN_MM) - away)[..., :2], axis=-1) < HOLE_MM
        depth[hole] = front[hole]
    return depth


def test_like_openings_are_not_apart():
    assert border_offsets(disc(30.0), disc(30.0)).max() == 0.0


@pytest.mark.parametrize("wider", [3.0, 0.3, -0.3, -2.0])
def test_an_opening_is_off_by_how_much_wider_or_narrower_it_is(wider):
    """To a tenth of a pixel in the mean, and to what the few pixels of a sector tell."""
    offsets = border_offsets(disc(30.0), disc(30.0 + wider))
    assert offsets.mean() == pytest.approx(abs(wider) * (1.0 + wider / 60.0), abs=0.1)
    np.testing.assert_allclose(offsets, abs(wider), atol=0.35)


def test_a_shifted_opening_is_off_along_its_way():
    offsets = border_offsets(disc(30.0), disc(30.0, (60.0, 64.0)))
    assert offsets.mean() == pytest.approx(4.0 * 2.0 / np.pi, abs=0.1)  # |cos| over a circle
    assert offsets.min() < 0.6 and offsets.max() == pytest.approx(4.0, abs=0.5)


def test_sectors_of_a_narrow_opening_are_told_apart():
    """An ellipse whose upper half is moved up by two pixels: sectors of the lower half are not off."""
    row, column = np.indices((120, 120)) + 0.5
    truth = np.hypot((column - 60.0) / 40.0, (row - 60.0) / 12.0) < 1.0
    found = truth | (np.hypot((column - 60.0) / 40.0, (row - 58.0) / 12.0) < 1.0) & (row < 60.0)
    offsets = np.sort(border_offsets(truth, found))
    assert offsets[7] < 0.1 and np.median(offsets[8:]) == pytest.approx(2.0, abs=0.3)


def test_openings_of_truth_and_result_are_where_the_eyeballs_are_seen():
    depth = true_depth()
    for centre in CENTRES:
        seen = opening_of_truth(depth, POSE, LENS, centre, RADIUS)
        assert seen.sum() == pytest.approx(np.pi * (HOLE_MM * 900 / (DEPTH_MM - SKIN_MM)) ** 2, rel=0.05)
        assert seen[50, int(100 + 900 * centre[0] / DEPTH_MM)]
    surface = two_balls(CENTRES, RADIUS)
    scene = RayScene(surface.mesh.vertices, surface.mesh.faces)
    right = surface.mesh.vertices[surface.mesh.faces[:, 0], 0] < 0
    found = opening_of_result(scene, surface.faces_of(("eyes",)), POSE, LENS, (200, 100))
    assert found.sum() == pytest.approx(2 * np.pi * (RADIUS * 900 / DEPTH_MM) ** 2, rel=0.03)
    only = opening_of_result(scene, right, POSE, LENS, (200, 100))
    assert (only == found & (np.arange(200) < 100)).all()


def test_errors_are_in_millimetres_of_openings_that_show_a_border():
    nothing = np.zeros((120, 120), bool)
    errors = lid_margin_errors([(disc(30.0), disc(32.0), 0.5), (disc(30.0), nothing, 0.5)])
    assert errors["openings"] == 1 and errors["mean"] == pytest.approx(1.0, abs=0.1)
    assert disc(1.5).sum() < LEAST_PIXELS and lid_margin_errors([(disc(1.5), disc(30.0), 1.0)]) is None
    assert np.allclose(camera_centres(POSE[None])[0], [0.0, 0.0, DEPTH_MM])
