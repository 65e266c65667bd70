"""Edges of cast shadows: on a floor under a hovering square their place is known."""

import numpy as np
import pytest
from quick import TINY
from shapes import grid_plane

from shared.geometry.mesh import Mesh
from shared.geometry.transforms import rigid
from shared.io.images import read_exr, write_exr
from tools.scoring.shadows import (
    LAMP_COSINE,
    LitMesh,
    lamp_direction,
    near_shadow_edges,
    shadow_edge_residual,
    share_of_residual,
)

FLOOR_MM, SQUARE_MM, HEIGHT_MM = 250.0, 40.0, 60.0
SIZE, FOCAL, DISTANCE = 300, 2700.0, 1800.0
PIXEL_MM2 = (DISTANCE / FOCAL) ** 2
LENS = np.array([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]])
ABOVE = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, DISTANCE]))
LAMP = np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)


def under_a_square() -> Mesh:
    """A floor that faces +z, and a small square above it."""
    floor, square = grid_plane(9, FLOOR_MM), grid_plane(3, SQUARE_MM)
    vertices = np.concatenate([floor.vertices, square.vertices + [0.0, 0.0, HEIGHT_MM]])
    faces = np.concatenate([floor.faces, square.faces + len(floor.vertices)])
    return Mesh(vertices, faces, np.concatenate([floor.uvs, square.uvs]), faces)


@pytest.fixture(scope="module")
def seen():
    """From straight above; the lamp stands at 45 degrees, so that the shadow falls HEIGHT_MM beside the square."""
    return LitMesh(under_a_square()).seen(ABOVE, LENS, (SIZE, SIZE), LAMP)


def test_the_shadow_lies_where_the_lamp_throws_it(seen):
    dark = seen.points[seen.facing & ~seen.lit]
    assert dark[:, 0].min() == pytest.approx(-HEIGHT_MM - SQUARE_MM / 2, abs=1.0)
    assert dark[:, 0].max() == pytest.approx(-HEIGHT_MM + SQUARE_MM / 2, abs=1.0)
    assert np.abs(dark[:, 1]).max() == pytest.approx(SQUARE_MM / 2, abs=1.0)
    assert seen.facing.all() and len(dark) * PIXEL_MM2 == pytest.approx(SQUARE_MM**2, rel=0.05)


def test_points_near_its_edge_are_found_and_no_others(seen):
    """A seam of 6 mm along all four sides, with rounded corners outside; none along the square's own outline."""
    near, x, y = near_shadow_edges(seen), seen.points[..., 0] + HEIGHT_MM, seen.points[..., 1]
    outside = np.hypot(np.maximum(np.abs(x) - SQUARE_MM / 2, 0), np.maximum(np.abs(y) - SQUARE_MM / 2, 0))
    inside = SQUARE_MM / 2 - np.maximum(np.abs(x), np.abs(y))
    distance = np.where(inside > 0, inside, outside)
    assert near[(distance < 2.0)].all() and not near[distance > 4.2].any()
    seam = 8 * 3.0 * SQUARE_MM - 4 * 9.0 + 9.0 * np.pi
    assert near.sum() * PIXEL_MM2 == pytest.approx(seam, rel=0.05)


def test_an_even_residual_lies_there_in_proportion_to_the_area(seen):
    near = near_shadow_edges(seen).ravel()
    assert share_of_residual(np.full((near.size, 3), -0.2), near) == pytest.approx(near.mean())
    assert share_of_residual(np.where(near, 2.0, 0.0), near) == 1.0
    assert share_of_residual(np.zeros(near.size), near) == 0.0


def test_without_a_shadow_there_is_no_edge():
    lit = LitMesh(grid_plane(9, FLOOR_MM)).seen(ABOVE, LENS, (SIZE, SIZE), LAMP)
    assert lit.lit.all() and not near_shadow_edges(lit).any()
    turned_away = LitMesh(grid_plane(9, FLOOR_MM)).seen(ABOVE, LENS, (SIZE, SIZE), -LAMP)
    assert not turned_away.facing.any() and not near_shadow_edges(turned_away).any()


def test_the_lamp_is_the_middle_of_the_brightest_place():
    light = np.full((32, 64, 3), 0.1)
    light[9:12, 19:22] = 8.0
    light[10, 50] = 7.0
    polar, azimuth = np.pi * 10.5 / 32, 2 * np.pi * 20.5 / 64
    middle = [np.sin(azimuth) * np.sin(polar), np.cos(polar), -np.cos(azimuth) * np.sin(polar)]
    found = lamp_direction(light)
    assert found @ middle > np.cos(np.radians(0.5)) and np.linalg.norm(found) == pytest.approx(1.0)
    assert LAMP_COSINE < 1.0


def test_frames_that_are_rendered_again_are_judged(tmp_path):
    """The tiny subject's own picture with an error that is the same everywhere."""
    (tmp_path / "renders").mkdir()
    assert shadow_edge_residual(TINY, tmp_path)["frames"] == 0
    (stem,) = {path.name.split("_")[0] for path in (TINY / "gt" / "frames").glob("*_radiance.exr")}
    truth = read_exr(TINY / "gt" / "frames" / f"{stem}_radiance.exr")
    code = np.clip(truth, 0.0, 1.0)
    write_exr(tmp_path / "renders" / f"{stem}.exr", (0.8 * code).astype(np.float32), colour_space="data")
    found = shadow_edge_residual(TINY, tmp_path)
    assert found["frames"] == 1 and 0.0 < found["pixels"] < 0.3 and 0.0 < found["residual"] < 0.3
