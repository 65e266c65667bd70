"""Specular lobe sums, the shading of a mesh in all frames, and samples gathered from pictures."""

from dataclasses import replace

import numpy as np
import pytest
from quadrature import hemisphere_quadrature
from shapes import grid_plane, sphere

from shared.brdf import directional_albedo, specular_cosine
from shared.envmap import cube_directions, cube_solid_angles
from shared.gather import (
    SurfaceViewer,
    gather_samples,
    prepare_picture,
    sample_colours,
    sample_inside,
    sample_limits,
    texel_size,
)
from shared.geometry import fibonacci_sphere, rigid, rotation_from_vector
from shared.lobe_tables import specular_tables
from shared.lobes import LobeTable, specular_reflection
from shared.mesh import normalised
from shared.raycast import RayScene
from shared.shading import Material, VertexShading, key_frames, turned_so_far
from shared.transfer import bounce_nodes, mesh_points, trace_transfer

DIRECTIONS = fibonacci_sphere(768)
COSINES = np.array([0.25, 0.5, 0.8, 1.0])
LENS = np.array([[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]])
FACING = np.diag([1.0, -1.0, -1.0])


def towards_at(cosines):
    """[N, 3] unit vectors at these cosines from +z."""
    sine, azimuth = np.sqrt(1 - cosines**2), np.arange(len(cosines))
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosines], axis=1)


def upward_table(visible=None):
    """As many points as COSINES with the normal +z."""
    visible = np.ones((len(COSINES), len(DIRECTIONS)), bool) if visible is None else visible
    return LobeTable(np.tile([0.0, 0, 1], (len(COSINES), 1)), visible, DIRECTIONS)


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
    table = LobeTable(normals, np.ones((40, 768), bool), DIRECTIONS)
    index = np.array([30, 3])
    whole = specular_reflection(table, normals, 0.5, lamp(DIRECTIONS))
    assert len(table.take(index)) == 2
    assert np.allclose(specular_reflection(table.take(index), normals[index], 0.5, lamp(DIRECTIONS)), whole[index])


# ---------------------------------------------------------------------- shading of a mesh


def nods(degrees, axis=(0.0, 1.0, 0.0), distance=900.0):
    """Poses before the camera, turned by these angles about an axis of the head."""
    rotation = FACING @ rotation_from_vector(np.radians(degrees)[:, None] * np.array(axis))
    return rigid(rotation, np.tile([0.0, 0, distance], (len(degrees), 1)))


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


def test_doubt_about_shadows_is_interpolated_between_key_frames():
    """A ball casts no shadows on itself, so that there is little of it; a frame's lies between those of its keys."""
    poses = nods(np.linspace(0.0, 8.0, 9))
    light = np.repeat(lamp(cube_directions(16)), 3, axis=1)
    shading, _ = shade(sphere(40.0, 5), light, poses, key_step=np.radians(4.0))
    doubts, brightest = np.stack([shading.shadow_doubt(f) for f in range(len(poses))]), shading.irradiance(0).max()
    assert np.median(doubts) < 0.02 * brightest and doubts.max() < 0.2 * brightest
    keys = key_frames(turned_so_far(poses), np.radians(4.0))
    assert np.diff(keys).max() > 2
    for low, high in zip(keys[:-1], keys[1:], strict=True):
        least, most = np.sort(doubts[[low, high]], axis=0)
        for between in doubts[low + 1 : high]:
            assert (between >= least - 1e-6).all() and (between <= most + 1e-6).all()
        assert (doubts[low] != doubts[high]).any()


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


# ---------------------------------------------------------------------- from pictures to samples


def flat_picture(height=120, width=160, codes=None, linear=None):
    codes = np.full((height, width, 3), 128, np.uint8) if codes is None else codes
    linear = np.full((height, width, 3), 0.2, np.float32) if linear is None else linear
    return prepare_picture(codes, linear, np.full((height, width), 255, np.uint8))


def test_ramps_are_sampled_at_any_footprint():
    """Colour u + 2 v: pixel centres at integer + 0.5, and the levels of the pyramid agree to 0.07 pixels (OpenCV's
    bicubic kernel bends ramps by that much)."""
    v, u = np.mgrid[0:128, 0:160] + 0.5
    picture = flat_picture(128, 160, linear=np.stack([u + 2 * v] * 3, axis=-1).astype(np.float32))
    assert len(picture.levels) > 1
    pixels = np.random.default_rng(0).uniform(30, 98, (50, 2))
    expected = pixels[:, 0] + 2 * pixels[:, 1]
    for footprint in (None, np.full(50, 0.5), np.full(50, 1.5), np.full(50, 2.0), np.full(50, 3.0)):
        assert np.allclose(sample_colours(picture, pixels, footprint)[:, 1], expected, atol=0.2)


def test_wide_footprints_average():
    stripes = np.tile(np.array([0.0, 1.0], np.float32), 80)[None, :, None] * np.ones((128, 1, 3), np.float32)
    picture = flat_picture(128, 160, linear=stripes)
    pixels = np.array([[64.5, 50.5], [65.5, 50.5]])
    assert np.allclose(sample_colours(picture, pixels)[:, 0], [0.0, 1.0], atol=1e-6)
    assert np.allclose(sample_colours(picture, pixels, np.full(2, 2.0)), 0.5, atol=1e-6)


def test_clipped_and_crushed_channels_are_marked():
    codes = np.full((64, 64, 3), 128, np.uint8)
    codes[10:20, 10:20, 0] = 255
    codes[40:50, 40:50, 2] = 0
    limits = flat_picture(64, 64, codes=codes).limits.astype(np.float32)
    found = sample_limits(limits, np.array([[15.0, 15.0], [45.0, 45.0], [30.0, 30.0]]))
    assert found.tolist() == [[1, 0, 0], [0, 0, -1], [0, 0, 0]]
    codes16 = (codes.astype(np.uint16) * 257).astype(np.uint16)
    linear = np.zeros((64, 64, 3), np.float32)
    assert np.array_equal(prepare_picture(codes16, linear, codes[..., 0]).limits, flat_picture(64, 64, codes).limits)


def test_trust_fades_towards_the_mask():
    mask = np.zeros((64, 64), np.uint8)
    mask[:, 20:] = 128
    picture = prepare_picture(np.full((64, 64, 3), 99, np.uint8), np.zeros((64, 64, 3), np.float32), mask)
    trust = sample_inside(picture, np.array([[10.5, 30.5], [20.5, 30.5], [22.5, 30.5], [40.5, 30.5]]))
    assert trust[0] == 0.0 and trust[1] < trust[2] < trust[3] == 1.0


def test_the_camera_sees_the_front_of_a_ball():
    ball = sphere(40.0, 4)
    viewer = SurfaceViewer.of(ball)
    pose = nods(np.array([0.0]), distance=400.0)[0]
    view = viewer.view(pose, LENS, (160, 120))
    towards = normalised(np.array([0, 0, 400.0]) - ball.vertices)
    assert np.allclose(view.towards_camera, towards)
    cosine = (towards * ball.vertices).sum(1) / 40.0
    assert np.allclose(view.cosine, cosine, atol=0.02)
    assert (view.weight[cosine < 0.15] == 0).all()
    assert np.allclose(view.weight[cosine > 0.4], view.cosine[cosine > 0.4] ** 2)
    assert np.allclose(view.depth, 400.0 - ball.vertices[:, 2])


def test_what_lies_behind_an_edge_is_left_out_with_a_margin():
    """A plate 50 mm before a wall hides part of it; wall vertices next to its shadow are not trusted either."""
    wall, plate = grid_plane(41, 80.0), grid_plane(9, 30.0)
    vertices = np.concatenate([wall.vertices, plate.vertices + [0, 0, 50.0]])
    faces = np.concatenate([wall.faces, plate.faces + len(wall.vertices)])
    mesh = wall.replace(vertices=vertices, faces=faces)
    viewer = SurfaceViewer(mesh, RayScene(vertices, faces), margin_mm=4.0)
    view = viewer.view(rigid(FACING, np.array([0, 0, 450.0])), LENS, (160, 120))
    reach = np.abs(wall.vertices[:, :2]).max(1)
    shadow = 15.0 * 450.0 / 400.0
    on_wall = view.weight[: len(wall.vertices)]
    assert (on_wall[reach < shadow + 1.5] == 0).all()
    in_picture = reach < 38.0
    assert (on_wall[in_picture & (reach > shadow + 12.0)] > 0.9).all()
    assert (view.weight[len(wall.vertices) :] > 0.9).all()


def test_samples_are_the_colours_behind_the_vertices():
    """The picture shows each pixel's own coordinates, so samples must equal the projections."""
    ball = sphere(40.0, 3)
    viewer = SurfaceViewer.of(ball)
    v, u = np.mgrid[0:120, 0:160] + 0.5
    picture = flat_picture(linear=np.stack([u, v, 0 * u + 1], axis=-1).astype(np.float32))
    poses = nods(np.array([0.0, 25.0]), distance=450.0)
    index = np.nonzero(np.abs(ball.vertices[:, 1]) < 20)[0][::2]
    samples = gather_samples(viewer, index, [picture, picture], poses, LENS)
    for f in range(2):
        in_camera = ball.vertices[index] @ poses[f, :3, :3].T + poses[f, :3, 3]
        pixels = 300.0 * in_camera[:, :2] / in_camera[:, 2:] + [80, 60]
        seen = samples.weight[:, f] > 0
        assert 0.3 < seen.mean() < 0.6
        assert np.allclose(samples.colours[seen, f, :2], pixels[seen], atol=0.05)
        assert (samples.colours[~seen, f] == 0).all()
    assert np.array_equal(samples.frames(np.array([1])).points(np.arange(3)).colours, samples.colours[:3, 1:])


def test_texels_of_a_square_are_squares():
    assert np.allclose(texel_size(grid_plane(5, 64.0), 128), 0.5)
