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
    make_truth,
    solver_of,
    true_albedo,
    true_light,
)

from shared.appearance.light_step import LightStep
from shared.appearance.solver import AppearanceSettings, AppearanceSolver
from shared.appearance.specular_fit import SpecularFit
from shared.rendering.envmap import cube_directions
from shared.rendering.lobes import SpecularTransfer, specular_reflection
from shared.rendering.shading import light_along
from shared.rendering.transfer import nearest_points

GLOSSY = replace(MATTE, specular=True, roughness=ROUGHNESS)


def truly_lit(solver, capture):
    """What the solver's forward model gives under the true light and the true node albedo."""
    solver.set_light(("cubemap", 16))
    solver.state.node_albedo = true_albedo(capture.nodes.points.positions)
    solver.bake()
    return solver.forward(true_light(cube_directions(16)))


def test_errors_of_frames_are_those_of_their_samples(truth):
    """A frame that is off by 0.1 everywhere says so; samples that count less are believed less; clipped ones stay
    silent where the model agrees with them."""
    capture = truth[0]
    solver = solver_of(capture)
    model = solver.colours.clone()
    model[:, :, 3] += 0.1
    seen = capture.samples.weight.sum(0) > 0
    assert seen.all() and solver.frame_errors(model) == pytest.approx(np.where(np.arange(len(seen)) == 3, 0.1, 0.0))
    half = np.arange(len(capture.points)) % 2 == 0
    model = solver.colours + 0.1 * torch.from_numpy(half.astype(np.float32))[None, :, None]
    share = capture.samples.weight[half].sum(0) / capture.samples.weight.sum(0)
    assert solver.frame_errors(model) == pytest.approx(0.1 * share, rel=1e-4)
    solver.saturation[:] = 1
    assert solver.frame_errors(model).max() == 0.0


def test_samples_that_the_model_cannot_follow_say_less(matte):
    solver = solver_of(matte[0])
    weight = torch.ones_like(solver.colours)
    fitting = solver.evidence(weight)
    error = 2.0 * torch.ones_like(weight)
    solver.measure_reduced_chi_square(solver.colours + error, weight)
    assert solver.evidence(weight) == pytest.approx(fitting / 4.0, rel=1e-3)
    solver.measure_reduced_chi_square(solver.colours + 0.1 * error, weight)
    assert solver.evidence(weight) == pytest.approx(fitting, rel=1e-6)


def test_forward_model_is_the_composition_of_its_modules(truth):
    capture, _, light = truth
    solver = AppearanceSolver(capture, GLOSSY)
    solver.state.specular = SPECULAR
    solver.bake_lobes()
    found, reflection = truly_lit(solver, capture)
    assert np.allclose(np.moveaxis(found.numpy(), 0, -1), light, rtol=0.01)
    table = SpecularTransfer(capture.points.normals, capture.transfer.visibility(), DIRECTIONS)
    along = light_along(true_light(cube_directions(16)), DIRECTIONS, capture.world_from_head)
    expected = specular_reflection(table, capture.samples.towards_camera[:, 3], ROUGHNESS, along[:, 3])
    open_points = capture.transfer.blocked < 1e-3
    assert np.allclose(reflection[:, :, 3].numpy().T[open_points], expected[open_points], rtol=0.02, atol=1e-3)


def test_projected_albedo_is_weighted_least_squares(matte):
    """Albedo under the true light by brute force, and the truth itself to the noise."""
    capture, albedo, _ = matte
    solver = AppearanceSolver(capture, MATTE)
    light, reflection = truly_lit(solver, capture)
    weight = solver.weights(None)
    found = solver.best_albedo(light, 0.0 * reflection, weight)[..., 0].numpy().T
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
    solver = AppearanceSolver(capture, GLOSSY)
    solver.bake_lobes()
    light, reflection = truly_lit(solver, capture)
    weight = solver.weights(None) * solver.fitted
    found = solver.highlights(light, reflection, weight).intensity
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


def test_clipped_samples_do_not_bias(one_thread):
    """Many red samples end at the clipping level; the light being known, albedo must not suffer."""
    capture, albedo, _ = make_truth(specular=0.0, clip_at=0.45)
    clipped = (capture.samples.saturation[..., 0] > 0) & (capture.samples.weight > 0)
    solver = AppearanceSolver(capture, MATTE)
    light, reflection = truly_lit(solver, capture)
    used = (capture.samples.weight > 0) & capture.fitted
    share = (clipped & used).sum(1) / used.sum(1)
    partly = (share > 0.3) & ((used & ~clipped).sum(1) >= 2)
    assert partly.sum() > 20

    def error(weight):
        found = solver.best_albedo(light, 0.0 * reflection, weight)[0, :, 0].numpy()
        return float(np.median(found[partly] / albedo[partly, 0])) - 1.0

    solver.state.albedo = albedo
    assert abs(error(solver.weights(solver.model(light, reflection)))) < 0.005
    assert error(solver.trust * solver.precision) < -0.03
    above = light * 0 + 2.0
    assert float(solver.weights(above)[0].numpy()[clipped].max()) == 0.0
    assert float(solver.weights(above * 0)[0].numpy()[clipped].min()) > 0.0


@pytest.mark.parametrize("settings", [MATTE, replace(MATTE, bounce=False), GLOSSY], ids=["matte", "direct", "glossy"])
def test_gradient_is_the_derivative_of_the_cost(truth, settings):
    """Along random directions under a light of too little contrast; what is eliminated is fitted anew at both ends."""
    solver = solver_of(truth[0], settings)
    solver.trust_highlights = settings.specular
    rng = np.random.default_rng(0)
    solver.state.params = 0.6 * np.log(true_light(cube_directions(6)))
    step = LightStep(solver)
    gradient, slopes, expected = step.gradient(), [], []
    for _ in range(6):
        change = rng.normal(size=gradient.shape)
        change *= 0.05 / np.linalg.norm(change)
        ahead, behind = (step.cost(solver.state.params + sign * change) for sign in (1, -1))
        slopes.append((ahead - behind) / 2.0)
        expected.append((gradient * change).sum())
    assert np.allclose(slopes, expected, atol=0.01 * np.abs(expected).max())


@pytest.mark.parametrize("settings", [MATTE, GLOSSY], ids=["matte", "glossy"])
def test_gauss_newton_product_is_symmetric_and_positive(truth, settings):
    solver = solver_of(truth[0], settings)
    solver.trust_highlights = settings.specular
    step = LightStep(solver)
    step.gradient()
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 6 * 6**2, 3))
    size = (a * step.product(a)).sum()
    assert size > 0
    assert (a * step.product(b)).sum() == pytest.approx((b * step.product(a)).sum(), abs=3e-3 * size)
    # What only scales the light is absorbed by the albedo.
    scale = np.ones((6 * 6**2, 3))
    assert abs((scale * step.product(scale)).sum()) < 3e-3 * size


def test_steps_lower_the_cost_and_keep_the_mean_irradiance(matte):
    capture, _, _ = matte
    solver = solver_of(capture)
    step = LightStep(solver)
    _, before, gauge = solver.mean_on_skin(step.albedo, step.irradiance)
    assert np.allclose((solver.state.light * gauge).sum(0), 1.0, rtol=1e-3)
    step.update()
    assert step.cost(solver.state.params) < 0.5 * step.before
    _, after, _ = solver.mean_on_skin(step.albedo, solver.forward(solver.state.light)[0])
    assert np.abs(after - before).max() < 0.5


def test_roughness_comes_to_the_truth_under_the_true_light(truth):
    """In a few linearised steps, from either side."""
    capture, _, _ = truth
    for start in (0.3, 0.55):
        solver = AppearanceSolver(capture, replace(MATTE, specular=True, resolutions=(16,), roughness=start))
        solver.trust_highlights = True
        solver.state.params, solver.state.specular = np.log(true_light(cube_directions(16))), SPECULAR
        solver.state.node_albedo = true_albedo(capture.nodes.points.positions)
        solver.bake()
        solver.bake_lobes()
        for _ in range(5):
            solver.update_roughness(LightStep(solver).specular_fit.change_of_roughness)
        assert solver.state.roughness == pytest.approx(ROUGHNESS, rel=0.03)


def test_intensity_and_roughness_are_joint_least_squares(truth):
    """Moved by what they are off by, and what is left of a change that they can make up for."""
    capture, albedo, _ = truth
    solver = AppearanceSolver(capture, replace(GLOSSY, specular_prior=(0.7, 100.0)))
    solver.state.specular = SPECULAR
    solver.bake_lobes()
    solver.bake_slopes()
    light, reflection = truly_lit(solver, capture)
    slope = solver.forward_slope(true_light(cube_directions(16)), light)
    diffuse = torch.from_numpy(albedo.T.astype(np.float32))[..., None] * light
    weight = solver.weights(None) * solver.fitted
    change = 0.1 * reflection - 0.2 * SPECULAR * slope
    solver.colours = diffuse + SPECULAR * reflection + change
    fit = SpecularFit(solver, light, reflection, slope, weight, 1e3)
    assert np.allclose(fit.best, [SPECULAR + 0.1, -0.2], rtol=0.01)
    assert torch.allclose(fit.highlights, SPECULAR * reflection + change, atol=1e-3)
    pure = solver.project_off_albedo(change, light, weight)
    assert float((weight * fit.off(pure).square()).sum()) < 1e-3 * float((weight * pure.square()).sum())
    # Known in advance, they stay.
    certain = replace(GLOSSY, specular_prior=(0.7, 1e-6))
    solver.settings = certain
    assert SpecularFit(solver, light, reflection, None, weight, 1e3).best == pytest.approx([0.7], abs=1e-3)


def test_light_between_surfaces_that_send_everything_on_comes_to_an_end(truth):
    """As the albedo of a channel does at its bound, under a light that cannot explain the clip."""
    capture = truth[0]
    count = len(capture.nodes.points)
    closed = replace(capture.node_transfer, bounce=np.full((count, count), 1.0 / count, np.float32))
    solver = AppearanceSolver(replace(capture, node_transfer=closed), AppearanceSettings(specular=False))
    solver.state.node_albedo[:] = 1.0
    solver.bake()
    assert torch.isfinite(solver.baked).all() and (solver.baked >= solver.direct).all()


def test_nodes_take_the_albedo_of_points_beside_them(truth):
    capture, _, _ = truth
    solver = AppearanceSolver(capture, MATTE)
    assert np.array_equal(solver.node_to_point, nearest_points(capture.nodes.points, capture.points))


def test_points_of_few_samples_follow_the_scale(matte):
    """The pull on them is towards skin of the scale that was found, not of the one before."""
    capture, _, _ = matte
    faint = replace(capture, samples=replace(capture.samples, weight=1e-3 * capture.samples.weight))
    solver = AppearanceSolver(faint, replace(MATTE, bounce=False))
    solver.bake()
    solver.state.params += np.log(4.0)
    solver.state.albedo /= 4.0
    step = LightStep(solver)
    assert step.resolve_scale() > 1.0
    again = solver.best_albedo(step.irradiance, torch.zeros_like(step.irradiance), step.weight)
    assert float((step.albedo / again - 1.0).abs().max()) < 0.1
