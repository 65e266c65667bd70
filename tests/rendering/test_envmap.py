"""Cubemap and lat-long geometry: layout, solid angles, seamless look-ups, and one format from the other."""

import numpy as np
import pytest

from shared.geometry.transforms import fibonacci_sphere, rotation_from_vector
from shared.rendering.envmap import (
    cube_directions,
    cube_face_coordinates,
    cube_from_latlong,
    cube_lookup,
    cube_smoothness,
    cube_solid_angles,
    cube_texel,
    lamp_solid_angle,
    lamp_texels,
    latlong_directions,
    latlong_from_cube,
    latlong_lookup,
)
from shared.rendering.shading import light_along


def smooth_light(directions):
    """[..., 3] -> [..., 3] radiance without symmetry, of low frequency."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack([1.0 + 0.5 * x, 1.0 + 0.3 * y * z, 1.2 + 0.4 * z - 0.2 * x * x], axis=-1)


def test_solid_angles_cover_the_sphere():
    assert cube_solid_angles(7).sum() == pytest.approx(4 * np.pi)
    assert np.allclose(cube_solid_angles(4).reshape(6, -1).sum(1), 4 * np.pi / 6)


def test_a_lamp_is_as_wide_as_the_disc_that_lights_alike():
    """A disc of one radiance has its own solid angle; one that is half as bright as another beside it, (1.5)^2 / 1.25
    of the other's."""
    directions, radius = cube_directions(64), np.radians(12.0)
    disc = directions @ directions[5000] > np.cos(radius)
    light = np.repeat(np.where(disc, 30.0, 0.1)[:, None], 3, axis=1)
    assert np.array_equal(lamp_texels(light), disc)
    solid_angle = lamp_solid_angle(light, np.nonzero(disc)[0])
    assert solid_angle == pytest.approx(2.0 * np.pi * (1.0 - np.cos(radius)), rel=0.02)
    two, solid = np.nonzero(disc)[0][:2], cube_solid_angles(64)[disc][0]
    light[two[1]] = 15.0
    assert lamp_solid_angle(light, two) == pytest.approx(1.8 * solid, rel=0.02)


def test_what_is_dim_or_far_off_is_not_the_lamps():
    directions = cube_directions(16)
    light = np.full((len(directions), 3), 0.1)
    beside = np.argsort(-(directions @ directions[700]))
    light[700], light[beside[1]], light[beside[2]] = 10.0, 1.1, 0.9
    light[(directions @ directions[700]).argmin()] = 9.0
    assert set(np.nonzero(lamp_texels(light))[0]) == {700, beside[1]}


def test_solid_angles_add_up_and_follow_the_distance():
    fine, coarse = cube_solid_angles(12), cube_solid_angles(4)
    assert np.allclose(fine.reshape(6, 4, 3, 4, 3).sum((2, 4)).ravel(), coarse)
    n = 64
    centre = (np.arange(n) + 0.5) / n * 2 - 1
    x, y = np.meshgrid(centre, centre)
    assert np.allclose(cube_solid_angles(n)[: n * n], (4 / n**2 * (1 + x**2 + y**2) ** -1.5).ravel(), rtol=1e-3)


def test_texels_are_found_from_their_directions():
    directions = cube_directions(5)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0)
    assert np.array_equal(cube_texel(directions, 5), np.arange(150))
    for k, axis in enumerate([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]):
        face, column, row = cube_face_coordinates(np.array([axis]), 5)
        assert (face[0], column[0], row[0]) == (k, 2.5, 2.5)


def test_lookup_weights_are_shares():
    matrix = cube_lookup(fibonacci_sphere(3000), 6)
    assert np.allclose(matrix.sum(axis=1), 1.0)
    assert matrix.min() >= 0.0
    assert matrix.getnnz(axis=1).max() <= 4


def test_lookup_at_the_centres_is_the_identity():
    matrix = cube_lookup(cube_directions(6), 6).toarray()
    assert np.allclose(matrix, np.eye(216), atol=1e-12)


def test_lookup_has_no_seams():
    """Steps of a millionth across the twelve edges and eight corners change the value as little."""
    rng = np.random.default_rng(0)
    light = rng.uniform(size=(6 * 4**2, 1))
    along = rng.uniform(-1, 1, 400)
    points = []
    for free in range(3):
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            edge = np.empty((400, 3))
            edge[:, free], edge[:, (free + 1) % 3], edge[:, (free + 2) % 3] = along, signs[0], signs[1]
            points.append(edge)
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    points = np.concatenate([*points, np.repeat(corners, 20, axis=0)])
    step = 1e-6 * rng.normal(size=points.shape)
    here, there = (cube_lookup(p, 4) @ light for p in (points + step, points - step))
    assert np.abs(here - there).max() < 1e-4


def test_lookup_interpolates_smooth_light():
    directions = fibonacci_sphere(2000)
    found = cube_lookup(directions, 16) @ smooth_light(cube_directions(16))
    assert np.abs(found - smooth_light(directions)).max() < 0.02


def test_smoothness_compares_every_pair_of_neighbours_once():
    n = 3
    matrix = cube_smoothness(n)
    assert matrix.shape == (12 * n * n, 6 * n * n)
    assert np.allclose(matrix.sum(axis=1), 0.0)
    assert (abs(matrix).sum(axis=0) == 4).all()
    # Only constant light is free of differences: the faces hang together.
    assert np.linalg.matrix_rank(matrix.toarray()) == 6 * n * n - 1
    ends = [cube_directions(n)[matrix.indices[2 * k : 2 * k + 2]] for k in range(12 * n * n)]
    assert min(float(a @ b) for a, b in ends) > np.cos(np.radians(65))


def test_latlong_layout():
    height = 64
    directions = latlong_directions(height)
    assert directions.shape == (64, 128, 3)
    v, u = (17 + 0.5) / 64, (93 + 0.5) / 128
    polar, azimuth = np.pi * v, 2 * np.pi * u
    expected = [np.sin(azimuth) * np.sin(polar), np.cos(polar), -np.cos(azimuth) * np.sin(polar)]
    assert np.allclose(directions[17, 93], expected)
    middle = directions[31:33]
    assert np.allclose(middle[:, 63:65].mean((0, 1)), [0, 0, 1], atol=2e-3)
    assert np.allclose(middle[:, 31:33].mean((0, 1)), [1, 0, 0], atol=2e-3)
    assert np.allclose(middle[:, [0, -1]].mean((0, 1)), [0, 0, -1], atol=2e-3)
    assert (directions[0, :, 1] > 0.999).all() and (directions[-1, :, 1] < -0.999).all()


def test_latlong_lookup_reads_pixels_and_wraps():
    image = np.random.default_rng(2).uniform(size=(8, 16, 3))
    assert np.allclose(latlong_lookup(image, latlong_directions(8)), image)
    seam = np.array([0.0, np.cos(np.pi * 4.5 / 8), -np.sin(np.pi * 4.5 / 8)])
    assert np.allclose(latlong_lookup(image, seam), 0.5 * (image[4, 0] + image[4, -1]))


def test_cube_and_latlong_round_trip():
    cube = smooth_light(cube_directions(16))
    image = latlong_from_cube(cube, 64)
    assert image.dtype == np.float32
    assert np.abs(image - smooth_light(latlong_directions(64))).max() < 0.02
    again = cube_from_latlong(image, 16)
    assert np.abs(again - cube).max() < 0.02


@pytest.mark.parametrize("height", [32, 128])
def test_a_small_lamp_keeps_its_energy(height):
    """The solid-angle-weighted sum of a lat-long image survives, however coarse the cubemap."""
    directions = latlong_directions(height)
    image = np.exp(30.0 * (directions @ (np.array([2.0, 3.0, 6.0]) / 7.0) - 1.0))[..., None]
    sine = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    solid = np.broadcast_to((np.pi / height) ** 2 * sine[:, None], image.shape[:2])
    expected = 2 * np.pi * (1 - np.exp(-60.0)) / 30.0
    assert (image[..., 0] * solid).sum() == pytest.approx(expected, rel=0.01)
    cube = cube_from_latlong(image, 8)
    assert (cube[:, 0] * cube_solid_angles(8)).sum() == pytest.approx(expected, rel=0.01)
    back = latlong_from_cube(cube, height)
    assert (back[..., 0] * solid).sum() == pytest.approx(expected, rel=0.02)


def test_frames_turn_the_light():
    directions = fibonacci_sphere(200)
    turns = rotation_from_vector(np.array([[0.0, 0, 0], [0, 0.7, 0], [0.3, -0.4, 1.0]]))
    along = light_along(smooth_light(cube_directions(16)), directions, turns)
    assert along.shape == (200, 3, 3)
    for f in range(3):
        assert np.abs(along[:, f] - smooth_light(directions @ turns[f].T)).max() < 0.02
