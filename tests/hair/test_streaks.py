"""Streaks that go on where no frame looks."""

import numpy as np

from shared.hair.streaks import with_streaks

SIZE = 160
STRANDS = np.exp(0.3 * np.cos(2 * np.pi * np.arange(SIZE) / 8.0))[None, :, None] * np.full((SIZE, 1, 3), 0.2)


def test_unseen_hair_has_the_streaks_of_what_is_seen():
    """Vertical strands on the middle half: the rest has strands as strong, in the same direction."""
    seen = np.zeros((SIZE, SIZE), bool)
    seen[:, 40:120] = True
    albedo = np.where(seen[..., None], STRANDS, 0.2)
    found = np.log(with_streaks(albedo, seen))
    assert np.allclose(found[seen], np.log(albedo[seen]), atol=1e-6), "what is seen stays"
    own, unseen = found[40:120, 60:100].std(1).mean(), found[40:120, :24].std(1).mean()
    assert unseen > 0.7 * own
    assert found[40:120, :24].std(0).mean() < 0.1 * unseen, "along a strand nothing changes"


def test_smooth_colours_stay():
    ramp = np.linspace(0.1, 0.3, SIZE)[:, None, None] * np.ones((1, SIZE, 3))
    seen = np.zeros((SIZE, SIZE), bool)
    seen[:, 40:120] = True
    assert np.abs(with_streaks(ramp, seen) / ramp - 1.0).max() < 0.06


def test_without_a_look_nothing_changes():
    albedo = STRANDS.astype(np.float32)
    assert np.array_equal(with_streaks(albedo, np.zeros((SIZE, SIZE), bool)), albedo)
    assert np.array_equal(with_streaks(albedo, np.ones((SIZE, SIZE), bool)), albedo)
