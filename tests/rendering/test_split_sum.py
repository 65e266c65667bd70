"""The split sum for narrow lobes: V~, energy, and both ways of making a lobe against brute-force integrals."""

import numpy as np
import pytest
from quadrature import hemisphere_quadrature

from shared.geometry.mesh import normalised
from shared.geometry.transforms import fibonacci_sphere
from shared.rendering.brdf import directional_albedo, microfacet_integrals, specular_cosine
from shared.rendering.direction_set import widest_spacing
from shared.rendering.lobes import SpecularTransfer, specular_reflection
from shared.rendering.split_sum import SplitSum, frames_about, narrowest_roughness, sample_half_vectors

DIRECTIONS = fibonacci_sphere(768)
SPACING = widest_spacing(DIRECTIONS)
UP = np.array([0.0, 0.0, 1.0])
COSINES = np.array([0.35, 0.5, 0.8, 1.0])
TOWARDS = np.stack([np.sqrt(1 - COSINES**2), 0 * COSINES, COSINES], axis=1)
ROUGHNESSES = (0.1, 0.2, 0.3, 0.5, 0.7, 0.9)


def occluder(directions):
    """[M, 3] -> [M] bool: a wall takes away the side x < -0.3."""
    return directions[:, 0] > -0.3


def sky(directions):
    """[M, 3] -> [M]: a broad lamp on a gradient."""
    lamp = np.exp(6.0 * (directions @ normalised(np.array([-0.6, 0.2, 0.7])) - 1.0))
    return 0.5 + 0.3 * directions[:, 2] + 3.0 * lamp


def brute_force(roughness, covered):
    """The integral of the lobe over light and visibility, in half vectors so that narrow lobes are resolved."""
    half, solid = hemisphere_quadrature(1600, 256) if roughness < 0.25 else hemisphere_quadrature(300, 256)
    values = []
    for o in TOWARDS:
        o_dot_h = half @ o
        incoming = 2.0 * o_dot_h[:, None] * half - o
        seen = (o_dot_h > 0) & (incoming[:, 2] > 0) & (occluder(incoming) if covered else True)
        lobe = specular_cosine(np.full(len(half), o[2]), incoming[:, 2], incoming @ o, roughness)
        values.append((np.where(seen, lobe * 4.0 * o_dot_h * sky(incoming), 0.0) * solid).sum())
    return np.array(values)


def both_ways(roughness, covered):
    """Reflection [4] by the split sum and by the sum over directions."""
    visible = np.tile(occluder(DIRECTIONS) if covered else np.ones(768, bool), (4, 1)) & (DIRECTIONS[:, 2] > 0)
    found = []
    for narrowest in (1.0, 0.0):
        table = SpecularTransfer(np.tile(UP, (4, 1)), visible, DIRECTIONS)
        table.narrowest = narrowest
        found.append(specular_reflection(table, TOWARDS, roughness, sky(DIRECTIONS)[:, None])[:, 0])
    return found


@pytest.mark.parametrize("roughness", ROUGHNESSES)
def test_an_open_point_sees_everything(roughness):
    """V~ = 1 at every roughness and angle, horizon included."""
    visible = np.tile(DIRECTIONS[:, 2] > 0, (4, 1))
    assert np.all(SplitSum(DIRECTIONS).visible_share(np.tile(UP, (4, 1)), TOWARDS, roughness, visible) == 1.0)


def test_a_mirror_sees_or_does_not_and_a_rough_surface_sees_a_share():
    split, normals = SplitSum(DIRECTIONS), np.tile(UP, (4, 1))
    visible = np.tile(occluder(DIRECTIONS), (4, 1)) & (DIRECTIONS[:, 2] > 0)
    mirror = split.visible_share(normals, TOWARDS, 0.05, visible)
    assert np.array_equal(mirror, (-TOWARDS[:, 0] > -0.3).astype(float))
    rough = split.visible_share(normals, TOWARDS, 0.9, visible)
    assert ((rough > 0.2) & (rough < 0.9)).all() and rough[3] > rough[0]


@pytest.mark.parametrize("roughness", ROUGHNESSES)
def test_white_light_returns_the_directional_albedo(roughness):
    every, _ = SplitSum(DIRECTIONS).prefilter(TOWARDS, roughness), None
    assert np.allclose(every.sum(1), 1.0)
    table = SpecularTransfer(np.tile(UP, (4, 1)), np.ones((4, 768), bool), DIRECTIONS)
    table.narrowest = 1.0
    found = specular_reflection(table, TOWARDS, roughness, np.ones((768, 1)))[:, 0]
    assert np.allclose(found, directional_albedo(COSINES, roughness), rtol=0.01)
    scale, bias = microfacet_integrals(COSINES, roughness)[1:]
    assert np.allclose(found, 0.04 * scale + bias, rtol=0.01)


@pytest.mark.parametrize("covered", [False, True], ids=["open", "covered"])
@pytest.mark.parametrize("roughness", ROUGHNESSES)
def test_the_way_that_is_chosen_is_near_the_integral(roughness, covered):
    """Open surfaces to 6 %; beside an occluder, where averaging apart costs the split sum most, to 15 % of the open."""
    expected, scale = brute_force(roughness, covered), brute_force(roughness, False)
    by_split, by_sum = both_ways(roughness, covered)
    chosen = by_split if roughness < narrowest_roughness(SPACING) else by_sum
    assert (np.abs(chosen - expected) / scale).max() < (0.15 if covered else 0.06)


def test_each_way_is_the_better_one_on_its_side():
    """The sum over directions misses a lobe of roughness 0.1 and is exact for a rough one, where the split sum errs."""
    narrow, wide = brute_force(0.1, False), brute_force(0.7, True)
    split_narrow, sum_narrow = both_ways(0.1, False)
    split_wide, sum_wide = both_ways(0.7, True)
    assert np.abs(split_narrow / narrow - 1).max() < 0.05 < np.abs(sum_narrow / narrow - 1).max()
    assert np.abs(sum_wide / wide - 1).max() < 0.03 < np.abs(split_wide / wide - 1).max()
    assert narrowest_roughness(SPACING) == pytest.approx(0.25, abs=0.01)
    assert narrowest_roughness(0.5 * SPACING) < narrowest_roughness(SPACING)


def test_half_vectors_follow_the_distribution():
    """Mean of any function over the samples is its integral against D n.h."""
    for roughness in (0.2, 0.6):
        half, solid = hemisphere_quadrature(800, 4)
        alpha2 = roughness**4
        density = alpha2 / (np.pi * (half[:, 2] ** 2 * (alpha2 - 1) + 1) ** 2) * half[:, 2]
        expected = (density * half[:, 2] ** 3 * solid).sum()
        assert (sample_half_vectors(roughness, 512)[:, 2] ** 3).mean() == pytest.approx(expected, rel=5e-3)


def test_frames_are_right_handed_about_their_axis():
    axes = normalised(np.random.default_rng(2).normal(size=(50, 3)))
    frames = frames_about(axes)
    assert np.allclose(frames @ frames.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(frames), 1.0) and np.allclose(frames[:, 2], axes)
