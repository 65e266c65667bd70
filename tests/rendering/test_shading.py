"""Specular lobe sums and the shading of a mesh in all frames."""

from dataclasses import replace

import numpy as np
import pytest
from quadrature import hemisphere_quadrature
from shapes import FACING, nods, sphere, turned

from shared.geometry.mesh import normalised
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import fibonacci_sphere
from shared.rendering.brdf import directional_albedo, specular_cosine
from shared.rendering.envmap import cube_directions, cube_solid_angles
from shared.rendering.lobes import SpecularTransfer, specular_reflection
from shared.rendering.shading import Material, VertexShading, key_frames, turned_so_far
from shared.rendering.specular_transfer import specular_tables
from shared.rendering.transfer import bounce_nodes, mesh_points, trace_transfer

DIRECTIONS = fibonacci_sphere(768)
COSINES = np.array([0.25, 0.5, 0.8, 1.0])


def towards_at(cosines):
    """[N, 3] unit vectors at these cosines from +z."""
    sine, azimuth = np.sqrt(1 - cosines**2), np.arange(len(cosines))
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosines], axis=1)


def upward_table(visible=None):
    """As many points as COSINES with the normal +z."""
    visible = np.ones((len(COSINES), len(DIRECTIONS)), bool) if visible is None else visible
    return SpecularTransfer(np.tile([0.0, 0, 1], (len(COSINES), 1)), visible, DIRECTIONS)


def lamp(directions):
    """[M, 3] -> [M, 1]: a soft lamp of some 20 degrees on a dim sky."""
    return 0.1 + 20.0 * np.exp(12.0 * (directions @ np.array([[0.48], [0.36], [0.8]]) - 1.0))


@pytest.mark.parametrize("roughness", [0.3, 0.45, 0.7])
def test_uniform_light_returns_the_directional_albedo(roughness):
    found = specular_reflection(upward_table(), towards_at(COSINES), roughness, np.full((768, 1), 2.0))[:, 0]
    assert np.allclose(found, 2.0 * directional_albedo(COSINES, roughness), rtol=0.03)


@pytest.mark.parametrize("roughness", [0.25, 0.45, 0.7])
def test_a_lamp_is_reflected_as_by_brute_force(roughness):
    fine, solid = hemisphere_quadrature(96, 256)
    towards = towards_at(COSINES)
    lobe = [specular_cosine(np.full(len(fine), o[2]), fine[:, 2], fine @ o, roughness) for o in towards]
    expected = np.array(lobe) @ (solid * lamp(fine)[:, 0])
    found = specular_reflection(upward_table(), towards, roughness, lamp(DIRECTIONS))[:, 0]
    assert np.allclose(found, expected, rtol=0.08 if roughness < 0.3 else 0.03)


def test_blocked_directions_take_the_given_light():
    """Hidden behind the head itself: no light without an estimate, the estimate's share with one."""
    hidden = np.tile(DIRECTIONS[:, 0] > 0, (len(COSINES), 1))
    towards, light = towards_at(COSINES), lamp(DIRECTIONS)
    whole = specular_reflection(upward_table(), towards, 0.45, light)
    one, other = (specular_reflection(upward_table(side), towards, 0.45, light) for side in (hidden, ~hidden))
    assert np.allclose(one + other, whole, rtol=1e-4)
    constant = np.full((768, 1), 3.0)
    filled = specular_reflection(upward_table(hidden), towards, 0.45, constant, np.full((len(COSINES), 1), 3.0))
    assert np.allclose(filled, specular_reflection(upward_table(), towards, 0.45, constant), rtol=1e-4)


def test_tables_are_the_same_lobes():
    rng = np.random.default_rng(0)
    visible = rng.random((len(COSINES), 768)) < 0.7
    towards = np.stack([towards_at(COSINES), towards_at(COSINES[::-1])], axis=1)
    kernels, blocked = specular_tables(upward_table(visible), towards, 0.4)
    light, elsewhere = lamp(DIRECTIONS), np.full((len(COSINES), 1), 0.7)
    for f in range(2):
        direct = specular_reflection(upward_table(visible), towards[:, f], 0.4, light)
        assert np.allclose(kernels[f].float().numpy() @ light, direct, rtol=3e-3)
        both = specular_reflection(upward_table(visible), towards[:, f], 0.4, light, elsewhere)
        assert np.allclose(direct[:, 0] + 0.7 * blocked[:, f], both[:, 0], rtol=1e-4)


def test_a_part_of_the_table_is_those_points():
    normals = normalised(np.random.default_rng(1).normal(size=(40, 3)))
    table = SpecularTransfer(normals, np.ones((40, 768), bool), DIRECTIONS)
    index = np.array([30, 3])
    whole = specular_reflection(table, normals, 0.5, lamp(DIRECTIONS))
    assert len(table.take(index)) == 2
    assert np.allclose(specular_reflection(table.take(index), normals[index], 0.5, lamp(DIRECTIONS)), whole[index])


# ---------------------------------------------------------------------- shading of a mesh


def shade(mesh, light, poses, moves="head", albedo=0.5, **options):
    """Shading of all vertices of a mesh."""
    scene, nodes = RayScene(mesh.vertices, mesh.faces), bounce_nodes(mesh, 60)
    points = mesh_points(mesh)
    transfer, node_transfer = (trace_transfer(scene, some, nodes, DIRECTIONS) for some in (points, nodes.points))
    material = Material(np.full((len(nodes.points), 3), albedo), 1.0, 0.45)
    index = np.arange(len(points))
    shading = VertexShading(
        index, points.positions, points, transfer, node_transfer, material, light, DIRECTIONS, poses, moves, **options
    )
    return shading, points


def test_uniform_light_on_a_ball():
    poses = nods(np.array([0.0, 20.0]))
    light = np.broadcast_to([1.0, 2.0, 0.5], (6 * 4**2, 3))
    shading, points = shade(sphere(80.0, 3), light, poses)
    assert np.allclose(shading.irradiance(1), [1.0, 2.0, 0.5], rtol=4e-3)
    cosine = (normalised([0, 0, 900.0] - points.positions) * points.normals).sum(1)
    front = cosine > 0.2
    expected = directional_albedo(cosine[front], 0.45)[:, None] * [1.0, 2.0, 0.5]
    assert np.allclose(shading.reflection(0)[front], expected, rtol=0.04)


@pytest.mark.parametrize("moves", ["head", "camera"])
def test_irradiance_follows_the_frames(moves):
    """A lamp that stands still in the room turns against the head; one fixed to the head's space does not."""
    poses = nods(np.array([0.0, 30.0, 60.0]), axis=(0.6, 0.8, 0.0))
    directions, solid = cube_directions(16), cube_solid_angles(16)
    light = np.repeat(lamp(directions), 3, axis=1)
    shading, points = shade(sphere(80.0, 2), light, poses, moves, bounce=False)
    for f in range(3):
        turn = FACING @ poses[f, :3, :3] if moves == "head" else np.eye(3)
        expected = np.maximum(points.normals @ turn.T @ directions.T, 0.0) @ (light * solid[:, None]) / np.pi
        assert np.allclose(shading.irradiance(f), expected, rtol=0.02, atol=0.01 * expected.max())


def test_mean_slope_is_the_irradiance_s_derivative_by_the_normal():
    """Differences of the hemisphere's integral between turned normals; a uniform light has no slope."""
    poses = nods(np.array([0.0, 30.0, 60.0]), axis=(0.6, 0.8, 0.0))
    light = np.repeat(lamp(cube_directions(16)), 3, axis=1)
    shading, points = shade(sphere(80.0, 2), light, poses, bounce=False)

    def mean_irradiance(normals):
        return np.maximum(normals @ DIRECTIONS.T, 0.0) @ shading.light_along.mean(1)[:, :1] * 4.0 / len(DIRECTIONS)

    first = normalised(np.cross(points.normals, [0.3, 0.9, 0.1]))
    change = [
        (mean_irradiance(normalised(points.normals + step)) - mean_irradiance(normalised(points.normals - step))) / 0.1
        for step in (0.05 * first, 0.05 * np.cross(points.normals, first))
    ]
    expected = np.hypot(*change)
    assert np.abs(shading.mean_slope()[:, :1] - expected).max() < 0.05 * expected.max()
    even, _ = shade(sphere(80.0, 2), np.ones((6 * 4**2, 3)), poses, bounce=False)
    assert even.mean_slope().max() < 0.05


def test_reflections_between_key_frames_are_interpolated():
    poses = nods(np.linspace(0.0, 5.0, 6))
    light = np.repeat(lamp(cube_directions(8)), 3, axis=1)
    coarse, points = shade(sphere(80.0, 2), light, poses, key_step=np.radians(3.0))
    every, _ = shade(sphere(80.0, 2), light, poses, key_step=0.0)
    front = points.normals[:, 2] > 0.3
    for f in range(6):
        assert np.abs(coarse.reflection(f) - every.reflection(f))[front].max() < 0.02 * every.reflection(f).max()


def test_uncertainty_of_shadows_is_interpolated_between_key_frames():
    """A ball casts no shadows on itself, so that there is little of it; a frame's lies between those of its keys."""
    poses = nods(np.linspace(0.0, 8.0, 9))
    light = np.repeat(lamp(cube_directions(16)), 3, axis=1)
    shading, _ = shade(sphere(40.0, 5), light, poses, key_step=np.radians(4.0))
    uncertainties = np.stack([shading.shadow_uncertainty(f) for f in range(len(poses))])
    brightest = shading.irradiance(0).max()
    assert np.median(uncertainties) < 0.02 * brightest and uncertainties.max() < 0.2 * brightest
    keys = key_frames(turned_so_far(poses), np.radians(4.0))
    assert np.diff(keys).max() > 2
    for low, high in zip(keys[:-1], keys[1:], strict=True):
        least, most = np.sort(uncertainties[[low, high]], axis=0)
        for between in uncertainties[low + 1 : high]:
            assert (between >= least - 1e-6).all() and (between <= most + 1e-6).all()
        assert (uncertainties[low] != uncertainties[high]).any()


def test_vertices_without_shading_take_the_nearest():
    """A ball of which three vertices are shaded, then one of these said to lie deep in a cavity."""
    ball = sphere(80.0, 2)
    scene, nodes = RayScene(ball.vertices, ball.faces), bounce_nodes(ball, 20)
    index = np.array([4, 10, 11])
    points = mesh_points(ball, index)
    transfer, node_transfer = (trace_transfer(scene, some, nodes, DIRECTIONS) for some in (points, nodes.points))
    material = Material(np.full((len(nodes.points), 3), 0.3), 0.5, 0.4)
    light = np.repeat(lamp(cube_directions(8)), 3, axis=1)

    def shaded(transfer):
        scene_light = (material, light, DIRECTIONS, nods(np.zeros(1)), "head")
        return VertexShading(index, ball.vertices, points, transfer, node_transfer, *scene_light)

    found = shaded(transfer).irradiance(0)
    nearest = np.linalg.norm(ball.vertices[:, None] - ball.vertices[index], axis=2).argmin(1)
    assert np.array_equal(found, found[index[nearest]]) and len(np.unique(found[:, 0])) == 3
    deep = shaded(replace(transfer, blocked=np.array([0.0, 0.95, 0.0], np.float32))).irradiance(0)
    assert len(np.unique(deep[:, 0])) == 2 and np.array_equal(deep[index[[0, 2]]], found[index[[0, 2]]])


def test_key_frames_are_near_each_other_in_turn():
    degrees = np.concatenate([np.linspace(0, 30, 61), np.linspace(30, -10, 41)[1:]])
    turn = turned_so_far(nods(degrees))
    assert turn[-1] == pytest.approx(np.radians(70.0))
    assert np.allclose(turn[:61], np.radians(degrees[:61]))
    keys = key_frames(turn, 0.05)
    assert keys[0] == 0 and keys[-1] == 100
    assert np.diff(turn[keys]).max() <= 0.05 + 1e-9
    assert len(keys) < 40
    assert np.array_equal(key_frames(turn[::20], 0.05), np.arange(6))


def test_light_that_arrives_is_what_shading_sums_up():
    light = np.random.default_rng(5).uniform(size=(2 * 6 * 4**2, 3))
    mesh, directions = sphere(50.0, 2), fibonacci_sphere(64)
    points = mesh_points(mesh)
    nodes = bounce_nodes(mesh, 20)
    transfer = trace_transfer(RayScene(mesh.vertices, mesh.faces), points, nodes, directions)
    poses = turned([[0.0, 0.3, 0], [0.1, -0.2, 0], [0.2, 0.0, 0.1]], (0.0, 0.0, 500.0))
    shading = VertexShading(
        np.arange(len(points)), points.positions, points, transfer, transfer,
        Material(np.full((len(nodes.points), 3), 0.5), 0.0, 0.5), light, directions, poses, "head", bounce=False,
        light_index=np.array([0, 1, 1]),
    )
    for frame in range(3):
        np.testing.assert_allclose(shading.arriving(frame, directions), shading.light_along[:, frame], rtol=1e-5)
