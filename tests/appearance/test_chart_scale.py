"""What a colour chart says about the light's scale: its normal, a light of known irradiance, a head that covers part
of it, and its weight against the priors."""

import numpy as np
import pytest
from field_check import below, field_faults
from toy_chart import CENTRED, chart_pose
from toy_head import toy_head

from shared.appearance.albedo_scale import Highlights, resolve_scale
from shared.appearance.chart_scale import chart_normals, describe_scale, scale_warnings, state_chart
from shared.capture.chart import CORNERS, PATCHES, ChartObservation, patch_sigma, reflectances, usable
from shared.contract.records import SOLVE
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import WORLD_FROM_CAMERA, rigid
from shared.rendering.envmap import cube_directions

INTRINSICS = np.array([[1500.0, 0.0, 480.0], [0.0, 1500.0, 320.0], [0.0, 0.0, 1.0]])
PITCH_MM, DISTANCE_MM = 25.0, 900.0
POSE = rigid(WORLD_FROM_CAMERA, np.array([0.0, 0.0, DISTANCE_MM]))
UNCLIPPED = np.zeros((PATCHES, 3), bool)
SKIN = np.array([0.3, 0.2, 0.15])
SUN = np.array([0.6, 0.3, 0.74])


def corners_of(rotation, place):
    """[4, 2] px of a chart at a place in camera space, mm."""
    points = (np.c_[CORNERS, np.zeros(4)] + CENTRED) * PITCH_MM @ rotation.T + place
    return points[:, :2] / points[:, 2:] * 1500.0 + [480.0, 320.0]


def observation_of(white, rotation=None, place=(210.0, 0.0, DISTANCE_MM), frame=0):
    """A chart whose every patch receives the irradiance over pi `white`, [3] or [24, 3]."""
    rotation = np.eye(3) if rotation is None else rotation
    values = np.maximum(reflectances(), 0.0) * white
    weight = usable(UNCLIPPED) / patch_sigma() ** 2
    middle, corners = np.broadcast_to(white, (PATCHES, 3)).mean(0), corners_of(rotation, np.array(place))
    return ChartObservation(corners, values, weight, middle, np.full(3, 0.02), frame, 10 * frame)


def sun_and_sky(resolution=16):
    """A broad sun of 1, 0.8, 0.6 on a sky of 0.3, as a cubemap."""
    lobe = np.exp(4.0 * (cube_directions(resolution) @ SUN / np.linalg.norm(SUN) - 1.0))
    return 0.3 + lobe[:, None] * np.array([1.0, 0.8, 0.6])


def irradiance_over_pi(light, normal):
    """Brute force over fine directions, [3]."""
    directions = cube_directions(64)
    texel = 6 * 64**2
    solid = (1 + (np.abs(directions) / np.abs(directions).max(1, keepdims=True)) ** 2 @ np.ones(3) - 1) ** -1.5
    values = 0.3 + np.exp(4.0 * (directions @ SUN / np.linalg.norm(SUN) - 1.0))[:, None] * np.array([1.0, 0.8, 0.6])
    weight = np.maximum(directions @ normal, 0.0) * solid
    return 4.0 * (weight[:, None] * values).sum(0) / (solid.sum() / texel) / texel


def far_scene():
    """A head nowhere near the chart: the toy head's mesh, some metres above."""
    mesh = toy_head(2).mesh(np.zeros(2), np.zeros(1))
    return RayScene(mesh.vertices + [0.0, 9000.0, 0.0], mesh.faces)


@pytest.mark.parametrize("tilt", [0, 8, 25, 50])
def test_normals_scatter_about_the_true_one(tilt):
    rotation = chart_pose(4, tilt)
    normals, log_weight = chart_normals(corners_of(rotation, np.array([150.0, 20.0, DISTANCE_MM])), INTRINSICS)
    weight = np.exp(log_weight - log_weight.max())
    mean = weight @ normals / weight.sum()
    true = -rotation[:, 2]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-6)
    angle = np.degrees(np.arccos(mean @ true / np.linalg.norm(mean)))
    assert angle < 2.0 and (normals[:, 2] < 0).all()


@pytest.mark.parametrize("tilt", [0, 20, -40])
def test_a_light_of_known_irradiance_gets_its_factor(tilt):
    rotation, factor = chart_pose(0, tilt), np.array([1.5, 1.2, 0.8])
    light = sun_and_sky()
    white = irradiance_over_pi(light, WORLD_FROM_CAMERA @ -rotation[:, 2])
    statement, warning = state_chart([observation_of(factor * white, rotation)], far_scene(), POSE[None], INTRINSICS,
                                     "head")
    found, covariance = statement.log_factor(light, SKIN)
    assert warning == ""
    np.testing.assert_allclose(found, np.log(factor), atol=0.02)
    sigma = np.sqrt(np.diag(covariance))
    assert (0.03 < sigma).all() and (sigma < 0.1).all()
    ratio = np.array([1.0, -1.0, 0.0])
    assert np.sqrt(ratio @ covariance @ ratio) < 0.04


def test_the_camera_carried_around_turns_the_chart_with_the_head():
    rotation, light = chart_pose(0, 15), sun_and_sky()
    turn = chart_pose(0, 30)
    pose = rigid(turn @ WORLD_FROM_CAMERA, np.array([0.0, 0.0, DISTANCE_MM]))
    white = irradiance_over_pi(light, pose[:3, :3].T @ -rotation[:, 2])
    observations = [observation_of(white, rotation, frame=1)]
    statement, _ = state_chart(observations, far_scene(), np.stack([POSE, pose]), INTRINSICS, "camera")
    np.testing.assert_allclose(statement.log_factor(light, SKIN)[0], 0.0, atol=0.02)


def test_in_a_white_furnace_the_head_beside_it_changes_nothing():
    """What the head covers it returns: with skin as bright as the sky every place and depth sees the same light."""
    mesh = toy_head(3).mesh(np.zeros(2), np.zeros(1))
    light = np.full((6 * 8**2, 3), 0.5)
    observations = [observation_of(np.full(3, 0.5), place=(place, 0.0, DISTANCE_MM)) for place in (130.0, 200.0)]
    statement, _ = state_chart(observations, RayScene(mesh.vertices, mesh.faces), POSE[None], INTRINSICS, "head")
    np.testing.assert_allclose(statement.log_factor(light, np.full(3, 0.5))[0], 0.0, atol=0.01)
    assert min(view.free.mean() for view in statement.views) < 0.99


def test_a_head_that_shades_the_chart_is_allowed_for():
    """A black head under an even sky, the chart at its depth: shades by patch as traced; without the head in between
    the factor would be too low by the mean shade."""
    mesh = toy_head(3).mesh(np.zeros(2), np.zeros(1))
    scene, light = RayScene(mesh.vertices, mesh.faces), np.full((6 * 8**2, 3), 0.5)
    even = observation_of(np.full(3, 0.5), place=(145.0, 0.0, DISTANCE_MM))
    statement, _ = state_chart([even], scene, POSE[None], INTRINSICS, "head")
    view = statement.views[0]
    at_head = view.free.reshape(-1, PATCHES, view.free.shape[1])[6]
    shade = (at_head @ view.cosine[:, 0]) / view.cosine[:, 0].sum()
    assert 0.5 < shade.min() < 0.9 < shade.max()
    shaded = observation_of(0.5 * np.repeat(shade[:, None], 3, 1), place=(145.0, 0.0, DISTANCE_MM))
    factors = [state_chart([shaded], some, POSE[None], INTRINSICS, "head")[0].log_factor(light, np.zeros(3))[0]
               for some in (scene, far_scene())]
    assert (factors[1] < np.log(shade.mean()) + 0.01).all()
    assert (np.abs(factors[0]) < 0.33 * np.abs(factors[1])).all()


def test_one_odd_view_does_not_carry_the_day():
    light = sun_and_sky()
    white = irradiance_over_pi(light, np.array([0.0, 0.0, 1.0]))
    observations = [observation_of(white), observation_of(white), observation_of(0.4 * white)]
    statement, _ = state_chart(observations, far_scene(), POSE[None], INTRINSICS, "head")
    np.testing.assert_allclose(statement.log_factor(light, SKIN)[0], 0.0, atol=0.02)


def test_a_chart_turned_away_is_not_used_and_none_says_nothing():
    away = observation_of(np.ones(3), chart_pose(0, 72))
    statement, warning = state_chart([away], far_scene(), POSE[None], INTRINSICS, "head")
    assert statement is None and "turned away" in warning
    assert state_chart([], far_scene(), POSE[None], INTRINSICS, "head") == (None, "")


def test_the_scale_follows_the_chart_against_the_priors():
    log_albedo, log_irradiance = np.log([0.5, 0.3, 0.22]), np.log([1.0, 1.0, 1.0])
    wanted = np.log([0.6, 0.5, 0.45])
    covariance = np.full((3, 3), 0.04**2) + np.diag(np.full(3, 0.012**2))
    alone, *_ = resolve_scale(log_albedo, log_irradiance, None, (0.7, 0.25))
    found, *_ = resolve_scale(log_albedo, log_irradiance, None, (0.7, 0.25), chart=(wanted, covariance))
    assert np.abs(alone - wanted).max() > 0.2
    np.testing.assert_allclose(found, wanted, atol=0.03)
    weak, *_ = resolve_scale(log_albedo, log_irradiance, None, (0.7, 0.25), chart=(wanted, covariance * 1e6))
    np.testing.assert_allclose(weak, alone, atol=0.01)
    shiny = Highlights(np.full(3, 0.6), np.full(3, 1e4), np.full(3, 8.0))
    with_shine, specular, *_ = resolve_scale(log_albedo, log_irradiance, shiny, (0.7, 0.25), chart=(wanted, covariance))
    np.testing.assert_allclose(with_shine, found, atol=1e-9)
    wished = 0.6 / np.exp(found).mean()
    assert 0.7 < specular < wished  # between the prior's mean and the samples, and nearer to them
    assert np.log(wished / specular) < 0.3 * np.log(wished / 0.7)


def test_what_is_recorded():
    skin = np.array([0.5, 0.3, 0.22])
    assert "chart" not in describe_scale(None, skin)
    statement, _ = state_chart([observation_of(np.ones(3), frame=0)], far_scene(), POSE[None], INTRINSICS, "head")
    described = describe_scale(statement, skin)
    assert field_faults(described, below(SOLVE, "albedo_scale")) == []
    assert described["method"].startswith("a colour chart") and described["chart"]["frames"] == [0]
    assert described["chart"]["irradiance_over_pi"] == [1.0, 1.0, 1.0]
    assert (np.abs(np.log(described["chart"]["priors_alone_factor"])) < 0.3).all()
    assert scale_warnings(statement, skin) == [] == scale_warnings(None, 3 * skin)
    assert "in the face's own light" in scale_warnings(statement, 3 * skin)[0]
