"""The prior on how skin varies over a face: alone, and in captures whose light is coloured."""

from dataclasses import replace

import numpy as np
import pytest
from toy_capture import coloured_light, make_truth, swinging

from shared.appearance.fit import fit_appearance
from shared.appearance.problem import AppearanceSettings
from shared.appearance.skin_prior import SkinPrior, SkinVariation

SETTINGS = AppearanceSettings(resolutions=(6,), steps=8, specular=False, noise=(0.003, 0.01))
TAN = np.array([0.50, 0.31, 0.23])
SMALL_TURN = swinging(turn=np.radians(10.0))


def even_skin(positions):
    """Of one colour, but for spots a centimetre wide, and alike on both sides."""
    x, y, z = positions.T / 4.0
    return TAN * np.exp(0.1 * np.cos(x) * np.sin(y + z))[:, None]


def flushed_skin(positions):
    """Redder and darker on the left."""
    side = np.tanh(positions[:, :1] / 30.0)
    return even_skin(positions) * np.exp(side * np.array([0.0, 0.15, 0.15]))


def side_colours(values, positions):
    """By how much log R/G and log B/G are higher on the right than on the left, [2]."""
    ratio = np.log(values[:, [0, 2]] / values[:, [1]])
    return ratio[positions[:, 0] > 10.0].mean(0) - ratio[positions[:, 0] < -10.0].mean(0)


def side_error(moves, settings, skin=even_skin, poses=SMALL_TURN):
    """Largest error of side_colours of the albedo found in the coloured room."""
    capture, albedo, _ = make_truth(0.0, lights=(coloured_light,), poses=poses, moves=moves, true_albedo=skin)
    found, positions = fit_appearance(capture, settings).state.albedo, capture.points.positions
    return np.abs(side_colours(found, positions) - side_colours(albedo, positions)).max()


def test_a_coloured_room_stays_out_of_the_albedo(one_thread):
    """A camera moves around a still head: samples say nothing of what is light and what is skin at large scale."""
    assert side_error("camera", replace(SETTINGS, skin=None)) > 0.5
    assert side_error("camera", SETTINGS) < 0.1


def test_what_a_wide_turn_shows_outweighs_the_prior(one_thread):
    """A face that is redder on one side, as the prior does not like it, in the coloured room; exact poses and shape."""
    assert side_error("head", SETTINGS, flushed_skin, poses=None) < 0.02


# ---------------------------------------------------------------------- the prior alone


@pytest.fixture(scope="module")
def patch():
    """A prior over a curved piece of skin, and its points [P, 3]."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-70, 70, 57), np.linspace(-80, 80, 65)))
    positions = np.stack([x, y, 60.0 - 0.008 * x**2], axis=1)
    return SkinPrior(positions, np.ones(len(x), bool), SkinVariation()), positions


def cost_of(prior, log_albedo):
    """Of a field [3, P] seen in full."""
    return prior.at(log_albedo, np.ones(log_albedo.shape[1])).cost(log_albedo)


def test_the_mean_is_free_in_every_channel(patch):
    prior, positions = patch
    assert cost_of(prior, np.log(np.tile(TAN[:, None], len(positions)))) == pytest.approx(0.0, abs=1e-6)


def test_gradient_is_the_derivative_of_the_cost(patch):
    prior, positions = patch
    rng = np.random.default_rng(0)
    log_albedo, change = 0.1 * rng.normal(size=(2, 3, len(positions)))
    pull = prior.at(log_albedo, rng.uniform(size=len(positions)))
    ahead, behind = (pull.cost(log_albedo + sign * 1e-4 * change) for sign in (1, -1))
    assert (ahead - behind) / 2e-4 == pytest.approx((pull(log_albedo) * change).sum(), rel=1e-6)
    assert (change * pull(log_albedo)).sum() == pytest.approx((log_albedo * pull(change)).sum(), rel=1e-9)


def test_unlike_sides_cost_more_than_alike_ones_and_colour_more_than_brightness(patch):
    prior, positions = patch
    slope = positions[:, 0] / 50.0
    bright, red = np.full((3, 1), 0.2), 0.2 * np.array([[1.0], [-0.5], [-0.5]])
    even, odd = (np.abs(slope) - np.abs(slope).mean()), slope
    assert cost_of(prior, bright * odd) > 1.5 * cost_of(prior, bright * even)
    assert cost_of(prior, red * odd) > 1.5 * cost_of(prior, bright * odd)


def test_fields_drawn_from_the_prior_cost_what_they_should(patch):
    """Half a unit for each patch but the one that the free mean takes, in brightness and in each of two colours; less,
    since the loss is robust."""
    prior, positions = patch
    rng, own = np.random.default_rng(1), prior.variation
    costs = []
    for _ in range(8):
        drawn = rng.multivariate_normal(np.zeros(prior.count), prior.covariance, 3, method="cholesky")
        noise = rng.normal(size=(3, prior.count))
        parts = [sigma * drawn + texture * noise for sigma, texture in
                 ((own.brightness, own.brightness_texture), (own.colour, own.colour_texture))]
        colour = parts[1] - parts[1].mean(0)
        costs.append(cost_of(prior, (parts[0][0] + colour)[:, prior.patch]))
    expected = 1.5 * (prior.count - 1)
    assert 0.5 * expected < np.mean(costs) < 1.1 * expected


def test_hair_does_not_drag_the_skin(patch):
    """Under a dark fringe over a fifth of the skin a gradient elsewhere is pulled as if the fringe were not there."""
    prior, positions = patch
    field = 0.1 * np.array([[1.0], [0.0], [-1.0]]) * positions[:, 0] / 70.0
    hair = positions[:, 1] > 48.0
    fringe = np.where(hair, -1.5, 0.0)
    bare, worn = (prior.at(values, np.ones(len(hair)))(values)[:, ~hair] for values in (field, field + fringe))
    far = positions[~hair, 1] < 20.0
    assert np.abs((worn - bare)[:, far]).max() < 0.2 * np.abs(bare[:, far]).max()
