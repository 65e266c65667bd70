"""A grey place and the priors on the light's colour: its tint counts in place of white, and its level not at all."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from field_check import below, field_faults
from toy_capture import MATTE, make_truth

from shared.appearance.albedo_scale import WHITE_SIGMA, most_likely_irradiance, resolve_scale
from shared.appearance.chart_scale import describe_scale
from shared.appearance.diagnostics import unlikely_colour
from shared.appearance.fit import fit_appearance
from shared.appearance.light_tint import GREY_SIGMA, LightTint
from shared.appearance.measured_skin import TYPICAL_SKIN
from shared.appearance.problem import AppearanceProblem
from shared.contract.records import SOLVE
from shared.inverse.clip_inputs import ClipInputs

PRIOR = (0.7, 0.35)
SKIN = np.log(TYPICAL_SKIN)
TINT = np.array([0.45, 0.0, -0.5])
SURE = LightTint((0.45, -0.5), (GREY_SIGMA, GREY_SIGMA))


def ratios(log_colour):
    return log_colour[..., [0, 2]] - log_colour[..., [1]]


def test_the_place_is_a_tint_as_sure_as_frames_and_grey_things_are():
    record = {"place": [9, 6], "colour": [0.3, 0.2, 0.1], "log_sigma": [0.0, 0.12], "frames": [0, 1, 2]}
    (tint,) = ClipInputs(None, None, SimpleNamespace(grey=record), None).light_tints()
    assert tint.log_ratios == pytest.approx((np.log(1.5), np.log(0.5)))
    assert tint.sigma == pytest.approx((0.05, 0.13))
    assert ClipInputs(None, None, SimpleNamespace(grey=None), None).light_tints() == ()


def test_the_resolved_light_has_the_place_s_tint_and_skin_its_own():
    """Skin in reddish light, taken for redder skin in white light before."""
    white = resolve_scale(SKIN + TINT, np.zeros(3), None, PRIOR)
    named = resolve_scale(SKIN + TINT, np.zeros(3), None, PRIOR, tints=(SURE,))
    assert np.abs(ratios(white.log_factor) - SURE.log_ratios).max() > 0.2
    assert np.abs(ratios(named.log_factor) - SURE.log_ratios).max() < 0.05
    before, after = (scale.describe(np.exp(SKIN))["log_sigma"] for scale in (white, named))
    for ratio in ("red_over_green", "blue_over_green"):
        assert after[ratio] < GREY_SIGMA + 1e-4 and after[ratio] < 0.6 * before[ratio]
    np.testing.assert_array_equal(named.prior_covariance, white.prior_covariance)


def test_a_surer_place_decides_more():
    moved = [ratios(resolve_scale(SKIN, np.zeros(3), None, PRIOR, tints=(LightTint((0.4, 0.4), (s, s)),)).log_factor)
             for s in (0.5, 0.15, 0.05, 0.01)]
    assert (np.diff(moved, axis=0) > 0.0).all() and np.abs(moved[-1] - 0.4).max() < 0.02


def test_without_a_place_light_is_white_as_before():
    log_light = np.array([0.2, -0.1, 0.3])
    relative = np.array([[0.1, 0.0, 0.2], [-0.1, 0.1, -0.2]])
    white = LightTint((0.0, 0.0), (WHITE_SIGMA, WHITE_SIGMA))
    for lights in (None, relative):
        found = [resolve_scale(SKIN, log_light, None, PRIOR, relative_light=lights, tints=tints)
                 for tints in ((), (None,) * (1 if lights is None else 2), (white,) * (1 if lights is None else 2))]
        for other in found[1:]:
            np.testing.assert_array_equal(other.log_factor, found[0].log_factor)
            np.testing.assert_array_equal(other.covariance, found[0].covariance)


def test_the_place_s_level_and_the_exposure_do_not_enter():
    dim, bright = (most_likely_irradiance(SKIN + TINT + level, tints=(SURE,)) for level in (0.0, 0.7))
    np.testing.assert_allclose(bright - dim, 0.7)


def test_each_light_has_the_tint_of_its_own_place():
    """Two lights a known tint apart: the place in one of them tells both."""
    relative = np.stack([TINT, -TINT]) / 2
    far = LightTint(tuple(ratios(TINT)), (0.01, 0.01))
    for tints in ((far, None), (None, replace(far, log_ratios=(0.0, 0.0))), (far, replace(far, log_ratios=(0.0, 0.0)))):
        found = resolve_scale(SKIN + TINT / 2, np.zeros(3), None, PRIOR, relative_light=relative, tints=tints)
        assert np.abs(ratios(found.log_factor + relative[0]) - ratios(TINT)).max() < 0.01
    with pytest.raises(ValueError):
        resolve_scale(SKIN, np.zeros(3), None, PRIOR, relative_light=relative, tints=(far,))


def test_coloured_light_is_not_unlikely_where_a_place_shows_it():
    coloured = np.exp(SKIN + 2 * TINT)
    named = LightTint(tuple(ratios(2 * TINT)), (GREY_SIGMA, GREY_SIGMA))
    assert unlikely_colour(coloured, WHITE_SIGMA) > 3.0
    assert unlikely_colour(coloured, WHITE_SIGMA, tints=(named,)) < 1.0


@pytest.fixture(scope="module")
def capture(one_thread):
    return make_truth(specular=0.0)[0]


def test_a_solved_light_starts_and_ends_with_the_place_s_tint(capture):
    tint = LightTint((0.3, -0.3), (0.01, 0.01))
    settings = replace(MATTE, tints=(tint,))
    problem = AppearanceProblem.of(capture, settings)
    start = problem.uniform_start()
    np.testing.assert_allclose(ratios(np.log(start.light[0])), tint.log_ratios, atol=0.02)
    named, white = (
        ratios(np.log(problem.irradiance(fit_appearance(capture, some).state)[:, capture.skin].mean((1, 2))))
        for some in (settings, MATTE)
    )
    assert np.abs(named - tint.log_ratios).max() < 0.05 < 0.1 < np.abs(white - tint.log_ratios).min()


@pytest.mark.parametrize("tints, lights, words", [
    ((SURE,), [0], "a light of the tint that a grey place"),
    ((None, SURE), [1], "white on average where none is named"),
    ((), [], "a light that is white on average")])
def test_what_is_recorded(tints, lights, words):
    described = describe_scale(None, np.exp(SKIN), tints=tints)
    assert field_faults(described, below(SOLVE, "albedo_scale")) == []
    assert words in described["method"] and [entry["light"] for entry in described.get("grey", ())] == lights
    for entry in described.get("grey", ()):
        assert entry["log_ratios"] == [0.45, -0.5] and entry["log_sigma"] == [0.05, 0.05]
