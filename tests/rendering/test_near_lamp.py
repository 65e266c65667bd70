"""A lamp that stands near, against closed forms and brute force."""

import numpy as np
import pytest
from shapes import sphere

from shared.geometry.mesh import normalised
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import (
    camera_centres,
    fibonacci_sphere,
    places_in_world,
    rigid,
    rotation_from_vector,
    world_from_head,
)
from shared.rendering.brdf import specular_cosine
from shared.rendering.envmap import (
    cube_directions,
    cube_from_latlong,
    cube_lookup,
    cube_solid_angles,
    latlong_directions,
    latlong_from_cube,
)
from shared.rendering.near_lamp import FAR, LampView, NearLamp, SeenLamp, latlong_at, without_lamp
from shared.rendering.shading import Material, VertexShading
from shared.rendering.transfer import Points, bounce_nodes, mesh_points, trace_transfer

DIRECTIONS = fibonacci_sphere(768)
AXIS = normalised(np.array([-0.8, 0.3, 0.5]))
FLIP = np.diag([1.0, -1.0, -1.0])


def some_poses():
    """A head that turns and walks before the camera."""
    turns = rotation_from_vector(np.array([[0.0, -0.4, 0.1], [0.1, 0.0, 0.0], [-0.1, 0.5, 0.0]]))
    return rigid(FLIP @ turns, np.array([[20.0, 5.0, 900.0], [0.0, -10.0, 940.0], [-30.0, 0.0, 1000.0]]))


def lamp_at(distance, poses, radius=0.2):
    centre = places_in_world(poses, "head").mean(0)
    return NearLamp(distance, tuple(centre), tuple(AXIS), radius)


def lamp_light(resolution=16, width=0.05):
    """Radiance [6 n^2, 3] of a lamp some degrees wide, dark beside it."""
    cosine = cube_directions(resolution) @ AXIS
    return np.exp((cosine - 1.0) / width**2)[:, None] * np.array([3.0, 2.0, 1.0]) * (cosine > 0.985)[:, None]


def open_points(count=60, radius=90.0):
    normals = fibonacci_sphere(count)
    return Points(radius * normals, normals)


def everything(points):
    """Visible are all directions above the horizon."""
    return points.normals @ DIRECTIONS.T > 0


def brute_force(light, lamp, poses, frame, position):
    """Directions [M, 3] from a head-space position to sources of the light, and their radiance times solid angle at
    the position [M, 3]: each source is a point in the world."""
    resolution = round((len(light) / 6) ** 0.5)
    fine = cube_directions(8 * resolution)
    fine_solid, seen = cube_solid_angles(8 * resolution), fine @ AXIS > 0.9
    power = (cube_lookup(fine[seen], resolution) @ light) * fine_solid[seen, None]
    turn, place = world_from_head(poses, "head")[frame], places_in_world(poses, "head")[frame]
    if lamp.distance_mm == FAR:
        return fine[seen] @ turn, power
    sources = np.array(lamp.centre) + lamp.distance_mm * fine[seen]
    towards = sources - (turn @ position + place)
    distance = np.linalg.norm(towards, axis=1, keepdims=True)
    return (towards / distance) @ turn, power * (lamp.distance_mm / distance) ** 2


@pytest.mark.parametrize("distance", [400.0, 1000.0, FAR])
def test_irradiance_is_that_of_points_in_the_world(distance):
    poses, points, light = some_poses(), open_points(), lamp_light()
    lamp = lamp_at(distance, poses)
    view = LampView(SeenLamp.of(lamp, poses, "head"), 16, DIRECTIONS)
    found = view.irradiance(points, everything(points), view.radiance(light))
    for frame in range(3):
        expected = []
        for position, normal in zip(points.positions, points.normals, strict=True):
            towards, power = brute_force(light, lamp, poses, frame, position)
            expected.append((np.maximum(towards @ normal, 0.0)[:, None] * power).sum(0) / np.pi)
        np.testing.assert_allclose(found[:, frame], expected, rtol=0.01, atol=2e-3 * np.max(expected))


def test_a_small_lamp_follows_the_inverse_square_and_the_cosine():
    poses, points, light = some_poses(), open_points(), lamp_light(32, 0.02)
    lamp = lamp_at(500.0, poses, 0.1)
    view = LampView(SeenLamp.of(lamp, poses, "head"), 32, DIRECTIONS)
    found = view.irradiance(points, everything(points), view.radiance(light))[:, 0, 0]
    intensity = (light[:, 0] * cube_solid_angles(32)).sum() * 500.0**2 / np.pi
    turn, place = world_from_head(poses, "head")[0], places_in_world(poses, "head")[0]
    towards = (lamp.position - place) @ turn - points.positions
    distance = np.linalg.norm(towards, axis=1)
    cosine = (towards * points.normals).sum(1) / distance
    lit = cosine > 0.3
    assert np.ptp(distance[lit]) > 50.0
    np.testing.assert_allclose(found[lit], (intensity * cosine / distance**2)[lit], rtol=0.02)


def test_rows_times_radiance_are_the_irradiance_and_the_reflection():
    poses, points, light = some_poses(), open_points(), lamp_light()
    view = LampView(SeenLamp.of(lamp_at(450.0, poses), poses, "head"), 16, DIRECTIONS)
    visible, radiance = everything(points), view.radiance(light)
    rows = view.irradiance_rows(points, visible)
    assert rows.shape == (60, 3, len(view.texels))
    np.testing.assert_allclose(rows @ light[view.texels], view.irradiance(points, visible, radiance), rtol=1e-4,
                               atol=1e-5)
    towards = normalised(camera_centres(poses)[None] - points.positions[:, None])
    alpha2 = np.full(60, 0.4**4, np.float32)
    lobes = view.lobe_rows(points, visible, towards, alpha2) @ light[view.texels]
    for frame in range(3):
        found = view.reflection(points, visible, towards[:, frame], alpha2, radiance, frame)
        np.testing.assert_allclose(lobes[:, frame], found, rtol=1e-4, atol=1e-5)


def test_reflection_is_the_lobe_summed_over_points_in_the_world():
    poses, points, light = some_poses(), open_points(200), lamp_light()
    lamp = lamp_at(450.0, poses)
    view = LampView(SeenLamp.of(lamp, poses, "head"), 16, DIRECTIONS)
    towards = normalised(camera_centres(poses)[None] - points.positions[:, None])[:, 1]
    alpha2 = np.full(200, 0.4**4, np.float32)
    found = view.reflection(points, everything(points), towards, alpha2, view.radiance(light), 1)
    expected = []
    for position, normal, outgoing in zip(points.positions, points.normals, towards, strict=True):
        incoming, power = brute_force(light, lamp, poses, 1, position)
        lobe = specular_cosine(normal @ outgoing, incoming @ normal, incoming @ outgoing, 0.4)
        expected.append((lobe[:, None] * power).sum(0))
    facing = (towards * points.normals).sum(1) > 0.2
    np.testing.assert_allclose(found[facing], np.array(expected)[facing], rtol=0.03, atol=0.01 * np.max(expected))


def test_what_is_covered_sees_no_lamp():
    poses, points, lamp = some_poses(), open_points(), lamp_at(450.0, some_poses())
    view = LampView(SeenLamp.of(lamp, poses, "head"), 16, DIRECTIONS)
    turn, place = world_from_head(poses, "head")[0], places_in_world(poses, "head")[0]
    towards = normalised((lamp.position - place) @ turn - points.positions)
    high = (towards * points.normals).sum(1) > 0.6
    seen, covered = (view.irradiance_rows(points, visible)[:, 0]
                     for visible in (everything(points), np.zeros((60, len(DIRECTIONS)), bool)))
    assert high.sum() > 5 and (seen[high].sum(1) > 0).all() and (covered[high] == 0).all()


def test_vertex_shading_under_a_near_lamp():
    """Nodes and points on a ball: what bounces is none, reflection and irradiance are the view's; far, they are those
    of the light along directions."""
    ball = sphere(80.0, 3)
    scene, nodes, poses = RayScene(ball.vertices, ball.faces), bounce_nodes(ball, 40), some_poses()
    directions = fibonacci_sphere(6000)
    points, light = mesh_points(ball), lamp_light() + 0.1
    traced = (trace_transfer(scene, some, nodes, directions) for some in (points, nodes.points))
    place = np.arange(len(ball.vertices)), ball.vertices, points, *traced
    material = Material(np.full((len(nodes.points), 3), 0.4), 0.7, 0.4)
    shadings = [VertexShading(*place, material, light, directions, poses, "head", lamp=lamp, node_points=nodes.points)
                for lamp in (None, lamp_at(FAR, poses), lamp_at(400.0, poses))]
    plain, far, near = ((s.irradiance(1), s.reflection(1)) for s in shadings)
    for expected, found in zip(plain, far, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0.05, atol=0.02 * expected.max())
    lamp = lamp_at(400.0, poses)
    without = light.copy()
    view = LampView(SeenLamp.of(lamp, poses, "head"), 16, directions)
    without[view.texels] = 0.0
    rest = VertexShading(*place[:3], *(trace_transfer(scene, some, nodes, directions) for some in
                                       (points, nodes.points)), material, without, directions, poses, "head")
    expected = rest.irradiance(1) + view.irradiance(points, shadings[2].table.visible, view.radiance(light))[:, 1]
    np.testing.assert_allclose(near[0], expected, rtol=0.01, atol=0.01)
    vectors = shadings[2].lamp_vectors(np.arange(len(points)), np.array([1]))
    np.testing.assert_allclose(np.einsum("pfcx,px->pfc", vectors, points.normals)[:, 0], expected - rest.irradiance(1),
                               rtol=1e-3, atol=1e-3)
    assert near[0].max() - 0.1 > 1.3 * (far[0].max() - 0.1)  # what faces the lamp is nearer to it



def test_the_light_at_another_place_is_what_arrives_there():
    """As an image it gives a small surface there the irradiance that the sources give it."""
    poses, light = some_poses(), lamp_light() + 0.05
    lamp = lamp_at(450.0, poses)
    view, turn = LampView(SeenLamp.of(lamp, poses, "head"), 16, DIRECTIONS), world_from_head(poses, "head")[0]
    place = np.array([40.0, -30.0, 60.0])
    image = latlong_at(light, lamp, places_in_world(poses, "head")[0] + turn @ place, 128)
    directions = latlong_directions(128)
    solid = np.sin(np.arccos(directions[..., 1])) * (np.pi / 128) ** 2
    normals = fibonacci_sphere(40)
    points = Points(np.tile(place, (40, 1)), normals)
    rest = without_lamp(light, lamp)
    far = latlong_from_cube(rest, 128)
    found = [np.einsum("hw,hwc->c", np.maximum(directions @ turn @ normal, 0.0) * solid, image - far) / np.pi
             for normal in normals]
    expected = view.irradiance(points, everything(points), view.radiance(light))[:, 0]
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.02 * expected.max())
    at_centre = latlong_at(light, lamp, np.array(lamp.centre), 64)
    np.testing.assert_allclose(at_centre, latlong_from_cube(light, 64), atol=0.2, rtol=0.02)


def test_a_lamp_seen_from_another_place_shines_as_it_did():
    """With the light that arrives there, which is what files hold."""
    poses, light, points = some_poses(), lamp_light(), open_points()
    lamp = lamp_at(450.0, poses)
    place = np.array(lamp.centre) + [30.0, -20.0, 60.0]
    again, seen = lamp.seen_from(place, 16), cube_from_latlong(latlong_at(light, lamp, place, 128), 16)
    assert again.centre == tuple(place)
    np.testing.assert_allclose(again.position, lamp.position)
    views = [LampView(SeenLamp.of(one, poses, "head"), 16, DIRECTIONS) for one in (lamp, again)]
    before, after = (view.irradiance(points, everything(points), view.radiance(own))
                     for view, own in zip(views, (light, seen), strict=True))
    np.testing.assert_allclose(after, before, rtol=0.03, atol=0.03 * before.max())
