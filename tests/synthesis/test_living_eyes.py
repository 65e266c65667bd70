"""Living eyes: round eyeballs under lids, gaze and blinks, the mirror of the cornea, light where lids have moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from shared.geometry.eyeballs import EYE_RADIUS_MM, Eyeball, eyeballs_of, fit_sphere, gaze_direction
from shared.geometry.surface import Surface
from shared.geometry.transforms import WORLD_FROM_CAMERA, camera_centres, rigid, rotation_from_vector
from shared.io.arrays import load_arrays, read_json
from shared.rendering import brdf
from shared.rendering.envmap import latlong_directions
from tools.synthesis.camera import PictureQuality
from tools.synthesis.eye_light import eye_irradiance
from tools.synthesis.eyes import DEPTH_SPREAD_MM, RADIUS_SPREAD, living_head
from tools.synthesis.gaze import HALF_SHUT, EyeMotion, blink_curve, eye_motion, towards_camera, true_eyes, wandering
from tools.synthesis.head import Head, head_turn, random_head
from tools.synthesis.highlights import LobeSamples, mirrored_radiance
from tools.synthesis.iris import (
    CORNEA_RADIUS_MM,
    IRIS_RADIUS_MM,
    PUPIL_ALBEDO,
    WET_SPECULAR,
    paint_eyes,
)
from tools.synthesis.irradiance import (
    IrradianceQuality,
    SyntheticShot,
    assemble_atlas,
    covered_texels,
    group_irradiance,
    refresh_atlas,
)
from tools.synthesis.light import EnvironmentLight, LampSphere
from tools.synthesis.lips import slit_mm, with_shut_lips
from tools.synthesis.subject import PRESETS, head_model, main, synthesize
from tools.synthesis.surface import Materials, ShadingPoints, SyntheticSurface

SEED = 3


@pytest.fixture(scope="module")
def made():
    return living_head(head_model(1), SEED)


@pytest.fixture(scope="module")
def paint(made):
    return paint_eyes(made[1], 0.35, SEED)


@pytest.fixture(scope="module")
def poses():
    return head_turn(24, 950.0, 0.0, SEED)


def eyeballs(head: Head) -> tuple[Eyeball, Eyeball]:
    return eyeballs_of(Surface(head.mesh, head.face_segment, head.segment_names))


def test_eyeballs_are_spheres_of_adult_size_where_the_models_begin(made):
    head, eyes = made
    for ball, oval, centre in zip(eyeballs(head), eyeballs(random_head(head_model(1), SEED, False)), eyes.centres,
                                  strict=True):
        np.testing.assert_allclose(np.linalg.norm(head.mesh.vertices[ball.vertices] - centre, axis=1), eyes.radius)
        assert 0 < abs(eyes.radius / EYE_RADIUS_MM - 1.0) <= RADIUS_SPREAD
        assert np.abs(centre - oval.centre)[:2].max() < 1e-9
        assert 0 < abs((centre[2] + eyes.radius) - (oval.centre[2] + oval.radius)) <= DEPTH_SPREAD_MM
    sides = [eyes.face_side[ball.faces] for ball in eyeballs(head)]
    assert (sides[0] == 0).all() and (sides[1] == 1).all() and (eyes.face_side >= 0).sum() == sum(map(len, sides))


def test_lids_open_and_meet(made):
    head, eyes = made
    openings = np.array([eyes.openings(head, amount).mean() for amount in (-0.3, 0.0, 0.25, 0.5, 0.75, 1.0)])
    assert (np.diff(openings) < 0).all() and 7.0 < openings[1] < 11.0
    assert 0.3 < openings[3] / openings[1] < 0.6
    assert openings[-1] == 0.0 and eyes.shown(head, 1.0) == 0 < eyes.shown(head, 0.0)


def test_lids_slide_along_arcs_and_leave_the_eyeballs_alone(made):
    head, eyes = made
    ends = eyes.rest, eyes.rest + eyes.lids(1.0)
    way = eyes.rest + eyes.lids(0.5)
    moved = np.linalg.norm(ends[1] - ends[0], axis=1) > 3.0
    assert moved.sum() > 50
    side = (eyes.rest[moved, 0] > 0).astype(int)
    start, middle, end = (np.linalg.norm(points[moved] - eyes.centres[side], axis=1)
                          for points in (ends[0], way, ends[1]))
    assert (middle >= np.minimum(start, end) - 1e-6).all()
    balls = np.unique(head.mesh.faces[eyes.face_side >= 0])
    assert np.abs(eyes.lids(1.0)[balls]).max() < 1e-9


def test_who_looks_into_the_camera_turns_the_eyes_against_the_head(made, poses):
    eyes = made[1]
    gaze = towards_camera(eyes, poses)
    to_camera = camera_centres(poses)[:, None] - eyes.centres
    distance = np.linalg.norm(to_camera, axis=-1, keepdims=True)
    np.testing.assert_allclose(eyes.centres + distance * gaze_direction(gaze),
                               np.broadcast_to(camera_centres(poses)[:, None], to_camera.shape), atol=1e-6)
    yaw = np.arctan2(poses[:, 0, 2], poses[:, 0, 0])
    assert np.corrcoef(yaw, gaze[:, 0, 0])[0, 1] < -0.99
    assert (gaze[:, 0, 0] > gaze[:, 1, 0]).all()  # the right eye, at -x, turns further to +x: they converge
    half = eye_motion(eyes, poses, 25.0, SEED, "camera", 0.5, 0.0, 9.0)
    np.testing.assert_allclose(half.gaze, 0.5 * gaze)


def test_wandering_eyes_rest_on_points_of_the_room(made):
    eyes, count = made[1], 200
    poses = head_turn(count, 950.0, 0.0, SEED)
    gaze = wandering(eyes, poses, 25.0, np.random.default_rng(0))
    world = np.einsum("fij,fkj->fki", poses[:, :3, :3], gaze_direction(gaze))
    step = np.degrees(np.linalg.norm(np.diff(world[:, 0], axis=0), axis=-1))
    assert np.median(step) < 0.15 and step.max() > 4.0  # in head space the slow turn alone is 0.9 degrees a frame
    assert 8 < (step > 1.0).sum() < 80
    assert np.array_equal(gaze, wandering(eyes, poses, 25.0, np.random.default_rng(0)))


def test_blinks_are_as_many_and_as_long_as_they_should_be():
    shut = blink_curve(250, 25.0, 1.0, np.random.default_rng(0))
    begins = ((shut[1:] > 0) & (shut[:-1] == 0)).sum()
    assert begins == 10 and 0.15 < (shut > 0.5).mean() < 0.25
    assert not blink_curve(40, 25.0, 0.0, np.random.default_rng(0)).any()
    assert blink_curve(12, 25.0, 0.5, np.random.default_rng(0)).max() > 0.5  # short clips have one all the same


def test_gaze_is_unknown_while_lids_are_more_than_half_shut(made):
    head, eyes = made
    motion = EyeMotion(np.full((3, 2, 2), 0.1), np.array([0.0, 0.3, 0.8]))
    truth = true_eyes(eyes, head, motion)
    np.testing.assert_allclose(truth["aperture"][0], 1.0)
    assert (truth["aperture"][1] > HALF_SHUT).all() and (truth["aperture"][2] < HALF_SHUT).all()
    assert np.isfinite(truth["gaze"][:2]).all() and np.isnan(truth["gaze"][2]).all()


def test_lids_follow_the_eyes_down_and_up(made):
    turned = [rigid(WORLD_FROM_CAMERA @ rotation_from_vector(np.array([pitch, 0.0, 0.0])), np.array([0, 0, 950.0]))
              for pitch in (0.2, 0.0, -0.2)]
    motion = eye_motion(made[1], np.stack(turned), 25.0, SEED, "camera", 1.0, 0.0, 9.0)
    down = np.argsort(motion.gaze[:, 0, 1])
    assert motion.gaze[down[0], 0, 1] < -0.1 < 0.1 < motion.gaze[down[2], 0, 1]
    assert motion.lids[down[0]] > motion.lids[down[1]] > motion.lids[down[2]]


def test_the_pupil_is_where_the_gaze_says_and_the_iris_as_wide_as_eyes_are(made, paint):
    eyes, gaze = made[1], np.array([[0.3, -0.2], [-0.4, 0.1]])
    towards = gaze_direction(gaze)
    albedo, roughness, _, normal = paint.look(eyes.centres + eyes.radius * towards, -towards, np.array([0, 1]), gaze)
    assert np.allclose(albedo, PUPIL_ALBEDO, atol=0.01) and (roughness < 0.1).all()
    np.testing.assert_allclose(normal, towards, atol=1e-6)
    polar = np.arcsin((IRIS_RADIUS_MM + np.array([-0.6, 0.6])) / eyes.radius)
    around = np.linspace(0, 2 * np.pi, 40)
    inside, outside = (paint.colour(np.stack([np.sin(p) * np.cos(around), np.sin(p) * np.sin(around),
                                              np.full(40, np.cos(p))], 1)).mean() for p in polar)
    assert outside > 4.0 * inside


def test_the_cornea_mirrors_like_a_sphere_of_its_own_radius(made, paint):
    eyes = made[1]
    x = np.array([0.0, 1.0, 3.0, 5.0])
    on_ball = np.stack([x, 0 * x, np.sqrt(eyes.radius**2 - x**2)], 1)
    ahead = np.tile([0.0, 0.0, -1.0], (4, 1))
    _, _, place, normal = paint.look(eyes.centres[0] + on_ball, ahead, np.zeros(4, int), np.zeros((2, 2)))
    np.testing.assert_allclose(normal[:, 0], x / CORNEA_RADIUS_MM, atol=1e-6)
    local = place - eyes.centres[0]
    np.testing.assert_allclose(local[:, 0], x, atol=1e-6)
    assert (local[:, 2] > on_ball[:, 2]).all()
    beside = np.array([[9.0, 0.0, np.sqrt(eyes.radius**2 - 81.0)]])
    _, _, place, normal = paint.look(eyes.centres[0] + beside, ahead[:1], np.zeros(1, int), np.zeros((2, 2)))
    np.testing.assert_allclose(normal, beside / eyes.radius, atol=1e-9)
    np.testing.assert_allclose(place, eyes.centres[0] + beside)


class Empty:
    """Nothing is in the way."""

    class scene:
        @staticmethod
        def occluded(origins, directions):
            return np.zeros(len(origins), bool)

    @staticmethod
    def hits(origins, directions):
        return np.zeros(0, int), np.zeros((0, 2)), np.ones(len(directions), bool)

    @staticmethod
    def albedo(uv):
        return np.zeros((len(uv), 3), np.float32)


def mirrored(light: EnvironmentLight, normal, outgoing, lamps_at=None, position=(0.0, 0.0, 0.0)):
    rng = np.random.default_rng(0)
    samples = LobeSamples.draw(light, np.eye(3), 64, 1, rng, lamps_at)
    normal, outgoing = (np.float32(v)[None] / np.float32(np.linalg.norm(v)) for v in (normal, outgoing))
    points = ShadingPoints(np.float32(position)[None], normal, normal, np.zeros((1, 2), np.float32))
    return mirrored_radiance(Empty, light, np.zeros((4, 4, 3), np.float32), np.eye(3), points, outgoing,
                             np.float32([0.03]), samples, np.zeros(1, int))[0]


def sunny(towards, half_angle_deg: float) -> np.ndarray:
    towards = np.array(towards) / np.linalg.norm(towards)
    inside = latlong_directions(128) @ towards > np.cos(np.radians(half_angle_deg))
    return np.where(inside[..., None], 50.0, 0.1).astype(np.float32) * np.ones(3, np.float32)


def test_a_wet_surface_shows_the_lamp_where_a_mirror_would():
    light = EnvironmentLight(sunny([1.0, 0.0, 1.0], 6.0))
    normal, outgoing = [np.sin(np.pi / 8), 0.0, np.cos(np.pi / 8)], [0.0, 0.0, 1.0]
    expected = brdf.schlick_fresnel(np.cos(np.pi / 8)) * 50.0
    np.testing.assert_allclose(mirrored(light, normal, outgoing), expected, rtol=0.02)
    np.testing.assert_allclose(mirrored(light, [0.0, 0.0, 1.0], outgoing), 0.1 * brdf.F0, rtol=0.05)
    assert WET_SPECULAR * brdf.F0 == pytest.approx(0.02504, rel=1e-3)


def test_a_near_lamp_is_mirrored_from_where_it_stands():
    centre, towards = np.array([0.0, 0.0, -100.0]), np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)
    lamps, place = LampSphere(centre, 500.0), np.array([0.0, 0.0, 60.0])
    lamp = centre + 500.0 * towards
    way = (lamp - place) / np.linalg.norm(lamp - place)
    np.testing.assert_allclose(lamps.met_by(place[None], way[None])[0], towards, atol=1e-9)
    light, outgoing = EnvironmentLight(sunny(towards, 6.0), lamps), np.array([0.0, 0.0, 1.0])
    half = way + outgoing
    angle = np.arccos(half @ outgoing / np.linalg.norm(half))
    expected = brdf.schlick_fresnel(np.cos(angle)) * 50.0
    np.testing.assert_allclose(mirrored(light, half, outgoing, lamps, place), expected, rtol=0.03)
    assert mirrored(light, towards + outgoing, outgoing, lamps, place).max() < 0.1 * expected


@pytest.mark.parametrize("near_mm", [0.0, 400.0])
def test_unshaded_eyes_receive_what_the_light_sends(near_mm):
    """The sum over the map's texels. A lamp however near sends the same to a point that lies in its centre."""
    lamps = LampSphere(np.zeros(3), near_mm) if near_mm else None
    image = sunny([1.0, 0.0, 1.0], 6.0)
    light = EnvironmentLight(image, lamps)
    pose = np.eye(4)
    shot = SyntheticShot(pose, np.eye(3), 0, 1)
    normal = np.tile(np.float32([0.0, 0.0, 1.0]), (400, 1))
    points = ShadingPoints(np.zeros((400, 3), np.float32), normal, normal, np.zeros((400, 2), np.float32))
    found = eye_irradiance(Empty, light, np.zeros((4, 4, 3), np.float32), shot, points, np.random.default_rng(0))
    directions = latlong_directions(128)
    solid_angle = np.sqrt(1.0 - directions[..., 1] ** 2) * (np.pi / 128) ** 2
    expected = (image[..., 0] * np.maximum(directions[..., 2], 0.0) * solid_angle).sum()
    np.testing.assert_allclose(found.mean(0), expected, rtol=0.02)


def test_light_traced_anew_where_nothing_moved_is_the_light_that_was(made, paint):
    head = made[0]
    surface, size = SyntheticSurface(head.mesh, small_materials()), 64
    quality = IrradianceQuality(size=size, directions=64, groups=2)
    light = EnvironmentLight(np.ones((16, 32, 3), np.float32))
    shot = SyntheticShot(rigid(WORLD_FROM_CAMERA, np.array([0.0, 0.0, 950.0])), np.eye(3), 0, 1)
    texels, face, bary = covered_texels(surface, size)
    near = np.zeros(size * size, bool)
    near[texels] = np.linalg.norm(surface.points(face, bary).position - made[1].centres[0], axis=1) < 32.0
    whole = [group_irradiance(surface, [light], [shot], g, quality, 0).open_ones() for g in range(2)]
    part = [group_irradiance(surface, [light], [shot], g, quality, 0, near).open_ones() for g in range(2)]
    assert 0 < sum(len(g.texels) for g in part) < 0.5 * sum(len(g.texels) for g in whole)
    atlas = assemble_atlas(surface, whole, size)
    again = refresh_atlas(surface, atlas, part, near, size)
    before, after = (image.reshape(size * size, 3)[texels] for image in (atlas, again))
    np.testing.assert_allclose(after, before, atol=2e-3 * atlas.max())


def small_materials():
    one = np.ones((4, 4), np.float32)
    return Materials(0.4 * np.ones((4, 4, 3), np.float32), one, 0.4 * one, one)


def test_a_living_subject_holds_its_truth(tmp_path):
    settings = replace(PRESETS["tiny"], eyes="living", gaze="camera", blinks_per_second=2.0, size=96, level=1,
                       frames=10, seed=SEED, truth_frames=3, picture=PictureQuality(sub=1),
                       irradiance=IrradianceQuality(size=64, directions=64, bounces=1, groups=2))
    synthesize(tmp_path / "eyes", settings, 1)
    truth = load_arrays(tmp_path / "eyes" / "gt" / "poses.npz")
    assert truth["gaze"].shape == (10, 2, 2) and truth["aperture"].shape == (10, 2)
    shut = truth["aperture"] < HALF_SHUT
    assert shut.any() and not shut.all() and (np.isnan(truth["gaze"]).all(-1) == shut).all()
    assert not shut[truth["gt_frames"]].any()
    assert read_json(tmp_path / "eyes" / "synthesis.json")["gaze"] == "camera"
    centre, radius = truth["eyeball_centres"], float(truth["eyeball_radius"])
    assert centre.shape == (2, 3) and (centre[:, 0] < 0).tolist() == [True, False] and 11.0 < radius < 13.0


def test_eyes_that_cannot_move_are_refused(tmp_path, capsys):
    assert main([str(tmp_path / "new"), "--gaze", "camera"]) == 2
    assert "add --eyes living" in capsys.readouterr().err
    assert main([str(tmp_path / "new"), "--eyes", "living", "--blinks", "9"]) == 2
    assert "out of range" in capsys.readouterr().err and not (tmp_path / "new").exists()


def test_lips_that_leave_a_slit_are_shut_and_nothing_else_moves(made):
    head, eyes = made
    shut = with_shut_lips(head)
    assert slit_mm(head) > 10.0 and slit_mm(shut) <= 3.0
    moved = np.abs(shut.mesh.vertices - head.mesh.vertices)
    assert 0.1 < moved[:, 1].max() < 3.0 and moved[:, [0, 2]].max() == 0.0
    own = np.unique(head.mesh.faces[np.isin(head.face_segment, [head.segment_names.index(name) for name in
                                                                ("eyes", "lids", "brows", "forehead", "ears")])])
    assert moved[own].max() == 0.0


def test_a_sphere_is_fitted_to_the_round_eyeballs(made):
    head, eyes = made
    own = np.unique(head.mesh.faces[eyes.face_side == 0])
    centre, radius = fit_sphere(head.mesh.vertices[own])
    np.testing.assert_allclose(centre, eyes.centres[0], atol=1e-6)
    assert radius == pytest.approx(eyes.radius)
