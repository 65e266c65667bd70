"""Normal equations of texels against direct least squares, their errors, and the field that continues them."""

import numpy as np
import pytest
from scipy.optimize import minimize
from shapes import grid_plane

from shared.appearance.texture import (
    DEGREES,
    LEAST_BORDER_MM,
    PRIOR_SPREAD,
    BorderSums,
    Noise,
    NormalEquations,
    ScatterSums,
    pooled_specular,
    robust_weight,
)
from shared.imaging.texels import SmoothFields, TexelSamples

NOISE = Noise(0.01, 0.02)
NEVER_WRONG = np.zeros((10, 3))


class FewTexels:
    """A surface of n texels side by side, enough for pooling."""

    def __init__(self, size):
        self.size, self.pixel = size, np.arange(size * size)

    def __len__(self):
        return len(self.pixel)

    def to_image(self, values):
        return values.reshape(self.size, self.size)


def random_frames(texels, frames=7, seed=0):
    """E, S, I [F, T, 3], weight [F, T]; each frame shows most texels."""
    rng = np.random.default_rng(seed)
    irradiance, reflection = rng.uniform(0.2, 1.0, (frames, texels, 3)), rng.uniform(0.0, 0.3, (frames, texels, 3))
    colours = rng.uniform(0.1, 0.9, (frames, texels, 1)) * irradiance + 0.5 * reflection
    colours += 0.02 * rng.normal(size=colours.shape)
    weight = rng.uniform(0.1, 1.0, (frames, texels)) * (rng.random((frames, texels)) < 0.8)
    return irradiance, reflection, colours, weight


def accumulated(irradiance, reflection, colours, weight, saturation=None):
    equations = NormalEquations(irradiance.shape[1], NOISE)
    saturation = np.zeros(colours.shape, np.int8) if saturation is None else saturation
    for f in range(len(irradiance)):
        rows = np.nonzero(weight[f] > 0)[0]
        samples = TexelSamples(rows, colours[f, rows], weight[f, rows], saturation[f, rows])
        equations.add(samples, irradiance[f, rows], reflection[f, rows], np.ones((len(rows), 3)))
    return equations


def test_albedo_is_weighted_least_squares():
    frames = random_frames(12)
    irradiance, reflection, colours, weight = frames
    specular = np.linspace(0.0, 1.0, 12)
    found = accumulated(*frames).solve_albedo(specular, np.zeros((12, 3)), 1e-6)
    for t in range(12):
        for c in range(3):
            root = np.sqrt(weight[:, t] * NOISE.precision(colours[:, t, c]))
            right = colours[:, t, c] - specular[t] * reflection[:, t, c]
            expected = np.linalg.lstsq((root * irradiance[:, t, c])[:, None], root * right, rcond=None)[0][0]
            assert found[t, c] == pytest.approx(np.clip(expected, 0.002, 1.0), abs=1e-4)


def test_a_texel_is_drawn_to_the_mode_of_students_t():
    """The nearer to its surroundings the more, and never past its samples: as a search for the mode finds it."""
    frames = random_frames(12)
    equations, specular, rng = accumulated(*frames), np.full(12, 0.3), np.random.default_rng(1)
    told = equations.solve_albedo(specular, np.zeros((12, 3)), 1e-6)
    around = told * np.exp(rng.normal(size=(12, 1)) * np.linspace(0.1, 1.5, 12)[:, None])
    variance = rng.uniform(0.0, 0.3, (12, 3))
    found = equations.drawn_albedo(specular, around, 1e-6, variance)

    def badness(off, t):
        error = np.log(told[t] / around[t]) - off
        return np.sum(error**2 / variance[t]) + (DEGREES + 3) * np.log1p(off @ off / (PRIOR_SPREAD**2 * (DEGREES + 3)))

    for t in range(12):
        expected = around[t] * np.exp(minimize(badness, np.zeros(3), (t,)).x)
        np.testing.assert_allclose(found[t], np.minimum(expected, 1.0), rtol=0.02)
    np.testing.assert_allclose(equations.drawn_albedo(specular, around, 1e-6, np.zeros((12, 3))), told, rtol=1e-4)


def test_intensity_is_joint_least_squares_with_albedo():
    """Four unknowns per texel at once give what the equations with the albedo projected out give."""
    frames = random_frames(16, frames=9, seed=1)
    irradiance, reflection, colours, weight = frames
    found = pooled_specular(FewTexels(4), accumulated(*frames), 1e-3, 0.5, 1e4)
    for t in range(16):
        root = np.sqrt(weight[:, t, None] * NOISE.precision(colours[:, t]))
        design = np.zeros((9, 3, 4))
        design[:, [0, 1, 2], [0, 1, 2]] = root * irradiance[:, t]
        design[:, :, 3] = root * reflection[:, t]
        solution = np.linalg.lstsq(design.reshape(27, 4), (root * colours[:, t]).ravel(), rcond=None)[0]
        assert found[t] == pytest.approx(np.clip(solution[3], 0.0, 2.0), abs=2e-3)


def test_without_pooling_every_texel_has_the_mean_intensity():
    equations = accumulated(*random_frames(16))
    assert np.array_equal(pooled_specular(FewTexels(4), equations, np.inf, 0.4, 0.25), np.full(16, 0.4, np.float32))
    tight = pooled_specular(FewTexels(4), equations, 1.0, 0.4, 1e-6)
    assert np.allclose(tight, 0.4, atol=1e-4)


def test_information_grows_with_frames():
    frames = random_frames(10, frames=8)
    frames[3][:] = 1.0
    some = accumulated(*(x[:4] for x in frames)).information(np.full(3, 0.9), NEVER_WRONG)
    every = accumulated(*frames).information(np.full(3, 0.9), NEVER_WRONG)
    assert (every > some).all()
    double = accumulated(*(np.concatenate([x, x]) for x in frames)).information(np.full(3, 0.9), NEVER_WRONG)
    assert np.allclose(double, 2.0 * every, rtol=1e-5)
    # Errors that all frames share cannot be averaged away.
    shared = accumulated(*frames).information(np.full(3, 0.9), NEVER_WRONG + 0.04)
    assert (shared < 25.0).all() and np.allclose(1.0 / shared, 1.0 / every + 0.04)


def test_what_is_left_of_a_mostly_clipped_texel_says_little():
    """The few samples of red that are not clipped are its darkest: worth less than the same few seen alone."""
    frames = random_frames(10, frames=8)
    frames[3][:] = 1.0
    saturation = np.zeros(frames[2].shape, np.int8)
    saturation[:6, :, 0] = 1
    found = accumulated(*frames, saturation).information(np.full(3, 0.9), NEVER_WRONG)
    alone = accumulated(*(x[6:] for x in frames)).information(np.full(3, 0.9), NEVER_WRONG)
    whole = accumulated(*frames).information(np.full(3, 0.9), NEVER_WRONG)
    assert (found[:, 0] < 0.5 * alone[:, 0]).all()
    assert np.allclose(found[:, 1:], whole[:, 1:])


def test_what_is_only_seen_near_the_heads_border_says_little():
    """However many frames show it; one good view among many poor ones is enough."""
    sure, unsure = BorderSums(3, 0.0), BorderSums(3, 2.0)
    for row in np.array([[0.22, 0.9, 0.22]] * 40 + [[0.22, 0.9, 0.95]] * 20):
        for sums in (sure, unsure):
            sums.add(TexelSamples(np.arange(3), np.full((3, 3), 0.3), row**2, np.zeros((3, 3), np.int8)))
    share = PRIOR_SPREAD**2 / (PRIOR_SPREAD**2 + sure.variance())
    assert share[0] < 0.6 and share[1] > 0.99 and share[2] > 0.97
    assert np.allclose(unsure.variance(), (2.0 / LEAST_BORDER_MM) ** 2 * sure.variance())


def test_errors_of_highlights_count_by_their_share():
    """Highlights that are a share q of a texel's light leave the rest's logarithm uncertain by 10 % of q / (1 - q);
    where they exceed all the light, as in hair with a skin's specular intensity, nothing is left to be known."""
    albedo, specular = np.array([0.2, 0.2, 0.002, 0.0]), 0.5
    reflection = np.array([0.0, 0.1, 0.3, 0.0])
    irradiance = np.where(albedo > 0, 1.0, 0.0)
    e, s, i = (np.tile(x[None, :, None], (6, 1, 3)) for x in (irradiance, reflection, albedo + specular * reflection))
    variance = accumulated(e, s, i, np.ones((6, 4))).highlight_variance(specular)
    assert np.allclose(variance[[0, 3]], 0.0), "no highlight, or no sample at all"
    assert np.allclose(variance[1], (0.1 * 0.5 * 0.1 / 0.2) ** 2, rtol=1e-4)
    assert (variance[2] > 1.0).all()
    own = np.array([specular, 0.25, specular, specular])
    by_texel = accumulated(e, s, i, np.ones((6, 4))).highlight_variance(own)
    assert np.allclose(by_texel[[0, 2, 3]], variance[[0, 2, 3]]) and (by_texel[1] < 0.5 * variance[1]).all()


def test_no_albedo_sends_out_more_than_its_samples_show():
    """Highlights may be any share of what a black beard sends out; what it shows without any bounds its albedo, looser
    where the light is in doubt and not at all where most samples are clipped."""
    radiance, saturation = np.full((6, 3, 3), 0.02), np.zeros((6, 3, 3), np.int8)
    saturation[:4, 1] = 1
    irradiance, reflection = np.full((6, 3, 3), 0.8), np.full((6, 3, 3), 0.1)
    irradiance[:, 2] = 0.0
    equations = accumulated(irradiance, reflection, radiance, np.ones((6, 3)), saturation)
    sure = equations.brightest_albedo(np.zeros((3, 3)))
    assert np.allclose(sure[0], 0.02 / 0.8) and np.isinf(sure[1:]).all()
    assert np.allclose(equations.brightest_albedo(np.full((3, 3), 0.04))[0], np.exp(0.4) * 0.02 / 0.8)
    assert equations.solve_albedo(np.full(3, 0.5), 0.3, 1e6)[0, 0] > 0.25, "what the skin around would make of it"


def test_scatter_is_what_frames_contradict_each_other_by():
    """Relative errors of +-0.4 in frames of one brightness have the variance 0.16; an error that all frames share is
    the albedo's; clipped samples contradict nothing, and noise is no scatter."""
    frames, texels, radiance = 400, 4, 0.3
    rng = np.random.default_rng(0)
    sigma = NOISE.absolute + NOISE.relative * radiance
    colours = np.full((frames, texels, 3), radiance)
    model = colours.copy()
    model[:, 0] *= 1.0 + 0.4 * (-1.0) ** np.arange(frames)[:, None]
    model[:, 1] *= 1.5
    model[:, 2] += sigma * rng.normal(size=(frames, 3))
    model[:, 3] *= 1.0 + 0.4 * (-1.0) ** np.arange(frames)[:, None]
    saturation = np.zeros(colours.shape, np.int8)
    saturation[:, 3] = 1
    sums, rows = ScatterSums(texels, NOISE), np.arange(texels)
    for f in range(frames):
        samples = TexelSamples(rows, colours[f], np.full(texels, 0.5), saturation[f])
        sums.add(samples, model[f], model[f], np.zeros((texels, 3)))
    variance = sums.variance()
    # About the best common factor, which is 1 / 1.16: sum (1.4 x - 1)^2 + (0.6 x - 1)^2 over sum of their squares.
    best = 1.0 / 1.16
    expected = ((1.4 * best - 1) ** 2 + (0.6 * best - 1) ** 2) / (1.4**2 + 0.6**2)
    noise = sigma**2 / radiance**2 / 1.16
    assert variance[0] == pytest.approx(expected - noise, rel=0.01)
    assert variance[1].max() < 1e-6
    assert variance[2].max() < 0.2 * sigma**2 / radiance**2
    assert (variance[3] == 0.0).all()


def test_channels_of_a_sample_show_the_same_thing():
    """A neck whose red burns out, behind a dark collar in a third of the frames: of red the first pass knows the collar
    alone. Green and blue tell which frames show the neck, and their bounds bring red up to it."""
    neck, collar, frames = np.array([1.3, 0.6, 0.4]), np.array([0.05, 0.04, 0.04]), 30
    shows_neck = np.arange(frames) % 3 > 0
    truth = np.where(shows_neck[:, None], neck, collar)
    colours, saturation = np.minimum(truth, 1.0), np.where(truth > 1.0, 1, 0).astype(np.int8)
    samples = TexelSamples(np.zeros(frames, int), colours, np.ones(frames), saturation)
    first = np.array([collar[0], *np.median(colours[:, 1:], axis=0)])
    weight = robust_weight(np.tile(first, (frames, 1)), samples, NOISE, np.full(1, 1e4))
    assert weight[shows_neck].min() > 0.95 and weight[~shows_neck].max() < 0.1
    red = (weight[:, 0] * colours[:, 0]).sum() / weight[:, 0].sum()
    assert 0.9 < red <= 1.0


def test_robust_weights():
    colours = np.full((4, 3), 0.5, np.float32)
    model = colours + np.array([[0.0], [0.02 * 2.5], [5.0], [-0.2]], np.float32)
    saturation = np.zeros((4, 3), np.int8)
    samples = TexelSamples(np.arange(4), colours, np.ones(4), saturation)
    known = np.full(4, 1e9)
    weight = robust_weight(model, samples, NOISE, known)
    assert np.allclose(weight[0], 1.0) and np.allclose(weight[1], 0.5) and (weight[2] < 1e-4).all()
    saturation[2], saturation[3] = 1, 1
    weight = robust_weight(model, samples, NOISE, known)
    assert (weight[2] == 0).all(), "a clipped sample is satisfied by any brighter model"
    assert (weight[3] > 0).all(), "and still pulls a darker one up"
    saturation[3] = -1
    assert (robust_weight(model, samples, NOISE, known)[3] == 0).all()
    saturation[:] = 0
    guessed = robust_weight(model, samples, NOISE, np.zeros(4))
    told = robust_weight(model, samples, NOISE, known)
    assert (guessed[3] > 3.0 * told[3]).all(), "a model that knows nothing does not overrule a sample"


def test_field_continues_what_is_known_and_sinks_to_the_mean():
    """A linear ramp known on the rim of a square goes on inside; a loose part of which nothing is known is the mean."""
    plate = grid_plane(17, 1.0)
    x, y = plate.uvs.T
    values = np.stack([x + 2 * y, 3 - x], axis=1)
    rim = np.repeat((np.abs(plate.uvs - 0.5).max(1) > 0.49)[:, None], 2, axis=1)
    mean = np.array([0.3, -0.2])
    found = SmoothFields(plate, 0.05, 100.0).through(np.where(rim, values, 0.0), 1e6 * rim, mean)
    assert np.allclose(found, values, atol=0.03)
    loose = plate.replace(
        vertices=np.concatenate([plate.vertices, plate.vertices + 5.0]),
        faces=np.concatenate([plate.faces, plate.faces + len(x)]),
    )
    known = np.repeat([[1.0, 1.0], [0.0, 0.0]], len(x), axis=0)
    both = SmoothFields(loose, 0.05, 1.0).through(np.tile(values, (2, 1)), known, mean)
    assert np.allclose(both[len(x) :], mean, atol=1e-6)


def test_field_stops_where_another_region_begins():
    plate = grid_plane(9, 1.0)
    region = plate.uvs[:, 0] > 0.45
    known = np.where(region, 0.0, 1e6)[:, None]
    found = SmoothFields(plate, 0.05, 1.0, region).through(np.full((len(region), 1), 2.0), known, np.zeros(1))[:, 0]
    assert np.allclose(found[~region], 2.0, atol=1e-3) and np.allclose(found[region], 0.0, atol=1e-9)


def test_field_weighs_values_by_their_precision():
    """One vertex against the mean: the posterior mean of two normal distributions."""
    plate = grid_plane(2, 1.0)
    found = SmoothFields(plate, 0.05, 0.5).through(np.full((4, 1), 2.0), np.full((4, 1), 3.0), np.array([0.0]))
    assert np.allclose(found, 2.0 * 3.0 / (3.0 + 4.0), atol=1e-9)
