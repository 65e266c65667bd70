"""How far away the main lamp stands, on synthetic captures."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from field_check import below, field_faults
from slow import SLOW
from toy_capture import MATTE, make_truth, small_lamp, swinging, under_true_light

from shared.appearance.fit import Solution, fit_appearance
from shared.appearance.problem import AppearanceProblem
from shared.contract.records import SOLVE
from shared.errors import InputError
from shared.geometry.mesh import normalised
from shared.geometry.transforms import places_in_world
from shared.inverse.lamp_distance import describe_lamp, directions_towards, lit_by_lamp, passing, solve_distance
from shared.inverse.parameters import read_lamp_distance
from shared.rendering.direction_set import widest_spacing
from shared.rendering.envmap import cube_directions, cube_solid_angles
from shared.rendering.near_lamp import FAR, NearLamp, SeenLamp

AXIS = tuple(normalised(np.array([-0.6, 0.5, 0.7])))


class Poses:
    """Of the capture's frames, all there is to views here."""

    camera_from_head = swinging()


def lamp_at(distance, radius=0.3):
    centre = places_in_world(Poses.camera_from_head, "head").mean(0)
    return NearLamp(distance, tuple(centre), AXIS, radius)


@pytest.fixture(scope="module")
def truth():
    return make_truth(lights=(small_lamp,))[0]


def with_small_lamp(state):
    return replace(state, params=np.log(small_lamp(cube_directions(16))))


def fit_like(state):
    return Solution(state, (), 0.0, 0.0)


def lit_from(truth, distance):
    """The capture as a lamp at a distance would have lit it, matte, and its light."""
    settings = replace(MATTE, noise=(0.003, 0.01))
    problem, state = under_true_light(truth, settings)
    state = replace(with_small_lamp(state), specular=0.0)
    seen = SeenLamp.of(lamp_at(distance), Poses.camera_from_head, "head")
    lit = AppearanceProblem.of(replace(truth, lamp=seen), settings)
    irradiance, _ = lit.transport(state).forward(state.light)
    colours = (state.albedo[:, None] * irradiance.numpy().transpose(1, 2, 0)).astype(np.float32)
    colours += 0.002 * np.random.default_rng(1).normal(size=colours.shape).astype(np.float32)
    return replace(truth, samples=replace(truth.samples, colours=colours))


@pytest.mark.parametrize("distance", [450.0, 800.0] if SLOW else [800.0])
def test_the_distance_of_a_lamp_is_found(truth, distance):
    capture = lit_from(truth, distance)
    settings = replace(MATTE, resolutions=(16,), steps=8)
    start = fit_appearance(capture, settings)
    assert lit_by_lamp(capture, start)
    found, record = solve_distance(capture, Poses, settings, start, "head", lambda text: None)
    assert record["near"] and record["fall"] > record["standard_error"]
    said = describe_lamp(found.lamp, found.state.light, record, Poses, "head")
    assert said["distance_mm"] == pytest.approx(distance, rel=0.15)
    assert field_faults(said, below(SOLVE, "lamp")) == []
    told = NearLamp.of_record(said)
    np.testing.assert_allclose(told.position, found.lamp.position, atol=0.01)
    head = places_in_world(Poses.camera_from_head, "head").mean(0)
    seen = found.lamp.seen_from(head, 16)
    np.testing.assert_allclose((*told.centre, *told.axis), (*head, *seen.axis), atol=0.01)
    assert told.radius == pytest.approx(seen.radius, abs=1e-5)
    assert NearLamp.of_record({"near": False}) is None
    truth_mm = lamp_at(distance).position
    assert np.linalg.norm(np.subtract(said["position_mm"], truth_mm)) < 0.2 * distance


def test_a_far_lamp_stays_far(truth):
    capture = lit_from(truth, FAR)
    settings = replace(MATTE, resolutions=(16,), steps=8)
    start = fit_appearance(capture, settings)
    found, record = solve_distance(capture, Poses, settings, start, "head", lambda text: None)
    assert not record["near"] and found.lamp is None


def test_even_light_has_no_lamp(truth):
    problem, state = under_true_light(truth, MATTE)
    even = replace(state, params=np.zeros_like(state.params))
    assert not lit_by_lamp(truth, fit_like(even)) and lit_by_lamp(truth, fit_like(with_small_lamp(state)))


def test_the_lamp_passes_along_few_directions(truth):
    """All that point to it within its radius, seen from anywhere on the head, and none of the opposite side."""
    near, far = (passing(lamp_at(d, 0.1), truth.directions, truth.points.positions, Poses, "head")
                 for d in (400.0, FAR))
    assert 0 < far.sum() < near.sum() < 0.35 * len(near)
    seen = SeenLamp.of(lamp_at(400.0), Poses.camera_from_head, "head")
    position = seen.centres[3] + 400.0 * np.array(AXIS) @ seen.world_from_head[3]
    towards = normalised(position - truth.points.positions[10])
    assert near[(truth.directions @ towards).argmax()] and not near[(truth.directions @ towards).argmin()]


@pytest.mark.parametrize("spacings, parts", [(0.5, 16), (1.5, 4), (3.0, 1)])
def test_a_broad_lamp_needs_few_directions(truth, spacings, parts):
    """A lamp's radius in spacings of the even set."""
    lamp = lamp_at(600.0, spacings * widest_spacing(truth.directions))
    lit = SimpleNamespace(precomputed=truth, coarse=truth)
    passed = passing(lamp, truth.directions, truth.points.positions, Poses, "head")
    towards = directions_towards(lamp, lit, Poses, "head")
    expected = len(passed) + (parts - 1) * passed.sum()
    assert len(towards) == (len(passed) if parts == 1 else pytest.approx(expected, rel=0.05))


@pytest.mark.parametrize("text, expected", [("auto", None), ("far", FAR), ("600", 600.0)])
def test_the_parameter(text, expected):
    assert read_lamp_distance(text) == expected


@pytest.mark.parametrize("text", ["near", "50", "-600", "inf", "nan"])
def test_bad_distances_are_refused(text):
    with pytest.raises(InputError, match="no distance of a lamp"):
        read_lamp_distance(text)


def test_what_the_record_says():
    """The ball gives what the lamp's texels give, seen head-on."""
    light, lamp = small_lamp(cube_directions(16)), lamp_at(500.0)
    said = describe_lamp(lamp, light, {"near": True}, Poses, "head")
    assert said["near"] and said["distance_mm"] == 500.0
    texels = lamp.texels(16)
    given = np.pi * np.array(said["radiance"]) * (said["radius_mm"] / 500.0) ** 2
    np.testing.assert_allclose(given, cube_solid_angles(16)[texels] @ light[texels], rtol=1e-3)
    assert 0.05 < said["radius_mm"] / 500.0 < 0.2
    assert describe_lamp(None, light, {}, Poses, "head") == {}
