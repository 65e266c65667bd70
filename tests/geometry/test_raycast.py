"""Rays against known surfaces."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from shapes import grid_plane, sphere

from shared.geometry import embree
from shared.geometry.mesh import interpolate, normalised
from shared.geometry.raycast import RayScene, camera_hits, on_faces, pixel_directions
from shared.geometry.transforms import rigid


def test_distance_and_place_of_a_hit():
    plane = grid_plane(5, extent=2.0)
    scene = RayScene(plane.vertices, plane.faces)
    origins = np.array([[0.3, -0.2, 4.0], [5.0, 0, 4.0]])
    face, bary, distance = scene.intersect(origins, np.array([[0, 0, -2.0], [0, 0, -2.0]]))
    assert face[1] == -1 and np.isinf(distance[1])
    assert np.isclose(distance[0], 2.0)
    assert np.allclose(interpolate(plane.vertices, plane.faces, face[:1], bary[:1]), [[0.3, -0.2, 0]], atol=1e-6)
    assert (scene.first_faces(origins, np.array([[0, 0, -2.0], [0, 0, -2.0]])) == face).all()


def test_occlusion_has_no_range():
    ball = sphere(1.0)
    scene = RayScene(ball.vertices, ball.faces)
    outward = np.array([[0, 0, 1.0]])
    assert not scene.occluded(np.array([[0, 0, 1.01]]), outward)[0]
    assert scene.occluded(np.array([[0, 0, -100.0]]), outward)[0]


def test_no_rays_no_hits():
    scene = RayScene(grid_plane().vertices, grid_plane().faces)
    assert scene.occluded(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)
    assert scene.intersect(np.zeros((0, 3)), np.zeros((0, 3)))[1].shape == (0, 3)
    assert scene.first_faces(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)


def test_camera_sees_the_disc_of_a_sphere():
    ball = sphere(10.0, levels=5)
    lens = np.array([[200.0, 0, 32], [0, 200.0, 32], [0, 0, 1]])
    face, bary, depth = camera_hits(
        RayScene(ball.vertices, ball.faces), rigid(np.eye(3), np.array([0, 0, 100.0])), lens, 64, 64
    )
    radius_px = 200.0 * 10.0 / np.sqrt(100.0**2 - 10.0**2)
    assert abs((face >= 0).sum() - np.pi * radius_px**2) < 0.02 * np.pi * radius_px**2
    assert abs(depth[32, 32] - 90.0) < 0.1
    assert np.allclose(bary[face >= 0].sum(1), 1, atol=1e-5)


def test_pixel_directions_pass_through_pixel_centres():
    lens = np.array([[50.0, 0, 2], [0, 50.0, 1], [0, 0, 1]])
    directions = pixel_directions(lens, 4, 2)
    assert directions.shape == (2, 4, 3)
    assert np.allclose(directions[0, 0], [(0.5 - 2) / 50, (0.5 - 1) / 50, 1])


def test_rays_of_several_threads_meet_what_those_of_one_meet():
    """Each embreex ray query holds the interpreter's lock; these do not, and share one scene."""
    ball, rng = sphere(1.0, 4), np.random.default_rng(5)
    scene, origins = RayScene(ball.vertices, ball.faces), rng.uniform(-2.0, 2.0, (4, 5000, 3))
    directions = rng.normal(size=origins.shape)
    alone = [scene.first_faces(*rays) for rays in zip(origins, directions, strict=True)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(scene.first_faces, origins, directions))
    np.testing.assert_array_equal(together, alone)
    blocked = np.stack([scene.occluded(*rays) for rays in zip(origins, directions, strict=True)])
    np.testing.assert_array_equal(blocked, np.stack(alone) >= 0)


def test_no_ray_slips_between_faces():
    """From within a closed surface, at its edges and corners."""
    ball = sphere(1.0, 3)
    middles = ball.vertices[ball.faces][:, :2].mean(1)
    targets = np.concatenate([ball.vertices, middles])
    face = RayScene(ball.vertices, ball.faces).first_faces(np.zeros_like(targets), targets)
    assert (face >= 0).all()


def test_places_on_faces_lie_on_their_rays():
    ball = sphere(50.0, 3)
    rng = np.random.default_rng(4)
    origins = np.array([0.0, 0.0, 200.0]) + rng.uniform(-25.0, 25.0, (200, 3))
    directions = normalised(rng.uniform(-10.0, 10.0, (200, 3)) - origins)
    face, rough, distance = RayScene(ball.vertices, ball.faces).intersect(origins, directions)
    assert (face >= 0).all()
    bary, exact = on_faces(ball.vertices, ball.faces, face, origins, directions)
    np.testing.assert_allclose(bary, rough, atol=1e-7)
    np.testing.assert_allclose(exact, distance, rtol=1e-7)
    places = interpolate(ball.vertices, ball.faces, face, bary)
    np.testing.assert_allclose(places, origins + exact[:, None] * directions, atol=1e-11)


@pytest.mark.filterwarnings("error")
def test_a_ray_in_the_plane_of_its_face_meets_it_nowhere():
    vertices, faces = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]])
    origins, directions = np.array([[-1.0, 1, 0], [1, 1, -2]]), np.array([[1.0, 0, 0], [0, 0, 1]])
    bary, distance = on_faces(vertices, faces, np.zeros(2, int), origins, directions)
    assert np.isinf(distance[0]) and (bary[0] == 0.0).all()
    assert distance[1] == 2.0 and bary[1].tolist() == [0.5, 0.25, 0.25]


@pytest.mark.parametrize("code", ["sse2", "avx", "avx2"])
def test_hits_are_the_same_bits_from_embrees_code_for_other_processors(code, monkeypatch):
    """Each has reciprocals of its own, which end in u, v and the distance that embree gives."""
    ball, rng = sphere(80.0, 4), np.random.default_rng(7)
    origins = np.tile([3.0, 5.0, 500.0], (5000, 1))
    directions = normalised(np.column_stack([0.1 * rng.normal(size=(5000, 2)), -np.ones(5000)]))
    own = RayScene(ball.vertices, ball.faces).intersect(origins, directions)
    device = embree._library().rtcNewDevice(f"threads=1,isa={code}".encode())
    assert device
    monkeypatch.setattr(embree, "_device", lambda: device)
    other = RayScene(ball.vertices, ball.faces).intersect(origins, directions)
    assert 0.3 < (own[0] >= 0).mean() < 1.0
    for found, expected in zip(other, own, strict=True):
        np.testing.assert_array_equal(found, expected)
