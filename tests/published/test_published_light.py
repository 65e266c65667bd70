"""The reference solver's cubemap against the one of shared.rendering.envmap, brute-force integrals and finite
differences."""

import numpy as np
import pytest
import torch

from shared.geometry.transforms import fibonacci_sphere
from shared.published.light import CubeSampler, LightSampling, PrefilteredLight, lobe_filter, split_sum_energy
from shared.rendering.brdf import F0, microfacet_integrals
from shared.rendering.envmap import cube_directions, cube_lookup, cube_solid_angles
from shared.rendering.split_sum import SplitSum

DIRECTIONS = fibonacci_sphere(500)


def lamp(directions, sharpness=12.0):
    """[M, 3] -> [M, 3]: a soft lamp on a dim sky, another colour each channel."""
    lobe = np.exp(sharpness * (directions @ np.array([0.48, 0.36, 0.8]) - 1.0))
    return np.stack([0.1 + 5.0 * lobe, 0.2 + 3.0 * lobe, 0.3 + lobe + 0.1 * directions[:, 1]], axis=1)


def torch_light(resolution):
    return torch.from_numpy(lamp(cube_directions(resolution)))


def test_look_ups_are_those_of_the_environment_map():
    light = torch_light(8)
    expected = cube_lookup(DIRECTIONS, 8) @ light.numpy()
    found = CubeSampler(8)(light, torch.from_numpy(DIRECTIONS)).numpy()
    corner = np.sort(np.abs(DIRECTIONS), axis=1)[:, 0] > 0.87 * np.abs(DIRECTIONS).max(1)
    assert np.allclose(found[~corner], expected[~corner], atol=1e-9)
    assert np.allclose(found, expected, rtol=0.1)


def test_look_ups_have_derivatives():
    light = torch_light(4).requires_grad_()
    directions = torch.nn.functional.normalize(
        torch.tensor([[0.3, 0.2, 0.9], [-0.7, 0.1, 0.3]], dtype=torch.float64), dim=1
    )
    sampler = CubeSampler(4)
    assert torch.autograd.gradcheck(lambda x, d: sampler(x, d), (light, directions.requires_grad_()))
    assert torch.autograd.gradcheck(lambda x: sampler.fixed(x, directions.detach()), (light,))


def test_samples_follow_their_density():
    """Mean of f / p over the samples is the integral of f, and the density integrates to one."""
    light = torch_light(16)
    sampler = LightSampling(light)
    random = torch.rand((200_000, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    directions = sampler.sample(random)
    assert torch.allclose(directions.norm(dim=1), torch.ones(1, dtype=torch.float64))
    density = sampler.density(directions)
    assert (1.0 / density).mean() == pytest.approx(4.0 * np.pi, rel=0.02)
    cosine = directions.numpy() @ [0.0, 0.6, 0.8]
    found = (lamp(directions.numpy()) * np.maximum(cosine, 0)[:, None] / density.numpy()[:, None]).mean(0)
    texels, solid = cube_directions(64), cube_solid_angles(64)
    expected = (lamp(texels) * (np.maximum(texels @ [0.0, 0.6, 0.8], 0) * solid)[:, None]).sum(0)
    assert np.allclose(found, expected, rtol=0.01)


def test_mips_have_the_published_edges_and_roughness():
    light = PrefilteredLight(256 // 4, 8)
    assert light.edges == [64, 32, 16, 8]
    assert light.roughness[0] == 0.08 and light.roughness[-2:] == [0.5, 1.0]
    levels = light.mips(torch.ones((6 * 64**2, 3)))
    assert [len(level) for level in levels] == [6 * edge**2 for edge in light.edges]
    assert all(torch.allclose(level, torch.ones(1)) for level in levels)


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
def test_filters_are_the_lobe(roughness):
    """Against the same lobe by the split sum of the transfer solver, on a fine set of directions."""
    rows = lobe_filter(32, roughness)
    assert np.allclose(np.asarray(rows.sum(1)).ravel(), 1.0, atol=1e-5)
    found = rows @ lamp(cube_directions(32))
    fine = fibonacci_sphere(6144)
    chosen = np.arange(0, 6 * 32**2, 97)
    expected = SplitSum(fine).prefilter(cube_directions(32)[chosen], roughness) @ lamp(fine)
    assert np.allclose(found[chosen], expected, rtol=0.05)


def test_reflection_lies_between_the_levels_and_has_derivatives():
    light = PrefilteredLight(16, 4, dtype=torch.float64)
    radiance = torch_light(16).requires_grad_()
    directions = torch.from_numpy(DIRECTIONS[:6]).requires_grad_()
    roughness = torch.tensor([0.1, 0.15, 0.3, 0.45, 0.62, 0.97], dtype=torch.float64, requires_grad=True)

    weights = torch.rand((6, 3), generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def reflect(radiance, directions, roughness):
        return light.reflection(light.mips(radiance), directions, roughness)

    leaves = [radiance, directions, roughness]
    (weights * reflect(*leaves)).sum().backward()
    texels, places, rough = [(700, 1), (1200, 2)], [(i, i % 3) for i in range(6)], [(i,) for i in range(6)]
    for k, index in [*((0, t) for t in texels), *((1, p) for p in places), *((2, r) for r in rough)]:
        values = []
        for sign in (1.0, -1.0):
            moved = [leaf.detach().clone() for leaf in leaves]
            moved[k][index] += sign * 1e-6
            values.append(float((weights * reflect(*moved)).sum()))
        expected = (values[0] - values[1]) / 2e-6
        assert float(leaves[k].grad[index]) == pytest.approx(expected, rel=1e-4, abs=1e-8)
    white = reflect(torch.ones_like(radiance), directions, roughness)
    assert torch.allclose(white, torch.ones_like(white), atol=1e-5)


def test_irradiance_without_visibility_is_the_cosine_integral():
    light = PrefilteredLight(32, 8, dtype=torch.float64)
    normals = torch.from_numpy(DIRECTIONS[::9].copy())
    found = light.irradiance(light.mips(torch_light(32)), normals).numpy()
    texels, solid = cube_directions(64), cube_solid_angles(64)
    expected = np.maximum(normals.numpy() @ texels.T, 0) @ (lamp(texels) * solid[:, None]) / np.pi
    assert np.allclose(found, expected, rtol=0.02, atol=0.01 * expected.max())


def test_energy_is_the_split_sums():
    cosine, roughness = np.array([0.2, 0.5, 0.95]), np.array([0.15, 0.4, 0.8])
    found = split_sum_energy(torch.from_numpy(cosine), torch.from_numpy(roughness), F0).numpy()
    expected = [microfacet_integrals(c, r)[0, 0] for c, r in zip(cosine, roughness, strict=True)]
    assert np.allclose(found, expected, rtol=0.02)
