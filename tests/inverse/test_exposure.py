"""Exposure and white balance that drift: gains of frames beside a still light."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from field_check import below, field_faults
from toy_capture import FRAMES, MATTE, make_truth, swinging
from toy_clip import toy_clip

from shared.appearance.fit import fit_appearance
from shared.capture.chart import ChartObservation
from shared.compute.run_context import SILENT
from shared.contract.records import GAIN, SOLVE
from shared.geometry.transforms import rotation_from_vector
from shared.inverse import exposure
from shared.inverse.exposure import (
    LEAST_FRAMES,
    Exposure,
    asks_for_gains,
    beside_turn,
    centred,
    deviations,
    exposure_warnings,
    extrapolated,
    gains_under,
    left_over,
    solve_exposure,
    solve_gains,
)
from shared.report.advice import advice

CYCLES = 1.3


def wandering(count, amplitude=0.3):
    """[F, 3] log gains: slow waves, red and blue apart."""
    time = np.arange(count) / count
    grey = amplitude * np.sin(2 * np.pi * CYCLES * time + 0.4)
    tint = 0.3 * amplitude * np.sin(2 * np.pi * 1.9 * time + 1.9)
    found = grey[:, None] + tint[:, None] * [1.0, 0.0, -1.0]
    return found - found.mean(0)


def brighter(capture, log_gain):
    samples = capture.samples
    return replace(capture, samples=replace(samples, colours=samples.colours * np.exp(log_gain).astype(np.float32)))


@pytest.fixture(scope="module")
def truth():
    return make_truth(specular=0.0)[0].some_points(300)


@pytest.fixture(scope="module")
def matte():
    return replace(MATTE, noise=(0.003, 0.01))


@pytest.fixture(scope="module")
def wandered(truth, matte):
    """The capture with gains, the gains, and what light without any is solved from it."""
    gains = wandering(FRAMES)
    seen = brighter(truth, gains)
    return seen, gains, fit_appearance(seen, matte)


def test_gains_are_found_though_the_light_took_them_for_shading(wandered, matte):
    seen, gains, misled = wandered
    found, light = solve_gains(seen, misled, matte, SILENT)
    assert np.std(found - gains) < 0.4 * np.std(gains)
    assert light.held_out < 0.15 * misled.held_out
    np.testing.assert_allclose(found.mean(0), 0.0, atol=1e-9)
    assert np.std(gains_under(light, seen, matte) - found) < 0.1 * np.std(found)


def test_only_a_camera_that_is_not_locked_asks_for_gains(truth, wandered, matte, monkeypatch):
    monkeypatch.setattr(exposure, "LEAST_FRAMES", FRAMES)
    settings = SimpleNamespace(appearance=matte)
    assert solve_exposure(None, SimpleNamespace(coarse=truth), fit_appearance(truth, matte), settings, SILENT) is None
    seen, _, misled = wandered
    left = left_over(seen, misled, matte)
    assert asks_for_gains(deviations(left), deviations(beside_turn(left, seen)))


@pytest.mark.parametrize("left, beside, asks", [
    ({"brightness": 0.1, "tint": 0.0}, {"brightness": 0.08, "tint": 0.0}, True),
    ({"brightness": 0.0, "tint": 0.1}, {"brightness": 0.0, "tint": 0.08}, True),
    ({"brightness": 0.1, "tint": 0.0}, {"brightness": 0.01, "tint": 0.0}, False),
    ({"brightness": 0.02, "tint": 0.03}, {"brightness": 0.02, "tint": 0.03}, False),
    ({"brightness": 0.1, "tint": 0.03}, {"brightness": 0.01, "tint": 0.03}, False),
])  # fmt: skip
def test_gains_are_asked_for_by_one_kind_that_is_large_and_not_the_turns(left, beside, asks):
    assert asks_for_gains(left, beside) is asks


def test_what_goes_with_the_turn_is_left_to_the_light():
    rng = np.random.default_rng(0)
    yaw, pitch = 0.5 * rng.normal(size=(2, 60))
    turns = rotation_from_vector(np.stack([pitch, yaw, np.zeros(60)], axis=1))
    capture = SimpleNamespace(world_from_head=turns, light_index=np.zeros(60, int))
    explained = exposure.turns_from_mean(turns)[:, 1] ** 2 - 0.3 * exposure.turns_from_mean(turns)[:, 0]
    gains = np.repeat(explained[:, None], 3, axis=1)
    np.testing.assert_allclose(beside_turn(gains, capture), 0.0, atol=1e-9)
    wave = np.repeat(0.2 * np.sin(np.arange(60))[:, None], 3, axis=1)
    assert np.std(beside_turn(gains + wave, capture)) == pytest.approx(np.std(wave), rel=0.1)


def test_of_few_frames_nothing_is_said():
    few = LEAST_FRAMES - 1
    turns = swinging(few)[:, :3, :3]
    capture = SimpleNamespace(world_from_head=turns, light_index=np.zeros(few, int))
    np.testing.assert_array_equal(beside_turn(wandering(few), capture), 0.0)


def test_gains_are_relative_within_each_light():
    gains = np.random.default_rng(0).normal(size=(10, 3))
    capture = SimpleNamespace(light_index=np.repeat([0, 1], [4, 6]))
    found = centred(gains, capture)
    np.testing.assert_allclose([found[:4].mean(0), found[4:].mean(0)], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.diff(found[:4], axis=0), np.diff(gains[:4], axis=0))


@pytest.mark.parametrize("rate", [0.5, 0.7])
def test_changes_that_shrink_by_one_factor_reach_their_sum(rate):
    change = np.random.default_rng(0).normal(size=(5, 3))
    total = change + extrapolated(1.0, change, rate * change) * rate * change
    np.testing.assert_allclose(total, change / (1.0 - rate))


def test_a_change_is_never_shortened_nor_reaches_too_far():
    change = np.ones((5, 3))
    assert extrapolated(1.0, change, -change) == 1.0
    assert extrapolated(1.0, change, 0.99 * change) == exposure.LONGEST
    assert extrapolated(1.0, change, change) == 1.0


def test_pictures_are_seen_without_their_gain():
    views = toy_clip().views
    gain = np.exp(wandering(len(views)))
    brightened = replace(views, gain=gain)
    some = np.array([4, 1])
    for k, f in enumerate(some):
        plain, steady = views.picture(f), brightened.picture(f)
        for level, expected in zip(steady.levels, plain.levels, strict=True):
            np.testing.assert_allclose(level, expected / gain[f], rtol=1e-6)
        np.testing.assert_array_equal(steady.saturation, plain.saturation)
        np.testing.assert_array_equal(brightened.take(some).picture(k).levels[0], steady.levels[0])


def test_a_chart_is_read_without_its_frames_gain():
    chart = ChartObservation(np.zeros((4, 2)), np.full((24, 3), 0.5), np.ones((24, 3)), np.ones(3), np.ones(3), 0, 0)
    steady = chart.over(np.array([2.0, 1.0, 0.5]))
    np.testing.assert_allclose(steady.values, np.tile([0.25, 0.5, 1.0], (24, 1)))
    np.testing.assert_allclose(steady.white, [0.5, 1.0, 2.0])


def test_people_are_told_and_the_record_says_it():
    record = {"brightness": 0.28, "tint": 0.02, "beside_turn": {"brightness": 0.11, "tint": 0.03}}
    said, = exposure_warnings(Exposure(np.ones((3, 3)), None, record))
    assert re.search("28%.*2%", said)
    assert "Lock" in advice(said)
    assert exposure_warnings(None) == []
    assert field_faults(record, below(SOLVE, "exposure")) == []
    assert field_faults({"gain": np.exp(wandering(FRAMES))}, (GAIN,)) == []
