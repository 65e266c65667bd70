"""Directions that light is summed along: what a split set keeps, and what it gains under a small lamp."""

import numpy as np
import pytest

from shared.geometry.transforms import fibonacci_sphere, rotation_from_vector
from shared.rendering.direction_set import (
    PARTS,
    concentrated,
    solid_angles,
    split_directions,
    widest_spacing,
)
from shared.rendering.lobes import SpecularTransfer, specular_reflection

EVEN = fibonacci_sphere(768)
AXIS = np.array([0.36, 0.48, 0.8])
TURNS = rotation_from_vector(np.linspace(-0.2, 0.2, 21)[:, None] * [0.0, 1.0, 0.0])
LAMP_RAD = 0.05


def near_lamp():
    """[768] bool: what the lamp passes over."""
    return (EVEN @ (TURNS @ AXIS).T > np.cos(3.0 * LAMP_RAD + widest_spacing(EVEN))).any(1)


def lit_by_lamp(directions, axis):
    """Radiance [J] of a lamp of 1 W / m^2 about axis, with a rim as soft as the light's texels give it."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.exp((unit @ axis - 1.0) / LAMP_RAD**2) / (2.0 * np.pi * LAMP_RAD**2)


def test_a_split_set_covers_the_sphere_once():
    chosen = near_lamp()
    split = split_directions(EVEN, chosen)
    assert solid_angles(split).sum() == pytest.approx(4.0 * np.pi)
    assert np.abs(split.sum(0)).max() < 1e-3 * len(split)  # of an even light nothing arrives on balance
    assert (PARTS - 2) * chosen.sum() < len(split) - (~chosen).sum() < (PARTS + 2) * chosen.sum()
    assert widest_spacing(split) == pytest.approx(widest_spacing(EVEN))


def test_an_even_set_is_left_as_it_is():
    assert split_directions(EVEN, np.zeros(768, bool)) is EVEN


@pytest.mark.parametrize("split, error", [(True, (0.0, 0.03)), (False, (0.1, 9.0))])
def test_a_small_lamp_keeps_its_strength_as_the_head_turns(split, error):
    directions = split_directions(EVEN, near_lamp()) if split else EVEN
    normal = AXIS
    found = []
    for turn in TURNS:
        radiance = lit_by_lamp(directions, turn @ AXIS)
        found.append(4.0 * np.pi / len(directions) * radiance @ np.maximum(directions @ normal, 0.0))
    expected = (TURNS @ AXIS) @ normal  # of a far lamp, by its cosine
    worst = np.abs(np.array(found) / expected - 1.0).max()
    assert error[0] <= worst <= error[1]


def test_lobes_weigh_directions_by_their_solid_angle():
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8]])
    towards = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    seen = []
    for directions in (EVEN, split_directions(EVEN, near_lamp())):
        table = SpecularTransfer(normals, np.ones((2, len(directions)), bool), directions)
        assert table.narrowest == pytest.approx(0.25, abs=0.01)
        seen.append([specular_reflection(table, towards, roughness, np.ones((len(directions), 1)))
                     for roughness in (0.15, 0.45)])
    assert np.allclose(seen[0], seen[1], rtol=0.02)


def test_a_lamp_is_told_from_a_room():
    room = 1.0 + 2.0 * np.exp(8.0 * (EVEN @ AXIS - 1.0))
    lamp = 30.0 * np.exp(400.0 * (EVEN @ AXIS - 1.0))
    frames = np.stack([room, room + lamp], axis=1)[..., None]
    assert not concentrated(frames[:, :1]).any()
    chosen = concentrated(frames)
    assert 0 < chosen.sum() < 20
    assert (EVEN[chosen] @ AXIS).min() > np.cos(np.radians(15.0))
