"""Novel and relit views: against closed forms on a sphere, and against the solver's own re-render."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from shapes import nods, sphere

from shared.geometry.blend_shapes import LID_ACTIONS, LOOK_RAD, BlendShape, LidActions
from shared.geometry.transforms import project, rotation_from_vector
from shared.io.arrays import load_arrays, read_json
from shared.io.images import read_exr
from shared.io.meshes import load_mesh
from shared.rendering.brdf import hemispherical_albedo
from shared.rendering.near_lamp import NearLamp
from shared.rendering.precomputed_transfer import Sizes
from shared.rendering.studio_lights import HEIGHT, STUDIO_LIGHTS, facing_irradiance, lamp, studio_light
from shared.rendering.view_set import NOVEL_VIEWS
from shared.rendering.views import HeadViews, ViewCamera, clip_light, frontal_frame, light_in_head_space, orbit_camera
from tools.scoring.measures import psnr

RADIUS, PIXELS, ALBEDO = 90.0, 64, 0.4
SIZES = Sizes(directions=640, nodes=100)


def ball_maps(specular):
    full = np.ones((8, 8), np.float32)
    return {
        "diffuse_albedo": ALBEDO * np.ones((8, 8, 3), np.float32),
        "specular_intensity": specular * full,
        "roughness": 0.5 * full,
    }


def ball(levels=3):
    unit = sphere(1.0, levels)
    return unit.replace(vertices=RADIUS * unit.vertices)


def even_light(radiance=1.0):
    return np.full((HEIGHT, 2 * HEIGHT, 3), radiance)


def test_even_light_shows_the_albedo():
    """White furnace: a convex body without highlights under radiance 1 shows its albedo everywhere, from everywhere."""
    views = HeadViews(ball(), ball_maps(0.0), SIZES)
    for yaw, pitch in NOVEL_VIEWS.values():
        picture = views.render(even_light(), [orbit_camera(ball(), yaw, pitch, PIXELS)])[0]
        middle = picture[PIXELS // 2 - 10 : PIXELS // 2 + 10, PIXELS // 2 - 10 : PIXELS // 2 + 10]
        np.testing.assert_allclose(middle, ALBEDO, rtol=0.01)


def test_a_cameras_gain_brightens_its_picture():
    camera = orbit_camera(ball(), 0.0, 0.0, PIXELS)
    views = HeadViews(ball(), ball_maps(0.0), SIZES)
    gain = np.array([1.5, 1.0, 0.5])
    plain, brightened = views.render(even_light(), [camera, replace(camera, gain=gain)])
    np.testing.assert_allclose(brightened, plain * gain, rtol=1e-6)
    assert plain.max() > 0.0


def test_specular_adds_its_share():
    """Seen head-on under even light the lobe sum is the directional albedo of the lobe, near the hemispherical one."""
    views = HeadViews(ball(), ball_maps(1.0), SIZES)
    picture = views.render(even_light(), [orbit_camera(ball(), 0.0, 0.0, PIXELS)])[0]
    added = picture[PIXELS // 2, PIXELS // 2].mean() - ALBEDO
    assert 0.5 * hemispherical_albedo(0.5) < added < hemispherical_albedo(0.5)


def test_lamps_light_the_side_they_stand_on():
    views = HeadViews(ball(), ball_maps(0.0), SIZES)
    camera = orbit_camera(ball(), 0.0, 0.0, PIXELS)
    left, right, above = (views.render(lamp(*place, (1, 1, 1), 15), [camera])[0] for place in (
        (-70, 0), (70, 0), (0, 70)))
    half = PIXELS // 2
    assert left[:, :half].sum() > 5 * left[:, half:].sum() and right[:, half:].sum() > 5 * right[:, :half].sum()
    assert above[:half].sum() > 5 * above[half:].sum()


def test_a_near_lamp_lights_by_the_inverse_square():
    """Straight ahead of a ball, where the lamp stands nearer by the radius than it does to the middle, and at its side.
    """
    views, camera = HeadViews(ball(4), ball_maps(0.0), SIZES), orbit_camera(ball(), 0.0, 0.0, PIXELS)
    light, distance = lamp(0, 0, (1, 1, 1), 6), 400.0
    near = NearLamp(distance, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.6)
    far, seen = (views.render(light, [camera], lamp=one)[0][PIXELS // 2, :, 0] for one in (None, near))
    ahead = seen[PIXELS // 2] / far[PIXELS // 2]
    assert ahead == pytest.approx((distance / (distance - RADIUS)) ** 2, rel=0.05)
    assert seen[PIXELS // 2 + 18] / far[PIXELS // 2 + 18] < 0.9 * ahead


def test_lights_side_by_side_give_the_pictures_of_each_alone():
    views, camera = HeadViews(ball(), ball_maps(0.7), SIZES), orbit_camera(ball(), 20.0, 10.0, PIXELS)
    lights = [lamp(*place, (1, 1, 1), 15) for place in ((-70, 0), (70, 0), (0, 70))]
    together = views.relit(lights, camera)
    for light, picture in zip(lights, together, strict=True):
        alone = views.render(light, [camera])[0]
        np.testing.assert_allclose(picture, alone, atol=2e-3 * alone.max())


def test_orbit_cameras_stand_where_they_say():
    mesh = ball()
    for yaw, pitch in ((0, 0), (90, 0), (-50, 20), (10, -80)):
        camera = orbit_camera(mesh, yaw, pitch, 200)
        rotation = camera.camera_from_head[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        pixels, depth = project(np.zeros((1, 3)), camera.camera_from_head, camera.intrinsics)
        np.testing.assert_allclose(pixels, [[100.0, 100.0]], atol=1e-9)
        up = project(np.array([[0.0, 10.0, 0.0]]), camera.camera_from_head, camera.intrinsics)[0][0]
        assert abs(pitch) == 80 or up[1] < 100.0
        centre = -camera.camera_from_head[:3, 3] @ rotation
        yaw, pitch = np.radians([yaw, pitch])
        expected = [np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)]
        np.testing.assert_allclose(centre / np.linalg.norm(centre), expected, atol=1e-9)


def test_nothing_covers_a_sphere_and_a_shell_covers_itself():
    """Visibility is 1 on a convex body at every roughness; inside a bowl it falls, to the open share when rough."""
    mesh = ball()
    for roughness in (0.1, 0.5, 0.8):
        seen = HeadViews(mesh, ball_maps(0.0), SIZES).visibility(orbit_camera(mesh, 0, 0, PIXELS), roughness)
        assert np.isnan(seen[0, 0]) and np.nanmin(seen[PIXELS // 4 : -PIXELS // 4, PIXELS // 4 : -PIXELS // 4]) > 0.999
    mesh = ball(4)
    dent = mesh.vertices.copy()
    pushed = np.exp(-(mesh.vertices[:, 0] ** 2 + mesh.vertices[:, 1] ** 2) / 45.0**2) * (mesh.vertices[:, 2] > 0)
    dent[:, 2] -= 50.0 * pushed
    views = HeadViews(mesh.replace(vertices=dent), ball_maps(0.0), SIZES)
    camera = orbit_camera(mesh, 0, 0, PIXELS)
    bottom = slice(PIXELS // 2 - 2, PIXELS // 2 + 2)
    mirror, rough = (views.visibility(camera, roughness)[bottom, bottom].max() for roughness in (0.1, 0.8))
    assert mirror > 0.99 and rough < 0.8  # the bottom of the dent looks straight out


def test_light_turns_with_the_head():
    """A lamp that stands at the camera's side is found at the head's left once the head has turned to its right."""
    turn = rotation_from_vector(np.array([0.0, np.radians(40.0), 0.0]))  # world_from_head
    turned = light_in_head_space(lamp(0, 0, (1, 1, 1), 10), turn)
    row, column = np.unravel_index(turned.sum(-1).argmax(), turned.shape[:2])
    expected = turn.T @ np.array([0.0, 0.0, 1.0])
    u, v = (column + 0.5) / turned.shape[1], (row + 0.5) / turned.shape[0]
    found = np.array([np.sin(2 * np.pi * u) * np.sin(np.pi * v), np.cos(np.pi * v),
                      -np.cos(2 * np.pi * u) * np.sin(np.pi * v)])
    assert found @ expected > np.cos(np.radians(4.0))


def test_frontal_frame():
    assert frontal_frame(nods([-30.0, -4.0, 12.0, 40.0])) == 1


def test_studio_lights_are_usable():
    for name in STUDIO_LIGHTS:
        radiance = studio_light(name)
        assert radiance.min() > 0.0 and np.isfinite(radiance).all()
        assert facing_irradiance(radiance) == pytest.approx(1.0)
    assert facing_irradiance(even_light()) == pytest.approx(np.mean([1.0, 1.0, 1.0]), rel=0.01)
    solid = np.sin(np.pi * (np.arange(HEIGHT) + 0.5) / HEIGHT)[:, None, None] * (np.pi / HEIGHT) ** 2
    np.testing.assert_allclose((lamp(30, 40, (1, 2, 3), 9) * solid).sum((0, 1)), [1, 2, 3], rtol=0.01)


def test_agrees_with_the_solvers_own_render(tiny_run):
    """From the clip's camera in the frontal frame, under the clip's light: what inverse_render re-rendered."""
    solved = tiny_run / "work" / "inverse_render"
    poses = load_arrays(solved / "poses.npz")
    rendered = read_json(solved / "solve.json")["render_frames"]
    kept = np.isin(poses["frame_index"], rendered)
    poses_rendered, index = poses["camera_from_head"][kept], poses["frame_index"][kept]
    frame = frontal_frame(poses_rendered)
    expected = read_exr(solved / "renders" / f"{index[frame]:06d}.exr")
    maps = {name: read_exr(solved / "maps" / f"{name}.exr") for name in (
        "diffuse_albedo", "specular_intensity", "roughness")}
    camera = ViewCamera(poses_rendered[frame], poses["intrinsics_crop"], expected.shape[1::-1])
    light = clip_light(read_exr(solved / "envmap.exr"), poses_rendered, "head")
    found = HeadViews(load_mesh(solved / "mesh.npz"), maps).render(light, [camera])[0]
    both = ((expected > 0).all(-1) & (found > 0).all(-1)).astype(np.uint8)
    inside = cv2.erode(both, np.ones((5, 5), np.uint8)) > 0  # the views fade out at the head's edge, the renders do not
    assert inside.mean() > 0.1 and psnr(expected[inside], found[inside]) > 40.0


def test_lids_move_as_a_camera_says():
    """Two halves of a ball that blinks take away: the picture shrinks on the side of the eye that is shut, and grows
    where the gaze goes up."""
    mesh = ball()
    right = np.where(mesh.vertices[:, :1] < -20.0, [[40.0, 0.0, 0.0]], 0.0)
    left = np.where(mesh.vertices[:, :1] > 20.0, [[-40.0, 0.0, 0.0]], 0.0)
    named = zip(LID_ACTIONS, (right, left, right, left, -right, -left), strict=True)
    lids = LidActions.of([BlendShape.of(name, moves, 0.0) for name, moves in named])
    views, camera = HeadViews(mesh, ball_maps(0.0), SIZES, lids=lids), orbit_camera(mesh, 0.0, 0.0, PIXELS)
    cameras = [camera, *(replace(camera, lids=np.array(own)) for own in ([0.0, 0.0], [1.0, 0.0], [0.0, 0.5]))]
    cameras.append(replace(cameras[1], pitch=np.array([0.25 * LOOK_RAD, 0.0])))
    rest, still, one, half, wider = views.render(even_light(), cameras)
    np.testing.assert_array_equal(rest, still)
    columns = [np.nonzero((picture > 0.0).any((0, 2)))[0] for picture in (rest, one, half, wider)]
    millimetre = (columns[0][-1] - columns[0][0]) / (2.0 * RADIUS)
    assert columns[1][0] - columns[0][0] == pytest.approx(40.0 * millimetre, abs=2)
    assert columns[1][-1] == columns[0][-1]
    assert columns[0][-1] - columns[2][-1] == pytest.approx(20.0 * millimetre, abs=2)
    assert columns[0][0] - columns[3][0] == pytest.approx(10.0 * millimetre, abs=2)
