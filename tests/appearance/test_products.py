"""Products with lobe tables, and the tables' derivatives, against plain sums."""

import numpy as np
import pytest
import torch

from shared.appearance.products import per_channel, per_channel_transposed, reflect, reflect_transposed
from shared.geometry.mesh import normalised
from shared.geometry.transforms import fibonacci_sphere
from shared.rendering.lobes import SpecularTransfer, specular_reflection
from shared.rendering.specular_transfer import specular_slopes, specular_tables

RNG = np.random.default_rng(3)
POINTS, FRAMES, DIRECTIONS = 37, 5, 52


def some(*shape):
    return torch.from_numpy(RNG.normal(size=shape).astype(np.float32))


@pytest.mark.parametrize("threads", [1, 2])
def test_products_are_sums(threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        lobes, along, values = some(FRAMES, POINTS, DIRECTIONS).to(torch.bfloat16), some(DIRECTIONS, FRAMES, 3), \
            some(3, POINTS, FRAMES)
        values[:, ::3] = 0.0
        expected = torch.einsum("fpj,jfc->cpf", lobes.float(), along)
        assert torch.allclose(reflect(lobes, along), expected, atol=1e-4)
        expected = torch.einsum("fpj,cpf->jfc", lobes.float(), values)
        assert torch.allclose(reflect_transposed(lobes, values), expected, atol=1e-4)
        table, light = some(3, POINTS, DIRECTIONS), some(3, DIRECTIONS, FRAMES)
        assert torch.allclose(per_channel(table, light), torch.bmm(table, light), atol=1e-4)
        expected = torch.bmm(table.transpose(1, 2), values)
        assert torch.allclose(per_channel_transposed(table, values), expected, atol=1e-4)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("roughness", [0.15, 0.4])
def test_slopes_are_the_derivative_by_the_log_roughness(roughness):
    """Of narrow lobes, through the split sum, and of wide ones; where half of the sphere is blocked, too."""
    directions = fibonacci_sphere(768)
    normals = normalised(RNG.normal(size=(20, 3)) + [0.0, 0.0, 3.0])
    towards = normalised(normals + 0.4 * RNG.normal(size=(20, 3)))
    visible = np.tile(directions[:, 0] > 0, (20, 1))
    table = SpecularTransfer(normals, visible, directions)
    assert table.resolves(roughness) == (roughness > 0.25)
    light = (1.0 + directions @ [0.3, 0.2, 0.5])[:, None] * np.array([1.0, 0.8, 0.6])
    slopes, blocked = specular_slopes(table, towards[:, None], roughness)
    found = reflect(slopes, torch.from_numpy(np.repeat(light[:, None], 1, axis=1).astype(np.float32)))[:, :, 0].T
    # Both ends by the same way of weighing: the step stays on one side of where they change over.
    step = 0.05
    ends = [specular_reflection(table, towards, roughness * np.exp(side * step), light) for side in (-1, 1)]
    expected = (ends[1] - ends[0]) / (2.0 * step)
    assert np.allclose(found.numpy(), expected, atol=0.02 * np.abs(expected).max())
    blocked_ends = [specular_tables(table, towards[:, None], roughness * np.exp(side * step))[1] for side in (-1, 1)]
    assert np.allclose(blocked, (blocked_ends[1] - blocked_ends[0]) / (2.0 * step), atol=1e-3)
