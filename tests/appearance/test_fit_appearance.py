"""The appearance fit on an egg with a nose whose light, albedo and highlights are known."""

from dataclasses import replace

import numpy as np
import pytest
from field_check import below, field_faults
from toy_capture import (
    DIRECTIONS,
    MATTE,
    NOISE,
    ROUGHNESS,
    SPECULAR,
    coloured_light,
    hard_light,
    make_truth,
    small_lamp,
    true_light,
)

from shared.appearance.albedo_scale import ResolvedScale
from shared.appearance.fit import at_mean_scale, fit_all_points, fit_appearance, fit_sharper_light
from shared.appearance.measured_skin import SURFACE_SPREAD
from shared.appearance.problem import AppearanceSettings
from shared.appearance.projection import ROUGHNESS_RANGE, changed_roughness, reached_end
from shared.contract.records import SOLVE
from shared.geometry.mesh import normalised
from shared.geometry.transforms import fibonacci_sphere
from shared.rendering.envmap import cube_directions
from shared.rendering.shading import light_along


def scale_free_error(found, true):
    """Relative error [N, 3] after the best factor per channel."""
    ratio = found / true
    return ratio / np.median(ratio, axis=0) - 1.0


def after_shaping(solution):
    """The records of the steps that highlights may take part in."""
    return [record for record in solution.iterations if not record["shaping"]]


@pytest.fixture(scope="module")
def solution(truth):
    capture, _, _ = truth
    settings = AppearanceSettings(resolutions=(8,), steps=12, noise=(0.003, 0.01), roughness=0.45)
    return fit_appearance(capture, settings)


def test_albedo_is_recovered_up_to_scale(truth, solution):
    _, albedo, _ = truth
    error = np.abs(scale_free_error(solution.state.albedo, albedo))
    assert np.median(error) < 0.03
    assert np.quantile(error, 0.95) < 0.12
    # The priors know skin and white light: the factor itself is right to the width of theirs.
    factor = np.median(solution.state.albedo / albedo, axis=0)
    assert np.abs(np.log(factor)).max() < 0.5
    assert np.ptp(np.log(factor)) < 0.2


def test_light_is_recovered_at_low_frequency(truth, solution):
    """Irradiance of an unoccluded ball under the found and the true light, over directions that lit the face."""
    light = solution.state.light
    resolution = round((len(light) / 6) ** 0.5)
    normals = fibonacci_sphere(200)
    normals = normals[normals[:, 2] > 0.0]
    cosine = np.maximum(normals @ DIRECTIONS.T, 0.0)
    found = cosine @ light_along(light, DIRECTIONS, np.eye(3)[None])[:, 0]
    true = cosine @ true_light(DIRECTIONS)
    assert light_along(light, DIRECTIONS, np.eye(3)[None]).min() > 0 and resolution == 8
    assert np.sqrt((scale_free_error(found, true) ** 2).mean()) < 0.1
    brightest = normalised((light * np.ones((1, 3))).sum(1) @ cube_directions(resolution))
    expected = normalised(true_light(DIRECTIONS).sum(1) @ DIRECTIONS)
    assert brightest @ expected > np.cos(np.radians(20))


def test_residuals_come_down_to_the_noise(solution):
    assert solution.fitted < 3.0 * NOISE
    assert solution.held_out < 4.0 * NOISE
    assert 0.2 < solution.state.specular < 1.6
    assert 0.25 <= solution.state.roughness <= 0.7


def test_the_last_of_the_best_held_out_states_wins(truth):
    """Where the prior on skin has nothing against it, and the scale did not wait for the roughness, whose start lies
    off enough for a state that waits to fit best."""
    settings = AppearanceSettings(resolutions=(8,), steps=12, noise=(0.003, 0.01), roughness=0.5)
    solution = fit_appearance(truth[0], settings)
    count = AppearanceSettings().independent * (~truth[0].fitted).mean()
    records = after_shaping(solution)
    judged = np.array([record["held_out"] * np.sqrt(1.0 + 2.0 * record["skin_prior"] / count) for record in records])
    change = np.diff(np.log([record["roughness"] for record in solution.iterations]))[-len(records):]
    waiting = np.abs(change) > 0.03
    assert waiting.any() and judged[waiting].min() < judged[~waiting].min(), "without the rule one of them would win"
    judged[waiting] = np.inf
    last = int(np.nonzero(judged <= 1.003 * judged.min())[0][-1])
    assert solution.held_out == records[last]["held_out"]
    assert solution.iterations[0]["held_out"] > 2.0 * solution.held_out


def test_the_fit_goes_on_until_the_scale_rests(truth):
    """Highlights tell the scale, step by step, while the residual stays."""
    settings = AppearanceSettings(resolutions=(8,), steps=20, noise=(0.003, 0.01), roughness=0.45)
    found = fit_appearance(truth[0], settings)
    assert found.highlights_count and len(after_shaping(found)) > 2 and len(found.iterations) < 20
    assert found.iterations[-1]["rescaled"] < 0.01


def test_the_mean_scale_keeps_what_skin_sends_out(solution):
    beyond = np.array([0.2, 0.1, -0.3, -0.15])
    scale = ResolvedScale(np.zeros(3), 0.7, 0.04 * np.eye(3), np.eye(3), beyond)
    moved = at_mean_scale(replace(solution, scale=scale)).state
    np.testing.assert_allclose(moved.light, solution.state.light * np.exp(beyond[:3]), rtol=1e-6)
    np.testing.assert_allclose(moved.albedo, solution.state.albedo * np.exp(-beyond[:3]), rtol=1e-6)
    np.testing.assert_allclose(moved.node_albedo, solution.state.node_albedo * np.exp(-beyond[:3]), rtol=1e-6)
    assert moved.specular == pytest.approx(solution.state.specular * np.exp(-0.15))
    assert at_mean_scale(replace(solution, scale=None)).state is solution.state


def test_the_fit_stops_where_held_out_frames_stop_improving(matte):
    """Held-out frames that show nothing but noise cannot improve: two steps after the shaping ones, then the end."""
    capture, _, _ = matte
    colours = capture.samples.colours.copy()
    noise = np.random.default_rng(1).uniform(0, 1, colours.shape)
    colours[:, ~capture.fitted] = noise[:, ~capture.fitted]
    spoiled = replace(capture, samples=replace(capture.samples, colours=colours))
    found = fit_appearance(spoiled, replace(MATTE, steps=12, resolutions=(4,)))
    assert len(found.iterations) < 10
    assert found.held_out > 0.1 > found.fitted


def test_highlights_wait_until_the_light_has_found_its_lamp():
    """A small lamp in the dark: with highlights from the fourth step on, the scale ends at half of what it is."""
    capture, albedo, _ = make_truth(lights=(small_lamp,))
    found = fit_appearance(capture, AppearanceSettings(resolutions=(8,), steps=12, noise=(0.003, 0.01), roughness=0.45))
    shaping = [record["fitted"] for record in found.iterations if record["shaping"]]
    assert len(shaping) > 3 and shaping[-1] > 0.9 * shaping[-2]
    assert np.abs(np.log(np.median(found.state.albedo / albedo, axis=0))).max() < 0.2
    assert abs(found.state.roughness - ROUGHNESS) < 0.03


def test_highlights_join_a_light_that_was_found_without_them():
    """Judged at once, in a light that stands for them too, they lead the fit away: its second step is undone."""
    capture, albedo, _ = make_truth(lights=(coloured_light,))
    settings = AppearanceSettings(resolutions=(8,), steps=12, noise=(0.003, 0.01), roughness=0.45)
    matte = fit_appearance(capture, replace(settings, specular=False))
    start = replace(matte, state=replace(matte.state, specular=0.7, roughness=0.45), highlights_count=True)
    found = fit_appearance(capture, settings, start=start, shapes=True)
    assert found.iterations[0]["shaping"] and not found.iterations[-1]["shaping"] and found.highlights_count
    assert found.held_out < 0.6 * matte.held_out
    assert abs(found.state.roughness - ROUGHNESS) < 0.02
    assert np.abs(np.log(np.median(found.state.albedo / albedo, axis=0))).max() < 0.2


def test_highlights_wait_while_a_light_of_fewer_numbers_takes_shape():
    """A hard lamp that harmonics cannot show, whose highlights are narrower than the skin's; the scale of no channel
    follows them."""
    capture, albedo, _ = make_truth(lights=(hard_light,))
    settings = AppearanceSettings("harmonics_2", (8,), steps=12, noise=(0.003, 0.01), roughness=0.45)
    found = fit_appearance(capture, settings)
    first = [record["light"] for record in found.iterations].index("harmonics_2")
    shaping = [record["shaping"] for record in found.iterations[first:]]
    assert shaping[0] and not shaping[-1] and sorted(shaping, reverse=True) == shaping
    assert not reached_end(found.state.roughness, ROUGHNESS_RANGE) and found.highlights_count
    assert found.held_out < 0.011
    assert np.abs(np.log(np.median(found.state.albedo / albedo, axis=0))).max() < 0.2


def test_a_light_smoothed_less_at_last_finds_its_lamp():
    """A small lamp in the dark, under ten times the usual prior: flattened, with a darker skin under more light. Last
    steps with a tenth of it give the lamp back and some of the level; where held-out frames would have it otherwise,
    nothing changes."""
    capture, albedo, _ = make_truth(lights=(small_lamp,))
    settings = AppearanceSettings(resolutions=(8,), steps=12, noise=(0.003, 0.01), roughness=0.45,
                                  specular_prior=(SPECULAR, SURFACE_SPREAD))
    dull = replace(settings, priors=replace(settings.priors, smooth=10.0 * settings.priors.smooth))
    assert dull.at_last.priors == settings.priors
    before = fit_appearance(capture, dull)
    after = fit_sharper_light(capture, dull, before)
    contrast = [np.log(fit.state.light).std() for fit in (before, after)]
    level = [abs(np.log(np.median(fit.state.albedo / albedo, axis=0)).mean()) for fit in (before, after)]
    assert contrast[1] > 1.2 * contrast[0] and level[1] < 0.8 * level[0]
    assert after.held_out < 0.97 * before.held_out
    assert after.iterations[: len(before.iterations)] == before.iterations and after.scale is not None
    best = replace(before, held_out=0.5 * after.held_out)
    kept = fit_sharper_light(capture, dull, best)
    assert kept.state is best.state and kept.iterations == after.iterations


def test_a_fit_goes_on_from_a_solution(truth, solution):
    """From the solution of the same capture: the last resolution alone, until a step changes the scale by less than a
    hundredth, to the residual of fitted frames at which that came to rest or below, and about to that of held-out ones.
    """
    settings = AppearanceSettings(resolutions=(4, 8), steps=12, noise=(0.003, 0.01), roughness=0.45)
    again = fit_appearance(truth[0], settings, start=solution)
    assert {record["resolution"] for record in again.iterations} == {8}
    assert len(again.iterations) <= 8
    rested = solution.iterations[-1]
    assert again.fitted < 1.01 * rested["fitted"] and again.held_out < 1.03 * rested["held_out"]
    without = fit_appearance(truth[0], settings, start=replace(solution, highlights_count=False))
    assert not without.highlights_count and again.highlights_count


def test_some_points_say_what_the_light_is_and_a_last_step_on_all_finishes(truth, monkeypatch):
    """As the fit of all points from the first step on finds it, within its own error; steps of all points are
    two, the first of them without a change of the light."""
    from shared.appearance import fit as module

    capture, albedo, _ = truth
    settings = AppearanceSettings(resolutions=(4, 8), noise=(0.003, 0.01), roughness=0.45)
    exact = fit_appearance(capture, settings)
    some = capture.some_points(len(capture.points) // 4)
    assert len(some.points) <= len(capture.points) // 4 and len(some.points) > 80
    coarse = fit_appearance(some, settings)

    honest, moved = module.step, []

    def watched(problem, state, highlights_count, light_moves):
        moved.append((len(problem.capture.points), light_moves))
        return honest(problem, state, highlights_count, light_moves)

    monkeypatch.setattr(module, "step", watched)
    found = fit_all_points(capture, settings, coarse)
    assert moved == [(len(capture.points), False), (len(capture.points), True)]
    assert found.iterations[: len(coarse.iterations)] == coarse.iterations
    assert [field_faults(record, below(SOLVE, "iterations[]")) for record in found.iterations] == (
        [[]] * len(found.iterations)
    )
    assert found.state.albedo.shape == exact.state.albedo.shape
    apart = np.abs(scale_free_error(found.state.albedo, exact.state.albedo))
    errors = [np.median(np.abs(scale_free_error(fit.state.albedo, albedo))) for fit in (exact, found)]
    assert np.median(apart) < errors[0] and errors[1] < 0.01
    # The scale, of which strength and width of highlights say little, within what the priors leave open.
    assert abs(np.log(np.median(found.state.albedo / exact.state.albedo))) < settings.white_sigma
    assert found.held_out < 1.1 * exact.held_out

    def waiting(problem, state, highlights_count, light_moves):
        state, report = honest(problem, state, highlights_count, light_moves)
        return state, replace(report, scale=None)

    monkeypatch.setattr(module, "step", waiting)
    assert coarse.scale is not None and fit_all_points(capture, settings, coarse).scale is coarse.scale


def test_no_fewer_points_are_chosen_where_there_are_no_more(truth):
    capture = truth[0]
    assert capture.some_points(0) is capture and capture.some_points(len(capture.points)) is capture


def test_a_step_that_leads_away_is_undone_and_ends_its_resolution(truth, monkeypatch):
    """The first step that trusts highlights is spoilt: its state may not win, and highlights are not trusted again."""
    from shared.appearance import fit as module

    capture, _, _ = truth
    honest, counted = module.step, []

    def spoilt(problem, state, highlights_count, light_moves):
        counted.append(highlights_count)
        state, found = honest(problem, state, highlights_count, light_moves)
        if highlights_count:
            darker = replace(state.appearance, albedo=state.appearance.albedo * 0.5)
            return replace(state, appearance=darker), replace(found, held_out=3.0 * found.held_out,
                                                              rise=3.0 * found.rise)
        return state, found

    monkeypatch.setattr(module, "step", spoilt)
    found = fit_appearance(capture, AppearanceSettings(resolutions=(4, 8), steps=5, noise=(0.003, 0.01)))
    undone = [record for record in found.iterations if record.get("undone")]
    assert len(undone) == 1 and sum(counted) == 1
    assert field_faults(undone[0], below(SOLVE, "iterations[]")) == []
    shaping = [record for record in found.iterations if record["shaping"]]
    assert undone[0]["step"] == len(shaping) and undone[0]["resolution"] == 4
    assert found.held_out <= shaping[-1]["held_out"]


def test_the_fit_is_deterministic(matte):
    capture, _, _ = matte
    settings = replace(MATTE, resolutions=(4,), steps=2)
    first, second = (fit_appearance(capture, settings).state for _ in range(2))
    assert np.array_equal(first.params, second.params)
    assert np.array_equal(first.albedo, second.albedo)


def test_a_roughness_at_the_end_of_its_range_does_not_keep_the_scale_waiting(truth, monkeypatch):
    """Of lobes narrower than may be: what counts is how far the roughness went, so the scale is found all the same."""
    from shared.appearance import projection as module

    monkeypatch.setattr(module, "ROUGHNESS_RANGE", (0.48, 0.7))
    capture, albedo, _ = truth
    settings = AppearanceSettings(resolutions=(8,), steps=12, noise=(0.003, 0.01), roughness=0.55)
    assert changed_roughness(0.5, -1.0) == pytest.approx(0.48) == changed_roughness(0.48, -1.0)
    assert changed_roughness(0.48, 0.05) == pytest.approx(0.48 * np.exp(0.05))
    assert changed_roughness(0.5, 1.0) == pytest.approx(0.5 * np.exp(module.LARGEST_ROUGHNESS_STEP))

    found = fit_appearance(capture, settings)
    assert found.state.roughness == pytest.approx(0.48)
    assert [record["roughness"] for record in after_shaping(found)].count(0.48) > 1
    assert found.state.specular != settings.specular_prior[0]
    assert np.abs(np.log(np.median(found.state.albedo / albedo, axis=0))).max() < 0.2
