"""Precomputed transfer against radiometry in closed form: furnaces, a bowl, a square above a point."""

import numpy as np
import pytest
from shapes import grid_plane, sphere

from shared.geometry.mesh import Mesh, face_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import fibonacci_sphere
from shared.rendering.transfer import (
    Points,
    bounce_nodes,
    irradiance,
    mesh_points,
    nearest_points,
    node_radiosity,
    spread_vertices,
    trace_transfer,
)

DIRECTIONS = fibonacci_sphere(768)
RADIUS = 100.0


def bowl(height=0.0):
    """The part z <= height of a sphere of RADIUS, facing inwards."""
    ball = sphere(RADIUS, 4)
    kept = ball.faces[(ball.vertices[ball.faces, 2] <= height * RADIUS + 1e-6).all(1)]
    used, faces = np.unique(kept, return_inverse=True)
    faces = faces.reshape(-1, 3)[:, ::-1].astype(np.int32)
    return Mesh(ball.vertices[used], faces, ball.uvs[used], faces)


def trace(mesh, node_count=150, index=slice(None)):
    """Nodes, their transfer and the transfer of some vertices."""
    scene, nodes = RayScene(mesh.vertices, mesh.faces), bounce_nodes(mesh, node_count)
    points = mesh_points(mesh, index)
    return nodes, *(trace_transfer(scene, some, nodes, DIRECTIONS) for some in (nodes.points, points))


def face_areas(mesh):
    return 0.5 * np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)


@pytest.fixture(scope="module")
def traced_bowl():
    mesh = bowl()
    inner = np.nonzero(mesh.vertices[:, 2] < -0.1 * RADIUS)[0]
    return mesh, *trace(mesh, index=inner[::3])


def lit(nodes, transfer, albedo, light):
    """E over pi [P, C] with all bounces; albedo [C] everywhere, light [J, C]."""
    direct = nodes.direct.astype(np.float64) @ light
    radiosity = node_radiosity(nodes, np.tile(albedo, (len(nodes.direct), 1)), direct)
    return irradiance(transfer, light, radiosity)


def test_white_furnace_on_a_convex_surface():
    """Nothing is blocked, nothing bounces, and uniform light L gives radiance albedo * L everywhere."""
    nodes, node_transfer, transfer = trace(sphere(RADIUS, 3))
    assert transfer.blocked.max() < 1e-6 and np.abs(transfer.bounce).max() == 0.0
    light = np.array([[2.0, 1.0, 0.5]])
    found = lit(node_transfer, transfer, np.array([0.9, 0.5, 0.1]), np.repeat(light, 768, axis=0))
    assert np.allclose(found, light, rtol=3e-3)


def test_a_distant_lamp_shines_by_the_cosine():
    points = mesh_points(sphere(RADIUS, 3))
    _, _, transfer = trace(sphere(RADIUS, 3))
    lamp = np.zeros((768, 1))
    lamp[100] = 768 / (4 * np.pi)
    expected = np.maximum(points.normals @ DIRECTIONS[100], 0.0) / np.pi
    assert np.allclose(irradiance(transfer, lamp)[:, 0], expected, atol=1e-3 * expected.max())
    assert np.array_equal(transfer.visibility()[:, 100], points.normals @ DIRECTIONS[100] > 0)


def test_half_of_what_a_bowl_sees_is_the_bowl(traced_bowl):
    """Between points of one sphere the form factor is dA / (4 pi R^2), whatever their places."""
    _, _, _, transfer = traced_bowl
    assert np.allclose(transfer.blocked, 0.5, atol=0.03)
    assert np.allclose(transfer.bounce.astype(np.float32).sum(1), transfer.blocked, atol=2e-3)
    assert np.allclose(transfer.direct.astype(np.float32).sum(1) + transfer.blocked, 1.0, atol=5e-3)


@pytest.mark.parametrize("height", [-0.4, 0.0, 0.5])
def test_bounces_in_a_bowl_add_up_to_the_closed_form(height):
    """E / pi = L f / (1 - a (1 - f)) with the opening's share f of the sphere; 1 for a white bowl."""
    mesh = bowl(height)
    opening = 1.0 - face_areas(mesh).sum() / face_areas(sphere(RADIUS, 4)).sum()
    inner = np.nonzero(mesh.vertices[:, 2] < mesh.vertices[:, 2].max() - 0.12 * RADIUS)[0]
    _, node_transfer, transfer = trace(mesh, index=inner[::4])
    albedo = np.array([0.0, 0.3, 0.7, 1.0])
    found = lit(node_transfer, transfer, albedo, np.full((768, 4), 2.0))
    expected = 2.0 * opening / (1.0 - albedo * (1.0 - opening))
    assert np.allclose(found.mean(0), expected, rtol=0.02)
    assert np.allclose(found, expected, rtol=0.1)


def test_a_bowl_gives_back_no_more_than_enters(traced_bowl):
    """Under a lamp: what is absorbed and what leaves through the opening is what came in."""
    mesh, nodes, node_transfer, _ = traced_bowl
    lamp = np.where((DIRECTIONS @ [0.36, 0.48, 0.8] > 0.9)[:, None], 5.0, 0.0)
    albedo = 0.8
    found = lit(node_transfer, node_transfer, np.array([albedo]), lamp)[:, 0]
    node_area = np.bincount(nodes.of_face, face_areas(mesh), len(found))
    entered = (lamp[:, 0] * np.maximum(DIRECTIONS[:, 2], 0.0)).sum() * 4 * np.pi / 768 * np.pi * RADIUS**2
    absorbed = (1 - albedo) * np.pi * (found * node_area).sum()
    open_share = 1.0 - node_transfer.blocked
    left = albedo * np.pi * (found * open_share * node_area).sum()
    assert absorbed + left == pytest.approx(entered, rel=0.03)


def test_radiosity_is_the_sum_of_all_bounces(traced_bowl):
    _, _, nodes, _ = traced_bowl
    albedo = np.random.default_rng(0).uniform(0.1, 0.9, (len(nodes.direct), 2))
    form = nodes.bounce.astype(np.float64)
    count = len(form)
    exact = node_radiosity(nodes, albedo, np.tile(np.eye(count)[..., None], 2))
    for c in range(2):
        operator = albedo[:, c, None] * form
        assert operator.sum(1).max() < 0.6
        term, total = np.diag(albedo[:, c]), np.zeros_like(form)
        for _ in range(40):
            total, term = total + term, operator @ term
        assert np.allclose(exact[..., c], total, atol=1e-8)


def test_exchange_between_nodes_is_mutual(traced_bowl):
    """Reciprocity A_k F_kl = A_l F_lk, summed over halves of the bowl so that sampling noise averages out."""
    mesh, nodes, transfer, _ = traced_bowl
    sent = np.bincount(nodes.of_face, face_areas(mesh), len(nodes.points))[:, None] * transfer.bounce.astype(np.float64)
    left = nodes.points.positions[:, 0] < 0.2 * RADIUS
    forth, back = sent[left][:, ~left].sum(), sent[~left][:, left].sum()
    assert forth == pytest.approx(back, rel=0.05)


def test_without_visibility_a_bowl_is_lit_like_a_convex_surface(traced_bowl):
    """Switched off, direct transfer of a concave surface sums to 1 and nothing bounces; switched on it does not."""
    mesh, nodes, _, seeing = traced_bowl
    inner = np.nonzero(mesh.vertices[:, 2] < -0.1 * RADIUS)[0][::3]
    scene = RayScene(mesh.vertices, mesh.faces)
    blind = trace_transfer(scene, mesh_points(mesh, inner), nodes, DIRECTIONS, visibility=False)
    assert np.allclose(blind.direct.astype(np.float64).sum(1), 1.0, atol=0.01)
    assert not blind.bounce.any() and not blind.blocked.any()
    assert seeing.direct.astype(np.float64).sum(1).max() < 0.6


def test_a_square_overhead_shades_as_it_should():
    """Configuration factor of a square, half side s, at height h over a point: four times the corner's."""
    half, height = 60.0, 40.0
    lid = grid_plane(3, 2 * half)
    scene = RayScene(lid.vertices + [0, 0, height], lid.faces)
    point = Points(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    directions = fibonacci_sphere(4096)
    transfer = trace_transfer(scene, point, bounce_nodes(lid, 9), directions)
    x = half / height
    expected = 4.0 / np.pi * x / np.sqrt(1 + x * x) * np.arctan(x / np.sqrt(1 + x * x))
    assert transfer.blocked[0] == pytest.approx(expected, abs=5e-3)
    up = directions[:, 2] > 1e-3
    at_lid = np.abs(directions[up, :2] / directions[up, 2:]).max(1) * height
    clear = np.abs(at_lid - half) > 0.5
    assert np.array_equal(transfer.visibility()[0, up][clear], (at_lid > half)[clear])
    assert not transfer.visibility()[0, directions[:, 2] < 0].any()


def test_batches_do_not_matter(traced_bowl):
    _, _, _, transfer = traced_bowl
    light = np.random.default_rng(3).uniform(size=(768, 4))
    radiosity = np.random.default_rng(4).uniform(size=(transfer.bounce.shape[1], 4))
    whole, parts = irradiance(transfer, light, radiosity), irradiance(transfer, light, radiosity, batch=7)
    assert np.allclose(whole, parts, rtol=1e-5)
    some = transfer.take(np.array([5, 2]))
    assert np.allclose(irradiance(some, light, radiosity), whole[[5, 2]], rtol=1e-5)
    assert np.array_equal(some.visibility(), transfer.visibility()[[5, 2]])


def test_spread_vertices_are_few_even_and_allowed():
    ball = sphere(RADIUS, 4)
    allowed = ball.vertices[:, 2] > 0
    index = spread_vertices(ball.vertices, 100, allowed)
    assert 60 < len(index) <= 100 and allowed[index].all() and (np.diff(index) > 0).all()
    gaps = np.linalg.norm(ball.vertices[allowed][:, None] - ball.vertices[index], axis=2).min(1)
    assert gaps.max() < 3.0 * np.sqrt(2 * np.pi * RADIUS**2 / 100)
    assert np.array_equal(spread_vertices(ball.vertices, 10**6), np.arange(len(ball.vertices)))


def test_the_two_sides_of_a_thin_part_stay_apart():
    """A point 1 mm behind another with the opposite normal is farther than one 10 mm along the surface."""
    sides = Points(np.array([[0.0, 0, -1], [10.0, 0, 0]]), np.array([[0.0, 0, -1], [0.0, 0, 1]]))
    target = Points(np.array([[0.0, 0, 0]]), np.array([[0.0, 0, 1.0]]))
    assert nearest_points(target, sides)[0] == 1


def test_spread_vertices_are_not_those_of_the_mesh_before_its_subdivision():
    """Of two vertices in a cell, equally near to their mean, neither the older nor the newer one wins as a rule."""
    ball = sphere(levels=5)
    before = len(ball.vertices) // 4
    index = spread_vertices(ball.vertices, len(ball.vertices) // 2)
    assert 0.15 < (index < before).mean() < 0.5
