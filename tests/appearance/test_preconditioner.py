"""The light step's preconditioner: the Hessian of all points exactly, that of some nearly, fewer iterations."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sparse
import torch
from toy_capture import MATTE, hard_light, linearised, make_truth, started, true_light, under_true_light

from shared.appearance import light_step
from shared.appearance.light_models import make_light_model
from shared.appearance.preconditioner import LightPreconditioner, curvature_of_some
from shared.rendering.envmap import cube_directions

PLAIN = replace(MATTE, skin=None)
SHINY = replace(PLAIN, specular=True)


@pytest.fixture(scope="module")
def capture():
    return make_truth()[0]


@pytest.mark.parametrize("settings", [PLAIN, SHINY], ids=["matte", "glossy"])
def test_rows_are_the_derivative_of_a_rendering(capture, settings):
    problem, state = under_true_light(capture, replace(settings, resolutions=(16,)))
    transport, rng = problem.transport(state), np.random.default_rng(1)
    albedo = torch.from_numpy(state.albedo.T.astype(np.float32))[..., None]
    light, points = rng.uniform(size=state.light.shape), np.array([0, 7, 31])
    rendered = transport.render(light, albedo, 0.6)
    for frame, channel in ((0, 0), (5, 2)):
        rows = transport.rows(frame, points, albedo, 0.6, channel)
        assert np.allclose(rows @ light[:, channel], rendered[channel, points, frame].numpy(), rtol=1e-4)


@pytest.mark.parametrize(
    ("settings", "lights"),
    [(PLAIN, (true_light,)), (SHINY, (true_light,)), (PLAIN, (true_light, hard_light))],
    ids=["matte", "glossy", "two lights"],
)
def test_of_all_points_it_is_the_hessian_itself(settings, lights):
    """A change of one channel: nothing that couples the channels plays a part in its own image."""
    capture = make_truth(lights=lights)[0]
    linear = linearised(*started(capture, settings))
    state = linear.state
    assert len(state.params) == len(lights) * 6 * 6**2
    curvature = curvature_of_some(linear.transport, linear.albedo, state.specular, linear.irradiance,
                                  linear.evidence * linear.weight, count=len(capture.points))
    prior = state.light_model.prior_curvature(state.params, settings.priors)
    rng = np.random.default_rng(2)
    for c in range(3):
        change = np.zeros_like(state.params)
        change[:, c] = rng.normal(size=len(change))
        image = state.light[:, c] * (curvature[c] @ (state.light[:, c] * change[:, c])) + prior[c] @ change[:, c]
        assert np.allclose(image, linear.product(change)[:, c], rtol=1e-3, atol=1e-3 * np.abs(image).max())


def test_it_solves_with_the_matrix_of_each_channel():
    rng = np.random.default_rng(3)
    half, light, change = rng.normal(size=(3, 20, 20)), rng.uniform(0.5, 2.0, size=(20, 3)), rng.normal(size=(20, 3))
    curvature, prior = half @ half.transpose(0, 2, 1), [sparse.diags(rng.uniform(0.1, 1.0, 20)).tocsr() for _ in "rgb"]
    image = [light[:, c] * (curvature[c] @ (light[:, c] * change[:, c])) + prior[c] @ change[:, c] for c in range(3)]
    assert np.allclose(LightPreconditioner(curvature, light, prior)(np.stack(image, axis=1)), change)


@pytest.mark.parametrize("name", ["harmonics_2", "sun_sky", "camera"])
def test_parameters_that_are_no_texels_have_none(name):
    model = make_light_model(name, 6)
    params = model.fit(true_light(cube_directions(6)))
    assert model.prior_curvature(params, PLAIN.priors) is None


def test_a_step_needs_a_third_of_the_products(monkeypatch):
    """Of a hard lamp's light, to the same residual; and the light that it comes to is as good."""
    capture = make_truth(lights=(hard_light,))[0]
    linear = linearised(*started(capture, replace(SHINY, precision=(200, 1e-4))))
    product, counts, costs = light_step.LinearisedFit.product, [], []
    for most_texels in (light_step.MOST_TEXELS, 0):
        calls = []
        monkeypatch.setattr(light_step.LinearisedFit, "product",
                            lambda self, change, calls=calls: calls.append(1) or product(self, change))
        monkeypatch.setattr(light_step, "MOST_TEXELS", most_texels)
        params, before = linear.improved_light()
        counts.append(len(calls))
        costs.append(linear.cost(params))
    assert 3 * counts[0] < counts[1]
    assert costs[0] < before and costs[0] == pytest.approx(costs[1], rel=0.01)
