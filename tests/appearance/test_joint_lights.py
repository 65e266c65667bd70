"""One head in two lights, solved as one: on a toy capture whose truth is known, and its parts one by one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_capture import DIRECTIONS, FRAMES, linearised, make_truth, started, true_light

from shared.appearance.albedo_scale import resolve_scale, scale_prior
from shared.appearance.fit import fit_appearance
from shared.appearance.light import LightPriors
from shared.appearance.light_models import make_light_model
from shared.appearance.light_step import LinearisedFit
from shared.appearance.light_weights import weigh_samples
from shared.appearance.problem import AppearanceSettings
from shared.appearance.texture import CORRELATED_FRAMES, Noise, NormalEquations, weigh_lights
from shared.geometry.mesh import normalised
from shared.geometry.transforms import rotation_from_vector
from shared.imaging.frame_index import hold_out, spread_frames
from shared.rendering.envmap import cube_directions, frame_lookup
from shared.rendering.shading import light_along

SETTINGS = AppearanceSettings(resolutions=(8,), steps=12, noise=(0.003, 0.01), local_roughness=False)


def hard_lamp(directions):
    """A small lamp at the side in a dark room: half of the face is black."""
    lamp = np.exp(120.0 * (directions @ normalised(np.array([0.95, 0.2, 0.2])) - 1.0))
    return 0.005 + 25.0 * lamp[:, None] * np.array([1.0, 0.95, 0.9])


def frames_of(capture, chosen):
    """The capture with some of its frames, all in one light."""
    samples = capture.samples
    parts = (samples.colours, samples.weight, samples.saturation, samples.towards_camera)
    samples = type(samples)(*(part[:, chosen] for part in parts))
    return replace(capture, samples=samples, world_from_head=capture.world_from_head[chosen],
                   fitted=capture.fitted[chosen], light_index=0 * capture.light_index[chosen])


def albedo_error(capture, albedo, settings=SETTINGS):
    """Median over points of the relative error after the best factor per channel."""
    found = fit_appearance(capture, settings).state.albedo
    ratio = found / albedo
    return float(np.median(np.abs(ratio / np.median(ratio, axis=0) - 1.0)))


@pytest.fixture(scope="module")
def pair(one_thread):
    return make_truth(lights=(hard_lamp, true_light), noise=0.01)


def test_two_lights_together_beat_each_alone(pair):
    capture, albedo, _ = pair
    together = albedo_error(capture, albedo)
    alone = [albedo_error(frames_of(capture, slice(k * FRAMES, (k + 1) * FRAMES)), albedo) for k in range(2)]
    assert together < 0.7 * alone[0]
    assert together < 0.97 * alone[1]


def test_one_light_twice_gives_the_same_as_one_light(one_thread):
    """Two copies of one clip, each with a light of its own: twice the same light, and the albedo up to its scale, of
    which two white lights know more than one."""
    capture, _, _ = make_truth(lights=(true_light, true_light), noise=0.0)
    both, one = (fit_appearance(some, SETTINGS).state for some in (capture, frames_of(capture, slice(FRAMES))))
    first, second = np.split(both.light, 2)
    # Sums run in another order where arrays lie elsewhere in memory; a millionth in the samples makes up to 1 % here.
    assert np.allclose(first, second, rtol=0.03)
    ratio = both.albedo / one.albedo
    assert np.median(np.abs(ratio / np.median(ratio, axis=0) - 1.0)) < 0.01


def test_gradient_is_that_of_the_cost(pair):
    """Finite differences of the cost along random changes of both lights; the albedo is eliminated in both."""
    capture, _, _ = pair
    linear = linearised(*started(capture, replace(SETTINGS, specular=False)))
    gradient, params = linear.gradient(), linear.state.params
    change = np.random.default_rng(0).normal(size=params.shape)
    ahead, behind = (linear.cost(params + h * change) for h in (1e-2, -1e-2))
    assert (gradient * change).sum() == pytest.approx((ahead - behind) / 2e-2, rel=0.05)


@pytest.mark.parametrize("name", ["cubemap", "harmonics_2", "sun_sky"])
def test_lights_of_one_model_are_each_by_itself(name):
    one, two = make_light_model(name, 4), make_light_model(name, 4, 2)
    radiances = np.concatenate([true_light(cube_directions(4)), hard_lamp(cube_directions(4))])
    params = two.fit(radiances)
    own = np.split(params, 2)
    assert np.allclose(two.radiance(params), np.concatenate([one.radiance(part) for part in own]))
    rng = np.random.default_rng(1)
    change, values = rng.normal(size=params.shape), rng.normal(size=radiances.shape)
    product = (two.tangent(params, change) * values).sum()
    assert product == pytest.approx((change * two.adjoint(params, values)).sum())
    cost, gradient, hessian = two.prior(params, LightPriors())
    assert cost == pytest.approx(sum(one.prior(part, LightPriors())[0] for part in own))
    assert np.allclose(gradient, np.concatenate([one.prior(part, LightPriors())[1] for part in own]))
    assert np.allclose(hessian(change)[: len(own[0])], one.prior(own[0], LightPriors())[2](change[: len(own[0])]))
    two = two.with_shares([0.25, 1.0])
    shared = two.prior(params, LightPriors())
    costs = [share * one.prior(part, LightPriors())[0] for share, part in zip(two.shares, own, strict=True)]
    assert shared[0] == pytest.approx(sum(costs))
    assert np.allclose(shared[1][: len(own[0])], 0.25 * gradient[: len(own[0])])
    assert np.allclose(shared[2](change)[len(own[0]) :], hessian(change)[len(own[0]) :])
    factor = np.array([0.3, -0.2, 0.1])
    assert np.allclose(two.radiance(two.scaled(params, factor)), two.radiance(params) * np.exp(factor))
    moved = np.zeros(len(params), bool)
    moved[two.moving_rows] = True
    assert moved.sum() == 2 * (name == "sun_sky") and (name != "sun_sky" or moved[[len(own[0]) - 1, -1]].all())


def test_samples_count_by_how_well_their_light_knows_the_point(pair):
    """Full weight for the light whose errors a point feels least; where the lamp hardly shines the sky decides; and
    weighing twice is no more than weighing once."""
    capture, _, _ = pair
    problem, state = started(capture, replace(SETTINGS, specular=False))
    errors = problem.errors
    for _ in range(8):
        transport = problem.transport(state)
        linear = LinearisedFit.at(problem, state, transport, errors, highlights_count=False)
        resolved = linear.resolved_scale(linear.improved_light()[0])
        state = resolved.state
        model = state.radiance(resolved.irradiance, resolved.reflection)
        along = torch.from_numpy(transport.frame_light.along(state.light))
        errors, weights = weigh_samples(capture, state, errors, along, resolved.irradiance, model)
        state = replace(state, light_model=state.light_model.with_shares(errors.light_shares))
    assert max(weights) == 1.0 and min(weights) > 0.0
    lamp, sky = errors.reliability[..., 0], errors.reliability[..., -1]
    best = torch.maximum(lamp, sky)
    assert best.max() <= 1.0 and best.median() > 0.95, "but for where a shadow ends"
    bright = resolved.irradiance[..., :FRAMES].mean((0, 2))
    dim = bright < bright.quantile(0.3)
    pull = (errors.view_weight * errors.precision * resolved.irradiance.square()).sum(0)
    by_lamp = pull[:, :FRAMES].sum(1) / pull.sum(1)
    assert by_lamp[dim].median() < 0.5 * by_lamp[~dim].median()
    assert torch.allclose(errors.precision, problem.errors.precision * errors.reliability, rtol=1e-4)
    assert errors.light_shares[0] < errors.light_shares[1] <= 1.0


def test_each_frame_sees_its_own_light():
    turns = rotation_from_vector(np.random.default_rng(2).normal(size=(4, 3)))
    lights = [light(cube_directions(4)) for light in (true_light, hard_lamp)]
    index = np.array([0, 0, 1, 1])
    seen = light_along(np.concatenate(lights), DIRECTIONS, turns, index)
    for f, own in enumerate(index):
        assert np.array_equal(seen[:, f], light_along(lights[own], DIRECTIONS, turns[f : f + 1])[:, 0])
    assert frame_lookup(DIRECTIONS, turns, 4, index).shape == (4 * len(DIRECTIONS), 2 * 6 * 16)


def test_frames_are_spread_and_held_out_in_each_light():
    index = np.repeat([0, 1], [40, 10])
    assert spread_frames(50, 5, index).tolist() == [0, 10, 20, 29, 39, 40, 42, 44, 47, 49]
    fitted = hold_out(50, 8, index)
    assert np.nonzero(~fitted)[0].tolist() == [4, 12, 20, 28, 36, 44]


def test_each_light_is_expected_to_be_white_by_itself():
    """A warm and a cold light, as far from white as each other: the albedo is that of the neutral one in between."""
    radiance = np.log([0.2, 0.12, 0.08])
    warm = np.array([[0.3, 0.0, -0.3], [-0.3, 0.0, 0.3]])
    plain, mixed = (resolve_scale(radiance, np.zeros(3), None, (0.7, 0.25), relative_light=relative)[0]
                    for relative in (np.zeros((2, 3)), warm))
    assert np.allclose(plain, mixed, atol=1e-9)
    rows = [len(scale_prior(radiance, relative_light=np.zeros((count, 3)))[0]) for count in (1, 3)]
    assert rows == [5, 9]
    leaning, level = (resolve_scale(radiance, np.zeros(3), None, (0.7, 0.25), relative_light=relative)[0]
                      for relative in (warm[:1], np.zeros((1, 3))))
    assert leaning[2] - leaning[0] > level[2] - level[0] + 0.1


def plate(irradiance, albedo, error, frames=40):
    """Equations of one texel per row: frames of irradiance [T], measured albedo off by the factor 1 + error [T]."""
    equations = NormalEquations(len(irradiance), Noise())
    colours = albedo * (1.0 + error) * irradiance
    weight = frames * Noise().precision(colours)
    for k, value in enumerate((irradiance**2, 0, irradiance * colours, 0, 0, irradiance**2)):
        equations.sums[:, 3 * k : 3 * k + 3] = (weight * value)[:, None]
    return equations


def test_the_light_whose_error_is_smaller_decides():
    """A texel that one light grazes, and is wrong there by half, takes the other light's albedo."""
    irradiance = np.array([0.5, 0.5, 0.02]), np.array([0.5, 0.05, 0.5])
    error = np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.5, 0.0])
    systematic = [np.repeat(np.array(values)[:, None], 3, 1) for values in ([1e-3, 1e-3, 0.3], [1e-3, 0.3, 1e-3])]
    parts = [plate(light, 0.4, wrong) for light, wrong in zip(irradiance, error, strict=True)]
    evidence = weigh_lights(parts, systematic, np.full(3, 0.4))
    found = evidence.equations.solve_albedo(np.zeros(3), np.zeros((3, 3)), 1e-6)
    assert np.abs(found / 0.4 - 1.0).max() < 0.01
    naive = (parts[0].ei + parts[1].ei) / (parts[0].ee + parts[1].ee)
    assert np.abs(found[1] - 0.4).max() < 0.3 * np.abs(naive[1] - 0.4).min()
    each = [own.information(np.full(3, 0.4), wrong) for own, wrong in zip(parts, systematic, strict=True)]
    assert np.allclose(evidence.information, each[0] + each[1])
    assert (evidence.information[0] > 1.9 * each[0][0]).all()
    assert evidence.drawing[0][0, 0] == pytest.approx(5e-4, rel=0.01)
    assert evidence.drawing[0][1, 0] < 1.1e-3


def test_one_light_alone_is_weighed_as_ever():
    equations = plate(np.array([0.5]), 0.4, np.array([0.1]))
    evidence = weigh_lights([equations], [np.full((1, 3), 0.2)], np.full(3, 0.4))
    assert evidence.equations is equations
    assert evidence.information[0, 0] == pytest.approx(1.0 / (0.2 + CORRELATED_FRAMES / (equations.ee[0, 0] * 0.16)))
