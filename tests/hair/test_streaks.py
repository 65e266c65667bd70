"""Streaks that go on where no frame looks."""

import numpy as np
import pytest

from shared.hair.streaks import with_streaks

SIZE = 160
STRANDS = np.exp(0.3 * np.cos(2 * np.pi * np.arange(SIZE) / 5.0))[None, :, None] * np.full((SIZE, 1, 3), 0.2)


def test_unseen_hair_has_the_streaks_of_what_is_seen():
    """Vertical strands on the middle half: the rest has some about as strong, in the same direction."""
    seen = np.zeros((SIZE, SIZE), bool)
    seen[:, 40:120] = True
    albedo = np.where(seen[..., None], STRANDS, 0.2)
    found = np.log(with_streaks(albedo, seen))
    assert np.allclose(found[seen], np.log(albedo[seen]), atol=1e-6), "what is seen stays"
    beside = np.concatenate([found[:, 126:], found[:, :34]], axis=1)
    assert beside.std() == pytest.approx(found[:, 60:100].std(), rel=0.3)
    across, along = (np.diff(beside[..., 0], axis=axis).std() for axis in (1, 0))
    assert along < 0.2 * across, "along a strand little changes"


def test_smooth_colours_stay():
    ramp = np.linspace(0.1, 0.3, SIZE)[:, None, None] * np.ones((1, SIZE, 3))
    seen = np.zeros((SIZE, SIZE), bool)
    seen[:, 40:120] = True
    assert np.abs(with_streaks(ramp, seen) / ramp - 1.0).max() < 0.03


def test_no_albedo_gets_larger_than_one():
    """White hair whose strands differ a lot."""
    seen = np.zeros((SIZE, SIZE), bool)
    seen[:, 40:120] = True
    white = np.minimum(4.0 * STRANDS, 1.0)
    assert with_streaks(np.where(seen[..., None], white, 0.95), seen).max() <= 1.0


def test_without_a_look_nothing_changes():
    albedo = STRANDS.astype(np.float32)
    assert np.array_equal(with_streaks(albedo, np.zeros((SIZE, SIZE), bool)), albedo)
    assert np.array_equal(with_streaks(albedo, np.ones((SIZE, SIZE), bool)), albedo)
