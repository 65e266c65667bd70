"""The matte of discs whose coverage is known, and colours continued."""

import cv2
import numpy as np
import pytest

from shared.imaging.matte import continued, person_matte, unsure_px

SIZE = (200, 240)
SKIN, WALL = np.float32([0.5, 0.3, 0.2]), np.float32([0.1, 0.2, 0.4])


def disc(radius, middle=(120.3, 97.6)):
    """float32 [H, W]: coverage of a disc, from 8 x 8 samples a pixel."""
    rows, columns = ((np.arange(8 * side) + 0.5) / 8 for side in SIZE)
    inside = (columns - middle[0]) ** 2 + (rows[:, None] - middle[1]) ** 2 < radius**2
    return inside.reshape(SIZE[0], 8, SIZE[1], 8).mean((1, 3)).astype(np.float32)


def picture(share, noise=0.0):
    clean = share[..., None] * SKIN + (1.0 - share[..., None]) * WALL
    return (clean + noise * np.random.default_rng(3).normal(size=clean.shape)).astype(np.float32)


def near_border(share):
    ring = cv2.dilate(((share > 0.0) & (share < 1.0)).astype(np.uint8), np.ones((9, 9), np.uint8))
    return ring > 0


@pytest.mark.parametrize(("blur", "off_px"), [(0.0, 0), (1.2, 0), (0.0, 1), (0.0, -1)])
def test_share_of_a_disc(blur, off_px):
    """Of a mask that is a pixel too wide or too narrow as well, and where the lens is soft."""
    share = disc(60.0)
    share = cv2.GaussianBlur(share, (0, 0), blur) if blur else share
    found = person_matte(picture(share), disc(60.0 + off_px) > 0.5)
    assert np.abs(found - share)[near_border(share)].mean() < 0.01
    assert np.abs(found - share).max() < 0.1


def test_noise_costs_little():
    share = disc(60.0)
    found = person_matte(picture(share, noise=0.01), share > 0.5)
    assert np.abs(found - share)[near_border(share)].mean() < 0.02


def test_where_both_sides_look_alike_the_mask_remains():
    mask = disc(60.0) > 0.5
    found = person_matte(np.full((*SIZE, 3), 0.3, np.float32), mask)
    np.testing.assert_array_equal(found > 0.5, mask)
    far = cv2.dilate(mask.astype(np.uint8), np.ones((15, 15), np.uint8)) == 0
    assert found[far].max() == 0.0 and found.dtype == np.float32


@pytest.mark.parametrize("everywhere", [True, False])
def test_a_mask_without_a_border(everywhere):
    found = person_matte(picture(disc(60.0)), np.full(SIZE, everywhere))
    np.testing.assert_array_equal(found, np.full(SIZE, everywhere, np.float32))


def test_one_colour_goes_on_as_it_is_and_what_is_known_stays():
    known, rgb = disc(60.0) < 0.5, picture(disc(60.0))
    found = continued(rgb, known)
    np.testing.assert_array_equal(found[known], rgb[known])
    outside = np.where(known[..., None], WALL, np.float32([9.0, 9.0, 9.0]))
    np.testing.assert_allclose(continued(outside, known), np.broadcast_to(WALL, rgb.shape), atol=1e-5)


def test_a_slope_goes_on_across_a_gap():
    slope = np.repeat(np.linspace(0.0, 1.0, SIZE[1], dtype=np.float32)[None, :, None], SIZE[0], 0) * SKIN
    known = np.ones(SIZE, bool)
    known[:, 110:122] = False
    assert np.abs(continued(slope, known) - slope).max() < 0.012
    assert continued(slope, np.zeros(SIZE, bool)).max() == 0.0


def test_the_unsure_band_grows_with_the_picture():
    assert unsure_px((100, 120)) == 2 and unsure_px((900, 1200)) == 6
