"""The light's operators and priors, the scale between light and albedo, and the choice of frames."""

import numpy as np
import pytest
from field_check import below, field_faults
from scipy.stats import norm

from shared.appearance.albedo_scale import (
    HIGHLIGHT_SIGMA,
    MODEL_ERROR,
    Highlights,
    mean_of_density,
    most_likely_irradiance,
    resolve_scale,
)
from shared.appearance.chart_scale import describe_scale
from shared.appearance.light import FrameLight, LightPriors, LogPrior, resample_light
from shared.appearance.light_models import make_light_model, real_harmonics
from shared.appearance.measured_skin import TYPICAL_SKIN, fit_skin_locus
from shared.contract.records import SOLVE
from shared.geometry.transforms import fibonacci_sphere, rotation_from_vector
from shared.imaging.color import LUMINANCE
from shared.imaging.frame_index import hold_out, spread_frames
from shared.rendering.envmap import cube_directions

DIRECTIONS = fibonacci_sphere(256)


def smooth_light(directions):
    """[N, 3] -> [N, 3] radiance of a broad lamp on a grey sky."""
    lamp = np.exp(4.0 * (directions @ np.array([-0.6, 0.48, 0.64]) - 1.0))
    return 0.45 + 0.15 * directions[:, 1:2] + lamp[:, None] * [2.2, 2.0, 1.8]


def test_frame_light_and_its_adjoint():
    turns = rotation_from_vector(np.array([[0.0, 0, 0], [0.2, -0.7, 0.1]]))
    light = FrameLight(6, DIRECTIONS, turns)
    rng = np.random.default_rng(3)
    texels, values = rng.normal(size=(216, 3)), rng.normal(size=(len(DIRECTIONS), 2, 3))
    assert np.allclose(light.along(np.ones((216, 1))), 1.0, atol=1e-6)
    expected = (light.along(texels) * values).sum()
    assert (texels * light.adjoint(values)).sum() == pytest.approx(expected, rel=1e-4, abs=1e-3)


def test_light_prior_gradient_and_null_space():
    prior, priors = LogPrior(4), LightPriors(smooth=2.0, white=3.0, edge=0.4)
    rng = np.random.default_rng(4)
    log_light, change = rng.normal(size=(2, 96, 3))
    _, gradient, product = prior(log_light, priors)
    ahead, behind = (prior(log_light + sign * 1e-5 * change, priors)[0] for sign in (1, -1))
    assert (ahead - behind) / 2e-5 == pytest.approx((gradient * change).sum(), rel=1e-6)
    assert (change * product(change)).sum() > 0
    cost, gradient, _ = prior(np.full((96, 3), 1.7), priors)
    assert cost == pytest.approx(0.0, abs=1e-12) and np.allclose(gradient, 0.0)


def test_resampled_light_keeps_its_shape():
    smooth = smooth_light(cube_directions(12))
    assert np.abs(np.log(resample_light(smooth, 16) / smooth_light(cube_directions(16)))).max() < 0.1
    assert np.allclose(resample_light(smooth, 12), smooth)


def test_surfaces_receive_the_same_from_a_resampled_lamp():
    """Lamps of one texel, a thousand times as bright as the others."""
    light = np.full((6 * 8**2, 3), 0.1)
    light[[27, 120, 300]] = 100.0
    normals, directions = fibonacci_sphere(64), fibonacci_sphere(4096)
    cosine = np.maximum(normals @ directions.T, 0.0)
    before, after = (
        cosine @ FrameLight(resolution, directions, np.eye(3)[None]).along(resample_light(light, resolution))[:, 0]
        for resolution in (8, 16)
    )
    assert np.abs(after / before - 1.0).max() < 0.1


# ---------------------------------------------------------------------- models


def test_harmonics_are_orthonormal():
    from shared.rendering.envmap import cube_solid_angles

    basis = real_harmonics(cube_directions(24), 4)
    gram = (basis * cube_solid_angles(24)[:, None]).T @ basis
    assert np.abs(gram - np.eye(25)).max() < 0.01
    assert np.allclose(basis[:, 0], np.sqrt(0.25 / np.pi))
    # Degree 1 with y up: (y, z, x) up to the factor sqrt(3 / 4 pi) and signs.
    assert np.allclose(np.abs(basis[:, [3, 1, 2]]), np.sqrt(0.75 / np.pi) * np.abs(cube_directions(24))[:, [2, 0, 1]])


MODELS = ("cubemap", "harmonics_2", "harmonics_4", "sun_sky", "camera")


def some_light(name):
    """A model with parameters in general position, and a random change of them."""
    model = make_light_model(name, 6)
    rng = np.random.default_rng(5)
    params = model.fit(smooth_light(cube_directions(8)))
    return model, params + 0.1 * rng.normal(size=params.shape), rng.normal(size=params.shape)


@pytest.mark.parametrize("name", MODELS)
def test_light_models_have_the_derivatives_they_state(name):
    model, params, change = some_light(name)
    ahead, behind = (model.radiance(params + sign * 1e-5 * change) for sign in (1, -1))
    tangent = model.tangent(params, change)
    assert np.allclose((ahead - behind) / 2e-5, tangent, rtol=1e-4, atol=1e-6)
    values = np.random.default_rng(6).normal(size=tangent.shape)
    assert (values * tangent).sum() == pytest.approx((model.adjoint(params, values) * change).sum(), rel=1e-9)
    priors = LightPriors(smooth=2.0, white=3.0)
    _, gradient, product = model.prior(params, priors)
    ahead, behind = (model.prior(params + sign * 1e-5 * change, priors)[0] for sign in (1, -1))
    assert (ahead - behind) / 2e-5 == pytest.approx((gradient * change).sum(), rel=1e-5)
    assert (change * product(change)).sum() > 0


@pytest.mark.parametrize("name", MODELS)
def test_light_models_scale_by_their_unit(name):
    model, params, _ = some_light(name)
    factor = np.array([0.2, -0.1, 0.4])
    assert np.allclose(model.radiance(model.scaled(params, factor)), np.exp(factor) * model.radiance(params))
    assert np.allclose(model.tangent(params, model.unit * np.ones(3)), model.radiance(params))


def test_light_models_find_their_own_light():
    """A low sun in a gradient sky is found as such; harmonics of order 4 come closer to it than of order 2."""
    towards = np.array([0.6, 0.48, 0.64])
    directions = cube_directions(16)
    sky = np.exp(0.3 * directions[:, 1:2]) * [0.4, 0.5, 0.7]
    light = sky + np.exp(80.0 * (directions @ towards - 1.0))[:, None] * [30.0, 25.0, 18.0]
    sun = make_light_model("sun_sky", 16)
    params = sun.fit(light)
    found = params[-1] / np.linalg.norm(params[-1])
    assert found @ towards > np.cos(np.radians(6.0))
    assert np.allclose(np.exp(params[-2]), [30.0, 25.0, 18.0], rtol=0.15)
    errors = [np.square(np.log(m.radiance(m.fit(light)) / light)).mean() for m in (
        make_light_model("harmonics_2", 16), make_light_model("harmonics_4", 16), make_light_model("cubemap", 16))]
    assert errors[0] > 1.2 * errors[1] > errors[2] and errors[2] < 1e-12
    camera = make_light_model("camera", 16)
    lit = camera.radiance(np.array([[-1.0] * 3, [2.0] * 3]))
    assert directions[lit.sum(1).argmax()] @ [0, 0, 1] > np.cos(np.radians(6.0))
    assert np.allclose(camera.fit(lit), [[-1.0] * 3, [2.0] * 3], atol=0.1)


# ---------------------------------------------------------------------- scale


def on_the_locus():
    """log albedo [3] of the skin that the priors like best: mean luminance (linearised as there), chroma to match."""
    locus = fit_skin_locus()
    typical = TYPICAL_SKIN
    share = LUMINANCE * typical / (LUMINANCE @ typical)
    constant = np.log(LUMINANCE @ typical) - share @ np.log(typical)
    matrix = np.array([share, [1.0, -1, 0], [0, -1.0, 1]])
    return np.linalg.solve(matrix, [locus.mean_log_luminance - constant, *locus.offset])


def test_white_light_on_likely_skin_is_taken_as_such():
    for level in (-1.0, 0.0, 1.5):
        found = most_likely_irradiance(on_the_locus() + level)
        assert np.allclose(found, level, atol=1e-9)


def test_the_scale_follows_the_exposure_and_shares_a_tint():
    radiance = np.log([0.4, 0.3, 0.25])
    assert np.allclose(most_likely_irradiance(radiance + 0.7), most_likely_irradiance(radiance) + 0.7)
    tint = np.array([0.1, 0.0, -0.1])
    moved = most_likely_irradiance(radiance + tint) - most_likely_irradiance(radiance)
    assert 0.0 < moved[0] - moved[2] < 0.2
    sure = most_likely_irradiance(radiance + tint, white_sigma=1e-4)
    assert np.ptp(sure) < 1e-3


def test_highlights_tell_a_bright_light_from_bright_skin():
    """All statements agree on the factor 1/2: light twice too bright, so highlights look half as strong."""
    skin, mean = on_the_locus(), (0.7, 0.35)
    light = np.full(3, np.log(2.0))
    found = Highlights(np.full(3, 0.35), np.full(3, 100.0), np.ones(3))
    log_factor, specular, *_ = resolve_scale(skin - light, light, found, mean)
    assert np.allclose(log_factor, -np.log(2.0), atol=1e-6)
    assert specular == pytest.approx(0.7, rel=1e-6)
    without, specular, *_ = resolve_scale(skin - light, light, None, mean)
    assert np.allclose(without, -np.log(2.0), atol=1e-6) and specular == 0.7
    stronger = Highlights(np.full(3, 0.7), np.full(3, 100.0), np.ones(3))
    assert (resolve_scale(skin - light, light, stronger, mean)[0] > -np.log(2.0) + 0.05).all()


def test_highlights_that_are_not_there_say_little():
    """An intensity below 0 within its error is a faint highlight, not an infinitely fainter light."""
    skin = on_the_locus()
    faint = Highlights(np.array([-0.2, 0.2, 0.4]), np.full(3, 4.0), np.full(3, 10.0))
    log_factor, specular, *_ = resolve_scale(skin, np.zeros(3), faint, (0.7, 0.25))
    assert (np.abs(log_factor) < 0.6).all() and 0.5 < specular < 0.8


def test_what_is_known_of_the_scale_adds_up_as_precisions():
    skin, prior = on_the_locus(), (0.7, 0.35)
    alone = resolve_scale(skin, np.zeros(3), None, prior)
    np.testing.assert_allclose(alone.covariance, alone.prior_covariance, rtol=1e-4)
    said = np.diag([0.02, 0.03, 0.05]) ** 2
    both = resolve_scale(skin, np.zeros(3), None, prior, chart=(np.zeros(3), said))
    np.testing.assert_allclose(both.covariance, np.linalg.inv(np.linalg.inv(alone.covariance) + np.linalg.inv(said)))
    shine = resolve_scale(skin, np.zeros(3), Highlights(np.full(3, 0.7), np.full(3, 1e6), np.ones(3)), prior)
    jointly = np.zeros((4, 4))  # of the three factors and of the intensity, which highlights show the product of
    jointly[:3, :3], jointly[3, 3] = np.linalg.inv(alone.covariance), prior[1] ** -2
    known, spread = jointly.copy(), 0.7 * np.sqrt(HIGHLIGHT_SIGMA**2 + MODEL_ERROR**2)
    for channel in np.eye(4)[:3] + np.eye(4)[3]:
        jointly += np.outer(channel, channel) * (0.7 / spread) ** 2
    # Their tails are heavier than a normal density's: summed over a grid of the normal one's axes.
    steps = np.linspace(-6.0, 6.0, 21)
    x = np.stack(np.meshgrid(*[steps] * 4), -1).reshape(-1, 4) @ np.linalg.cholesky(np.linalg.inv(jointly)).T
    off = (0.7 * np.exp(x[:, :3] + x[:, 3:]) - 0.7) / spread
    density = np.exp(-0.5 * ((x @ known) * x).sum(1) - (np.sqrt(1.0 + off**2) - 1.0).sum(1))
    density /= density.sum()
    around = x - density @ x
    expected = (density[:, None] * around).T @ around
    np.testing.assert_allclose(shine.covariance, expected[:3, :3], rtol=0.01)
    assert (np.diag(expected) > np.diag(np.linalg.inv(jointly))).all()


def test_the_record_of_the_scale_states_its_interval():
    skin = np.exp(on_the_locus())
    alone = resolve_scale(np.log(skin), np.zeros(3), None, (0.7, 0.35))
    record = alone.describe(skin)
    low, high = np.array(record["skin_albedo_90"])
    reach = np.exp(1.645 * np.sqrt(np.diag(alone.covariance)))
    np.testing.assert_allclose([low, high], [skin / reach, skin * reach], atol=1e-4)
    assert record["prior_share"] == pytest.approx(1.0, rel=1e-4)
    share = LUMINANCE * skin / (LUMINANCE @ skin)
    assert record["log_sigma"]["luminance"] ** 2 == pytest.approx(share @ alone.covariance @ share, rel=1e-3)
    assert field_faults(describe_scale(None, skin, scale=alone), below(SOLVE, "albedo_scale")) == []


def test_no_skin_returns_more_than_the_lightest():
    """Faint highlights ask for a dim light on light skin; its brightest places say how light it can be."""
    skin = np.log([0.6, 0.4, 0.3])
    faint = Highlights(np.full(3, 0.2), np.full(3, 1e4), np.full(3, 2.0))
    free, *_ = resolve_scale(skin, np.zeros(3), faint, (0.7, 0.25))
    held, *_ = resolve_scale(skin, np.zeros(3), faint, (0.7, 0.25), log_brightest=skin + 0.15)
    assert np.exp(skin + 0.15 - free).max() > 1.0
    assert np.exp(skin + 0.15 - held).max() < 0.95
    dark = on_the_locus()
    unhindered, *_ = resolve_scale(dark, np.zeros(3), None, (0.7, 0.25), log_brightest=dark + 0.15)
    assert np.allclose(unhindered, resolve_scale(dark, np.zeros(3), None, (0.7, 0.25))[0], atol=1e-6)


def test_a_bound_on_the_brightest_skin_leaves_what_lies_within():
    """Matt skin under an even light, whose faint highlights ask for skin lighter than any: the answer is not the
    lightest skin that may be, with what the bound alone leaves open, but the mean of what lies within the bound, here
    at the mode: 0.8 deviations from it with 0.6 of its deviation, were it one channel alone."""
    skin = np.log([0.6, 0.4, 0.3])
    faint = Highlights(np.full(3, 0.45), np.full(3, 50.0), np.full(3, 15.0))
    free = resolve_scale(skin, np.zeros(3), faint, (0.7, 0.25))
    held = resolve_scale(skin, np.zeros(3), faint, (0.7, 0.25), log_brightest=np.log(0.847) + free.log_factor)
    moved, deviation = held.log_factor + held.beyond[:3] - free.log_factor, np.sqrt(np.diag(free.covariance))
    assert (moved > 0.7 * deviation).all() and (moved < 1.2 * deviation).all()
    assert (np.abs(held.log_factor - free.log_factor) < 0.2 * deviation).all(), "the most likely lies on the bound"
    assert (np.sqrt(np.diag(held.covariance)) > 0.5 * deviation).all()
    assert np.array_equal(resolve_scale(skin, np.zeros(3), None, (0.7, 0.25)).beyond, np.zeros(4))
    alone = resolve_scale(skin, np.zeros(3), None, (0.7, 0.25))
    matt = resolve_scale(skin, np.zeros(3), None, (0.7, 0.25), log_brightest=np.log(0.847) + alone.log_factor)
    np.testing.assert_allclose(matt.log_factor, alone.log_factor, atol=1e-6)
    spread = np.sqrt(np.diag(matt.covariance) / np.diag(alone.covariance))
    assert (0.5 < spread).all() and (spread < 0.75).all(), "half of a normal density spreads by 0.6 of it"


def test_the_mean_of_a_bounded_density_is_that_of_the_truncated_normal():
    """One coordinate of a normal density of given covariance is cut at a wall; the mean moves by the inverse Mills
    ratio along what goes with that coordinate (Johnson, Kotz, Balakrishnan: Continuous Univariate Distributions 1,
    13.10)."""
    covariance = np.array([[0.09, 0.03, 0.0], [0.03, 0.04, 0.01], [0.0, 0.01, 0.16]])
    middle, whitening = np.array([0.2, -0.1, 0.5]), np.linalg.inv(np.linalg.cholesky(covariance))

    def stated(x):
        return (x - middle) @ whitening.T

    for wall in (-0.1, 0.2, 0.5):
        mode = middle + covariance[0] / covariance[0, 0] * min(wall - middle[0], 0.0)
        mean, found = mean_of_density(stated, lambda x, at=wall: 1e4 * np.maximum(x[..., :1] - at, 0.0), mode)
        beta = (wall - middle[0]) / 0.3
        mills = norm.pdf(beta) / norm.cdf(beta)
        along, kept = covariance[0] / 0.3, 1.0 - beta * mills - mills**2
        np.testing.assert_allclose(mean, middle - along * mills, atol=0.01)
        np.testing.assert_allclose(found, covariance - np.outer(along, along) * (1.0 - kept), atol=0.002)
    mean, found = mean_of_density(stated, lambda x: np.zeros(x.shape), middle)
    np.testing.assert_allclose(mean, middle, atol=1e-6)
    np.testing.assert_allclose(found, covariance, atol=5e-4)


def test_frames_are_spread_and_held_out_evenly():
    assert spread_frames(100, 5).tolist() == [0, 25, 50, 74, 99]
    assert spread_frames(3, 10).tolist() == [0, 1, 2]
    fitted = hold_out(40, 8)
    assert np.nonzero(~fitted)[0].tolist() == [4, 12, 20, 28, 36]
    assert hold_out(8, 8).all()


@pytest.mark.parametrize(
    ("albedo", "shine", "astray"), [([0.274, 0.114, 0.055], 0.02, 0.8), ([0.2, 0.05, 0.02], 0.03, 3.0)]
)
def test_highlights_that_grow_with_the_light_do_not_lead_the_scale_away(albedo, shine, astray):
    """Red skin beside white highlights that say nothing. What they take from the albedo as the light grows makes it
    dark and red, as if it were darker skin, which asks for more light. Step by step the scale comes to rest near where
    it was, and runs away where each step takes the diffuse radiance for given."""
    whole = np.array(albedo) + shine

    def levels(known: bool) -> list[np.ndarray]:
        found = [np.zeros(3)]
        for _ in range(12):
            level = np.clip(found[-1], -5.0, 5.0)
            highlights = shine * np.exp(level)
            diffuse = np.maximum(whole - highlights, 1e-3)
            share = highlights / diffuse if known else None
            step = resolve_scale(np.log(diffuse) - level, level, None, (0.84, 0.25), shine=share).log_factor
            found.append(level + step)
        return found

    rested = levels(known=True)
    assert np.abs(rested[-1]).max() < 0.7 and np.abs(rested[-1] - rested[-2]).max() < 0.01
    assert np.abs(levels(known=False)[-1]).max() > astray


def test_highlights_that_are_none_change_nothing():
    skin = np.log([0.3, 0.2, 0.12])
    plain = resolve_scale(skin, np.zeros(3), None, (0.84, 0.25), log_brightest=skin + 0.5)
    none = resolve_scale(skin, np.zeros(3), None, (0.84, 0.25), log_brightest=skin + 0.5, shine=np.zeros(3))
    np.testing.assert_allclose(none.log_factor, plain.log_factor, atol=1e-6)
    np.testing.assert_allclose(none.covariance, plain.covariance, rtol=1e-5)
