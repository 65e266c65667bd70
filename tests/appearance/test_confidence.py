"""The confidence of texels: what the frames say, what they cannot resolve, what the model does not have."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from shapes import grid_plane

from shared.appearance.confidence import SURE, texel_confidence, unresolved_variance
from shared.appearance.texture import PRIOR_SPREAD, TexelMaterial
from shared.imaging.texels import TexelSurface

MAP, RESOLVED = 96, 1.5


@pytest.fixture(scope="module")
def surface():
    return TexelSurface(grid_plane(9, 80.0), MAP)


def material_of(surface, albedo, information=1e6, unmodelled=None):
    told = np.full(len(surface), information, np.float32)
    return TexelMaterial(albedo.astype(np.float32), np.zeros(len(surface), np.float32), told, unmodelled)


def grey(surface):
    return np.full((len(surface), 3), 0.3)


def speckled(surface, seed=0):
    """[T, 3] of log spread 0.5, alike from 2 to 8 texels and with little finer than the first; [T, 3] the same blurred
    by RESOLVED."""
    noise = np.random.default_rng(seed).normal(size=(3, MAP, MAP))
    texture = sum(layer / layer.std() for layer in (gaussian_filter(noise[k], 2.0 ** (k - 0.5)) for k in range(3)))
    truth = 0.3 * np.exp(0.5 * texture / texture.std())
    return [np.repeat(image.ravel()[surface.pixel, None], 3, 1) for image in (truth, gaussian_filter(truth, RESOLVED))]


def test_frames_that_say_as_little_as_the_prior_make_a_half(surface):
    half = texel_confidence(surface, material_of(surface, grey(surface), PRIOR_SPREAD**-2), RESOLVED)
    np.testing.assert_allclose(half, 0.5, atol=1e-6)
    assert texel_confidence(surface, material_of(surface, grey(surface), 0.0), RESOLVED).max() < 1e-6
    assert texel_confidence(surface, material_of(surface, grey(surface)), RESOLVED).min() > 0.99


def test_what_the_model_does_not_have_counts_however_well_frames_agree(surface):
    unmodelled = np.full(len(surface), (PRIOR_SPREAD / SURE) ** 2)
    found = texel_confidence(surface, material_of(surface, grey(surface), 1e9, unmodelled), RESOLVED)
    np.testing.assert_allclose(found, 0.5, atol=1e-5)


def test_detail_that_pictures_blur_is_not_trusted(surface):
    """Half of the plate is speckled: its texels are off, and the map knows by about how much, from itself alone."""
    truth, found = speckled(surface)
    left = surface.pixel % MAP < MAP // 2
    truth, found = (np.where(left[:, None], image, 0.3) for image in (truth, found))
    error = np.log(found / truth)[:, 0]
    deviation = np.sqrt(unresolved_variance(surface, found, RESOLVED))
    inner, smooth = surface.pixel % MAP < MAP // 2 - 8, surface.pixel % MAP > MAP // 2 + 8
    assert 0.5 < np.sqrt(np.mean(deviation[inner] ** 2)) / error[inner].std() < 2.0
    assert deviation[smooth].max() < 1e-3
    confidence = texel_confidence(surface, material_of(surface, found), RESOLVED)
    assert np.median(confidence[inner]) < 0.5 < 0.99 < confidence[smooth].min()
    everything = texel_confidence(surface, material_of(surface, found), 0.0)
    assert everything.min() > 0.99, "pictures that resolve everything blur nothing"
