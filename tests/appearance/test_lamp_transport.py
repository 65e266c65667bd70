"""The operators of the appearance fit under a lamp that stands near."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_capture import FRAMES, MATTE, make_truth, small_lamp, swinging, under_true_light

from shared.appearance.problem import AppearanceProblem
from shared.geometry.mesh import normalised
from shared.geometry.transforms import places_in_world
from shared.rendering.near_lamp import FAR, NearLamp, SeenLamp

AXIS = tuple(normalised(np.array([-0.6, 0.5, 0.7])))


def near(distance, radius=0.3):
    poses = swinging()
    centre = places_in_world(poses, "head").mean(0)
    return SeenLamp.of(NearLamp(distance, tuple(centre), AXIS, radius), poses, "head")


@pytest.fixture(scope="module")
def truth():
    return make_truth(lights=(small_lamp,))[0]


@pytest.mark.parametrize("settings", [MATTE, replace(MATTE, specular=True)], ids=["matte", "glossy"])
def test_operators_and_their_adjoints_are_transposes(truth, settings):
    problem = AppearanceProblem.of(replace(truth, lamp=near(500.0)), settings)
    _, state = under_true_light(truth, settings)
    transport, rng = problem.transport(state), np.random.default_rng(3)
    light, shape = rng.uniform(size=state.light.shape), (3, len(truth.points), FRAMES)
    values = torch.from_numpy(rng.uniform(size=shape).astype(np.float32))
    albedo = torch.from_numpy(rng.uniform(size=(3, shape[1], 1)).astype(np.float32))
    rendered = float((transport.render(light, albedo, 0.5) * values).double().sum())
    assert (light * transport.render_adjoint(values, albedo, 0.5)).sum() == pytest.approx(rendered, rel=1e-4)
    irradiance, _ = transport.forward(light)
    lit = float((irradiance * values).double().sum())
    assert (light * transport.irradiance_adjoint(values)).sum() == pytest.approx(lit, rel=1e-4)
    rows = transport.rows(2, np.arange(5), albedo, 0.5, 1)
    assert np.allclose(rows @ light[:, 1], transport.render(light, albedo, 0.5)[1, :5, 2].numpy(), rtol=1e-4)
    if settings.specular:
        slopes = transport.lobes.slopes()
        slope = transport.roughness_slope(slopes, light, irradiance)
        narrower, wider = (replace(transport, lobes=problem.lobes_at(state.roughness * 1.05**side)).forward(light)[1]
                           for side in (-1, 1))
        change = ((wider - narrower) / (2.0 * np.log(1.05))).numpy()
        assert np.abs(slope.numpy() - change).mean() < 0.02 * np.abs(change).mean()
        both = transport.render_adjoint_with_slopes(values, albedo, 0.5, slopes, 0.2)
        lamp = transport.lamp.reflection(transport.lamp_slopes, light)
        alone = both - replace(transport, lamp=None).render_adjoint_with_slopes(values, albedo, 0.5, slopes, 0.2)
        expected = albedo * transport.lamp.irradiance(light) + 0.2 * lamp
        expected = expected + 0.5 * transport.lamp.reflection(transport.lamp_lobes, light)
        assert (light * alone).sum() == pytest.approx(float((expected * values).double().sum()), rel=1e-4)


def test_a_lamp_far_away_is_the_far_light(truth):
    """To what the directions resolve of it: the two sum the same light in another way."""
    _, state = under_true_light(truth, MATTE)
    far, plain = (AppearanceProblem.of(replace(truth, lamp=lamp), MATTE).transport(state).forward(state.light)[0]
                  for lamp in (near(FAR, 0.6), None))
    assert np.abs(far / plain - 1.0).mean() < 0.02
