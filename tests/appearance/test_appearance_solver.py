"""The parts of the appearance fit one by one, on an egg with a nose whose light, albedo and highlights are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_capture import (
    DIRECTIONS,
    MATTE,
    ROUGHNESS,
    SPECULAR,
    linearised,
    make_truth,
    started,
    swinging,
    true_light,
    under_true_light,
)

from shared.appearance.eye_whites import USUAL_ALBEDO
from shared.appearance.fit import FitState, step
from shared.appearance.problem import AppearanceProblem, AppearanceSettings
from shared.appearance.projection import (
    SpecularFit,
    best_albedo,
    changed_roughness,
    measure_highlights,
    project_off_albedo,
)
from shared.appearance.sample_errors import SampleErrors
from shared.geometry.transforms import places_in_world
from shared.imaging.image_sampling import Samples
from shared.rendering.envmap import cube_directions
from shared.rendering.lobes import SpecularTransfer, specular_reflection
from shared.rendering.near_lamp import NearLamp, SeenLamp
from shared.rendering.shading import light_along
from shared.rendering.transfer import nearest_points

GLOSSY = replace(MATTE, specular=True, roughness=ROUGHNESS)


def truly_lit(capture, settings):
    """The problem, its state under the true light and node albedo, and what the forward model gives there."""
    problem, state = under_true_light(capture, settings)
    if not settings.specular:
        state = replace(state, specular=0.0)
    return problem, state, *problem.transport(state).forward(state.light)


def test_errors_of_frames_are_those_of_their_samples(truth):
    """A frame that is off by 0.1 everywhere says so; samples that count less are believed less; clipped ones stay
    silent where the model agrees with them."""
    capture = truth[0]
    errors = AppearanceProblem.of(capture, MATTE).errors
    model = errors.colours.clone()
    model[:, :, 3] += 0.1
    seen = capture.samples.weight.sum(0) > 0
    assert seen.all() and errors.frame_errors(model) == pytest.approx(np.where(np.arange(len(seen)) == 3, 0.1, 0.0))
    half = np.arange(len(capture.points)) % 2 == 0
    model = errors.colours + 0.1 * torch.from_numpy(half.astype(np.float32))[None, :, None]
    share = capture.samples.weight[half].sum(0) / capture.samples.weight.sum(0)
    assert errors.frame_errors(model) == pytest.approx(0.1 * share, rel=1e-4)
    clipped = replace(errors, saturation=torch.ones_like(errors.saturation))
    assert clipped.frame_errors(model).max() == 0.0


def test_samples_that_the_model_cannot_follow_say_less(matte):
    errors = AppearanceProblem.of(matte[0], MATTE).errors
    weight = torch.ones_like(errors.colours)
    error = 2.0 * torch.ones_like(weight)
    doubtful = errors.with_reduced_chi_square(errors.colours + error, weight)
    assert doubtful.evidence(weight) == pytest.approx(errors.evidence(weight) / 4.0, rel=1e-3)
    sure = errors.with_reduced_chi_square(errors.colours + 0.1 * error, weight)
    assert sure.evidence(weight) == pytest.approx(errors.evidence(weight), rel=1e-6)


def test_forward_model_is_the_composition_of_its_modules(truth):
    capture, _, light = truth
    _, _, found, reflection = truly_lit(capture, GLOSSY)
    assert np.allclose(np.moveaxis(found.numpy(), 0, -1), light, rtol=0.01)
    table = SpecularTransfer(capture.points.normals, capture.transfer.visibility(), DIRECTIONS)
    along = light_along(true_light(cube_directions(16)), DIRECTIONS, capture.world_from_head)
    expected = specular_reflection(table, capture.samples.towards_camera[:, 3], ROUGHNESS, along[:, 3])
    open_points = capture.transfer.blocked < 1e-3
    assert np.allclose(reflection[:, :, 3].numpy().T[open_points], expected[open_points], rtol=0.02, atol=1e-3)


@pytest.mark.parametrize("distance", [None, 600.0], ids=["far", "near"])
@pytest.mark.parametrize("bounce", [True, False])
def test_irradiance_of_one_light_is_the_transports(truth, distance, bounce):
    capture = truth[0]
    if distance is not None:
        lamp = NearLamp(distance, tuple(places_in_world(swinging(), "head").mean(0)), (-0.57, 0.48, 0.67), 0.3)
        capture = capture.under_lamp(SeenLamp.of(lamp, swinging(), "head"))
    problem, state, irradiance, _ = truly_lit(capture, replace(MATTE, bounce=bounce))
    np.testing.assert_allclose(problem.irradiance(state), irradiance.numpy(), rtol=2e-4, atol=2e-5)


def test_whites_are_lit_as_the_points_are_and_say_what_they_show(truth):
    """Places on the skin that pass for whites of the usual albedo, once under half of the light's brightness."""
    capture, _, light = truth
    samples = replace(capture.samples, colours=(USUAL_ALBEDO * light).astype(np.float32))
    whites = replace(capture, samples=samples)
    problem, state, _, _ = truly_lit(replace(capture, whites=whites), MATTE)
    np.testing.assert_allclose(problem.said_by_whites(state)[0], 0.0, atol=0.02)
    dim = replace(state, params=state.params - np.log(2.0))
    np.testing.assert_allclose(problem.said_by_whites(dim)[0], np.log(2.0), atol=0.02)
    assert truly_lit(capture, MATTE)[0].said_by_whites(state) is None


@pytest.mark.parametrize("settings", [MATTE, GLOSSY], ids=["matte", "glossy"])
def test_rendering_and_its_adjoint_are_transposes(truth, settings):
    """<render(l), v> = <l, render_adjoint(v)> for any light and any values, and so with the irradiance alone."""
    problem, state, irradiance, _ = truly_lit(truth[0], settings)
    transport, rng = problem.transport(state), np.random.default_rng(3)
    light = rng.uniform(size=state.light.shape)
    values = torch.from_numpy(rng.uniform(size=irradiance.shape).astype(np.float32))
    albedo = torch.from_numpy(rng.uniform(size=(3, irradiance.shape[1], 1)).astype(np.float32))
    rendered = float((transport.render(light, albedo, 0.5) * values).double().sum())
    assert (light * transport.render_adjoint(values, albedo, 0.5)).sum() == pytest.approx(rendered, rel=1e-4)
    lit = float((transport.forward(light)[0] * values).double().sum())
    assert (light * transport.irradiance_adjoint(values)).sum() == pytest.approx(lit, rel=1e-4)


def test_a_step_leaves_its_state_as_it_was(truth):
    """States are values: the same step from the same state twice gives the same, to the last bit."""
    problem, appearance = started(truth[0], GLOSSY)
    state = FitState(appearance, problem.errors)
    before = appearance.params.copy(), appearance.albedo.copy(), problem.errors.precision.clone()
    first, second = (step(problem, state, highlights_count=True)[0] for _ in range(2))
    assert np.array_equal(appearance.params, before[0]) and np.array_equal(appearance.albedo, before[1])
    assert torch.equal(state.errors.precision, before[2]) and state.errors.reduced_chi_square == 1.0
    assert np.array_equal(first.appearance.params, second.appearance.params)
    assert np.array_equal(first.appearance.albedo, second.appearance.albedo)
    assert first.appearance.roughness == second.appearance.roughness != appearance.roughness


@pytest.mark.parametrize("start", [0.1, 0.7])
def test_specular_intensity_stays_in_its_range(start):
    """Highlights far stronger than skin's, while the roughness moves and once it rests: 2 at most, as the maps hold."""
    capture = make_truth(specular=6.0)[0]
    problem, state = under_true_light(capture, replace(GLOSSY, specular_prior=(2.0, 3.0), roughness=start))
    found, _ = step(problem, FitState(state, problem.errors), highlights_count=True)
    assert found.appearance.specular == 2.0


def test_projected_albedo_is_weighted_least_squares(matte):
    """Albedo under the true light by brute force, and the truth itself to the noise."""
    capture, albedo, _ = matte
    problem, _, light, reflection = truly_lit(capture, MATTE)
    weight = problem.errors.weights(None)
    typical = problem.typical_albedo(problem.uniform_start())
    found = best_albedo(problem.errors, light, 0.0 * reflection, weight, typical)[..., 0].numpy().T
    assert np.abs(found / albedo - 1.0).max() < 0.03
    frames = capture.fitted
    for p in range(0, len(albedo), 40):
        for c in range(3):
            root = np.sqrt(weight[c, p, frames].numpy().astype(np.float64))
            design, right = light[c, p, frames].numpy() * root, capture.samples.colours[p, frames, c] * root
            expected = np.linalg.lstsq(design[:, None], right, rcond=None)[0][0]
            assert found[p, c] == pytest.approx(expected, rel=2e-3)


def test_highlights_are_joint_least_squares(truth):
    """The specular intensity with albedo projected out is what one big least-squares problem gives."""
    capture, _, _ = truth
    some = np.arange(0, len(capture.points), 9)
    capture = replace(
        capture,
        points=capture.points.take(some),
        samples=capture.samples.points(some),
        transfer=capture.transfer.take(some),
        skin=capture.skin[some],
    )
    problem, _, light, reflection = truly_lit(capture, GLOSSY)
    weight = problem.errors.weights(None) * problem.errors.fitted
    found = measure_highlights(problem.errors, light, reflection, weight).intensity
    points = len(some)
    for c in range(3):
        rows, columns = np.nonzero(weight[c].numpy() > 0)
        design = np.zeros((len(rows), points + 1))
        design[np.arange(len(rows)), rows] = light[c].numpy()[rows, columns]
        design[:, -1] = reflection[c].numpy()[rows, columns]
        root = np.sqrt(weight[c].numpy()[rows, columns])
        right = capture.samples.colours[rows, columns, c] * root
        expected = np.linalg.lstsq(design * root[:, None], right, rcond=None)[0][-1]
        assert found[c] == pytest.approx(expected, rel=0.01)
    assert np.allclose(found, SPECULAR, rtol=0.1)


def test_a_sample_weighs_what_its_expected_radiance_says():
    """Radiances that scatter by a fifth about a model's: its scale comes out as 1. By the samples' own brightness, what
    is darker than expected would weigh more: 6 % less."""
    model = torch.linspace(0.1, 0.9, 4000).reshape(1, 100, 40).expand(3, -1, -1).contiguous()
    scatter = torch.from_numpy(np.random.default_rng(3).normal(size=model.shape).astype(np.float32))
    colours = np.moveaxis((model * (1.0 + 0.2 * scatter)).numpy(), 0, -1)
    samples = Samples(colours, np.ones((100, 40), np.float32), np.zeros(colours.shape, np.int8), np.zeros((100, 40, 3)))
    errors = SampleErrors.of(samples, np.ones(40, bool), [np.arange(40)], (0.006, 0.03), 5000.0)

    def scale(weight):
        return float((weight * model * errors.colours).sum() / (weight * model * model).sum())

    assert abs(scale(errors.weights(model, glossy=True)) - 1.0) < 0.01
    assert scale(errors.view_weight * errors.precision) < 0.94
    assert scale(errors.weights(model)) < 0.97


def test_clipped_samples_do_not_bias(one_thread):
    """Many red samples end at the clipping level; the light being known, albedo must not suffer."""
    capture, albedo, _ = make_truth(specular=0.0, clip_at=0.45)
    clipped = (capture.samples.saturation[..., 0] > 0) & (capture.samples.weight > 0)
    problem, state, light, reflection = truly_lit(capture, MATTE)
    errors, typical = problem.errors, problem.typical_albedo(problem.uniform_start())
    used = (capture.samples.weight > 0) & capture.fitted
    share = (clipped & used).sum(1) / used.sum(1)
    partly = (share > 0.3) & ((used & ~clipped).sum(1) >= 2)
    assert partly.sum() > 20

    def error(weight):
        found = best_albedo(errors, light, 0.0 * reflection, weight, typical)[0, :, 0].numpy()
        return float(np.median(found[partly] / albedo[partly, 0])) - 1.0

    true_radiance = replace(state, albedo=albedo).radiance(light, reflection)
    assert abs(error(errors.weights(true_radiance))) < 0.005
    assert error(errors.view_weight * errors.precision) < -0.03
    above = light * 0 + 2.0
    assert float(errors.weights(above)[0].numpy()[clipped].max()) == 0.0
    assert float(errors.weights(above * 0)[0].numpy()[clipped].min()) > 0.0


@pytest.mark.parametrize("settings", [MATTE, replace(MATTE, bounce=False), GLOSSY], ids=["matte", "direct", "glossy"])
def test_gradient_is_the_derivative_of_the_cost(truth, settings):
    """Along random directions under a light of too little contrast; what is eliminated is fitted anew at both ends."""
    problem, state = started(truth[0], settings)
    rng = np.random.default_rng(0)
    linear = linearised(problem, replace(state, params=0.6 * np.log(true_light(cube_directions(6)))), settings.specular)
    gradient, params, slopes, expected = linear.gradient(), linear.state.params, [], []
    for _ in range(6):
        change = rng.normal(size=gradient.shape)
        change *= 0.05 / np.linalg.norm(change)
        ahead, behind = (linear.cost(params + sign * change) for sign in (1, -1))
        slopes.append((ahead - behind) / 2.0)
        expected.append((gradient * change).sum())
    assert np.allclose(slopes, expected, atol=0.01 * np.abs(expected).max())


@pytest.mark.parametrize("settings", [MATTE, GLOSSY], ids=["matte", "glossy"])
def test_gauss_newton_product_is_symmetric_and_positive(truth, settings):
    linear = linearised(*started(truth[0], settings), settings.specular)
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 6 * 6**2, 3))
    size = (a * linear.product(a)).sum()
    assert size > 0
    assert (a * linear.product(b)).sum() == pytest.approx((b * linear.product(a)).sum(), abs=3e-3 * size)
    # What only scales the light is absorbed by the albedo, and by the intensity as far as its prior lets it.
    scale, resistance = np.ones((6 * 6**2, 3)), 0.0
    if linear.specular_fit is not None:
        mean, sigma = settings.specular_prior
        resistance = linear.specular_fit.design_effect * (linear.state.specular / (mean * sigma)) ** 2
    assert abs((scale * linear.product(scale)).sum()) < 3e-3 * size + resistance


def test_steps_lower_the_cost_and_keep_the_mean_irradiance(matte):
    linear = linearised(*started(matte[0]))
    problem, transport, model = linear.problem, linear.transport, linear.state.light_model
    _, before, gauge = problem.mean_on_skin(linear.albedo, linear.irradiance, transport)
    assert np.allclose((linear.state.light * gauge).sum(0), 1.0, rtol=1e-3)
    params, cost = linear.improved_light()
    assert cost == linear.cost(linear.state.params) and linear.cost(params) < 0.5 * cost
    lit = transport.forward(model.radiance(params))[0]
    assert np.abs(problem.mean_on_skin(linear.albedo, lit, transport)[1] - before).max() < 0.5


def test_roughness_comes_to_the_truth_under_the_true_light(truth):
    """In a few linearised steps, from either side."""
    for start in (0.3, 0.55):
        settings = replace(MATTE, specular=True, resolutions=(16,), roughness=start)
        problem, state = under_true_light(truth[0], settings)
        state = replace(state, albedo=problem.uniform_start().albedo)
        for _ in range(5):
            linear = linearised(problem, state, highlights_count=True)
            change = linear.specular_fit.change_of_roughness
            state = replace(linear.state, roughness=changed_roughness(state.roughness, change))
        assert state.roughness == pytest.approx(ROUGHNESS, rel=0.03)


def test_intensity_and_roughness_are_joint_least_squares(truth):
    """Moved by what they are off by, and what is left of a change that they can make up for."""
    capture, albedo, _ = truth
    settings = replace(GLOSSY, specular_prior=(0.7, 100.0))
    problem, state, light, reflection = truly_lit(capture, settings)
    transport = problem.transport(state)
    slope = transport.roughness_slope(transport.lobes.slopes(), state.light, light)
    diffuse = torch.from_numpy(albedo.T.astype(np.float32))[..., None] * light
    weight = problem.errors.weights(None) * problem.errors.fitted
    change = 0.1 * reflection - 0.2 * SPECULAR * slope
    errors = replace(problem.errors, colours=diffuse + SPECULAR * reflection + change)
    fit = SpecularFit(settings, state, errors, light, reflection, slope, weight, 1e3)
    assert np.allclose(fit.best, [SPECULAR + 0.1, -0.2], rtol=0.01)
    assert torch.allclose(fit.highlights, SPECULAR * reflection + change, atol=1e-3)
    pure = project_off_albedo(change, light, weight)
    assert float((weight * fit.project_off(pure).square()).sum()) < 1e-3 * float((weight * pure.square()).sum())
    # Known in advance, they stay.
    certain = replace(GLOSSY, specular_prior=(0.7, 1e-6))
    fit = SpecularFit(certain, state, errors, light, reflection, None, weight, 1e3)
    assert fit.best == pytest.approx([0.7], abs=1e-3)


def test_errors_that_a_patch_of_skin_shares_count_once(truth):
    """Noise leaves the samples what they are; a highlight that each patch has otherwise makes them count less, and the
    priors more: the intensity stays closer to skin's."""
    capture, albedo, _ = truth
    problem, state, light, reflection = truly_lit(capture, GLOSSY)
    transport = problem.transport(state)
    slope = transport.roughness_slope(transport.lobes.slopes(), state.light, light)
    diffuse = torch.from_numpy(albedo.T.astype(np.float32))[..., None] * light
    weight = problem.errors.weights(None) * problem.errors.fitted
    rng, patches = np.random.default_rng(0), problem.patches
    assert len(np.unique(patches)) >= 4
    wanted = 1.2

    def fitted(error: np.ndarray) -> SpecularFit:
        colours = diffuse + wanted * reflection + torch.from_numpy(error.astype(np.float32))
        errors = replace(problem.errors, colours=colours)
        fit = SpecularFit(GLOSSY, state, errors, light, reflection, slope, weight, evidence=1.0)
        return fit.weighed_by_patches(errors, light, patches)

    shape = tuple(reflection.shape)
    noisy = fitted(rng.normal(0.0, 1.0, shape) / np.sqrt(problem.errors.precision.numpy()))
    other = rng.choice([-0.8, 0.8], patches.max() + 1)[patches]
    uneven = fitted(other[None, :, None] * reflection.numpy())
    assert noisy.design_effect < 4.0
    assert uneven.design_effect > 5.0 * noisy.design_effect
    towards_prior = [abs(fit.best[0] - GLOSSY.specular_prior[0]) for fit in (noisy, uneven)]
    assert towards_prior[1] < towards_prior[0]


def test_light_between_surfaces_that_send_everything_on_comes_to_an_end(truth):
    """As the albedo of a channel does at its bound, under a light that cannot explain the clip."""
    capture = truth[0]
    count = len(capture.nodes.points)
    closed = replace(capture.node_transfer, bounce=np.full((count, count), 1.0 / count, np.float32))
    problem, state = started(replace(capture, node_transfer=closed), AppearanceSettings(specular=False))
    total = problem.total_transfer(replace(state, node_albedo=np.ones_like(state.node_albedo)))
    assert torch.isfinite(total).all() and (total >= problem.direct).all()


def test_nodes_take_the_albedo_of_points_beside_them(truth):
    capture, _, _ = truth
    problem = AppearanceProblem.of(capture, MATTE)
    assert np.array_equal(problem.node_to_point, nearest_points(capture.nodes.points, capture.points))


def test_points_of_few_samples_follow_the_scale(matte):
    """The pull on them is towards skin of the scale that was found, not of the one before."""
    capture, _, _ = matte
    faint = replace(capture, samples=replace(capture.samples, weight=1e-3 * capture.samples.weight))
    problem, state = started(faint, replace(MATTE, bounce=False))
    linear = linearised(problem, replace(state, params=state.params + np.log(4.0), albedo=state.albedo / 4.0))
    resolved = linear.resolved_scale(linear.state.params)
    assert resolved.rescaled > 1.0
    again = best_albedo(problem.errors, resolved.irradiance, torch.zeros_like(resolved.irradiance), linear.weight,
                        problem.typical_albedo(resolved.state))
    assert float((resolved.albedo / again - 1.0).abs().max()) < 0.1
