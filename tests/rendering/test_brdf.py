"""The reflectance model against its definition, identities of microfacet theory and brute-force integrals."""

import numpy as np
import pytest
import torch
from quadrature import hemisphere_quadrature

from shared.rendering.brdf import (
    F0,
    directional_albedo,
    ggx_distribution,
    hemispherical_albedo,
    microfacet_integrals,
    schlick_fresnel,
    smith_masking,
    specular_cosine,
)

ROUGHNESS = (0.25, 0.45, 0.7)


def direction(cosine, azimuth=0.0):
    """Unit vector at that cosine from +z."""
    sine = np.sqrt(1.0 - cosine**2)
    return np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])


def by_half_vector(o, i, roughness):
    """f cos_i written out with the half vector and the tangents of Walter's paper."""
    h = (o + i) / np.linalg.norm(o + i)
    alpha = roughness**2
    tan2 = (1.0 - h[2] ** 2) / h[2] ** 2
    distribution = alpha**2 / (np.pi * h[2] ** 4 * (alpha**2 + tan2) ** 2)
    masking = [2.0 / (1.0 + np.sqrt(1.0 + alpha**2 * (1.0 - v[2] ** 2) / v[2] ** 2)) for v in (o, i)]
    fresnel = 0.04 + 0.96 * (1.0 - o @ h) ** 5
    return distribution * masking[0] * masking[1] * fresnel / (4.0 * o[2] * i[2]) * i[2]


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_distribution_is_normalised_over_projected_half_vectors(roughness):
    directions, solid = hemisphere_quadrature(96, 4)
    cosine = directions[:, 2]
    assert (ggx_distribution(cosine, roughness) * cosine * solid).sum() == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize("cosine", [0.15, 0.5, 0.95])
def test_masking_leaves_exactly_the_projected_area(roughness, cosine):
    """Visible microfacets project to the macrosurface: integral G1(o) D(h) (o.h)+ dw_h = cos_o."""
    directions, solid = hemisphere_quadrature(96, 192)
    facing = np.maximum(directions @ direction(cosine), 0.0)
    area = (ggx_distribution(directions[:, 2], roughness) * facing * solid).sum() * smith_masking(cosine, roughness)
    assert area == pytest.approx(cosine, rel=2e-3)


def test_fresnel_ends():
    assert schlick_fresnel(1.0) == pytest.approx(F0)
    assert schlick_fresnel(0.0) == pytest.approx(1.0)


def test_the_model_is_the_paper_written_out():
    rng = np.random.default_rng(0)
    for _ in range(50):
        o, i = (direction(rng.uniform(0.05, 1.0), rng.uniform(0, 2 * np.pi)) for _ in range(2))
        roughness = rng.uniform(0.2, 0.9)
        assert specular_cosine(o[2], i[2], o @ i, roughness) == pytest.approx(by_half_vector(o, i, roughness), rel=1e-5)


def test_the_model_is_reciprocal():
    rng = np.random.default_rng(1)
    cos_o, cos_i = rng.uniform(0.02, 1.0, (2, 200))
    azimuth = rng.uniform(0, np.pi, 200)
    o_dot_i = cos_o * cos_i + np.sqrt((1 - cos_o**2) * (1 - cos_i**2)) * np.cos(azimuth)
    forth = specular_cosine(cos_o, cos_i, o_dot_i, 0.4) / cos_i
    back = specular_cosine(cos_i, cos_o, o_dot_i, 0.4) / cos_o
    assert np.allclose(forth, back, rtol=1e-9)
    assert (forth > 0).all()


def test_nothing_below_either_horizon():
    cosines = np.array([[-0.3, 0.5], [0.5, -0.3], [-0.2, -0.2], [0.0, 0.7]])
    assert np.array_equal(specular_cosine(cosines[:, 0], cosines[:, 1], np.full(4, 0.2), 0.4), np.zeros(4))


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_directional_albedo_is_the_integral_over_incoming_light(roughness):
    """Integrated over half vectors inside the module, over incoming directions here."""
    directions, solid = hemisphere_quadrature(96, 384)
    cosines = np.array([0.2, 0.6, 1.0])
    expected = [
        (specular_cosine(np.full(len(solid), c), directions[:, 2], directions @ direction(c), roughness) * solid).sum()
        for c in cosines
    ]
    assert np.allclose(directional_albedo(cosines, roughness), expected, rtol=0.01)


@pytest.mark.parametrize("roughness", [0.05, *ROUGHNESS, 1.0])
def test_the_lobe_returns_no_more_than_it_gets(roughness):
    cosines = np.linspace(0.02, 1.0, 20)
    albedo, scale, bias = microfacet_integrals(cosines, roughness)
    assert np.allclose(albedo, F0 * scale + bias)
    assert (scale + bias <= 1.0 + 1e-3).all() and (albedo > 0).all()


def test_a_smooth_surface_is_a_mirror_of_four_percent():
    albedo, scale, bias = microfacet_integrals(np.array([1.0]), 0.05)[:, 0]
    assert albedo == pytest.approx(F0, rel=1e-3)
    assert scale == pytest.approx(1.0, abs=1e-3) and bias == pytest.approx(0.0, abs=1e-4)


def test_hemispherical_albedo_is_the_cosine_weighted_mean():
    cosine = (np.arange(400) + 0.5) / 400
    expected = 2.0 * (cosine * directional_albedo(cosine, 0.45)).mean()
    assert hemispherical_albedo(0.45) == pytest.approx(expected, rel=1e-3)


def test_quadrature_integrates_polynomials_of_the_sphere():
    directions, solid = hemisphere_quadrature(16, 32)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0)
    assert solid.sum() == pytest.approx(2 * np.pi)
    assert (solid * directions[:, 2]).sum() == pytest.approx(np.pi)
    assert (solid * directions[:, 0] ** 2).sum() == pytest.approx(2 * np.pi / 3)


def test_torch_agrees_with_numpy_and_differentiates():
    arrays = np.array([[0.8, 0.3], [0.4, 0.6], [0.2, 0.5], [0.4, 0.3]])
    tensors = [torch.tensor(row, requires_grad=True) for row in arrays]
    assert np.allclose(specular_cosine(*tensors).detach().numpy(), specular_cosine(*arrays))
    assert torch.autograd.gradcheck(specular_cosine, tensors)
