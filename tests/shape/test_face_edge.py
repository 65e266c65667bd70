"""Steps of colour across an outline: found to a fifth of a pixel, and not where another edge is the stronger one."""

import numpy as np
import pytest
from scipy.special import ndtr

from shared.imaging.color import decode_srgb, encode_srgb
from shared.shape.face_edge import LEAST_CONTRAST, face_edges

SKIN, HAIR, WALL = np.array([0.8, 0.6, 0.5]), np.array([0.25, 0.2, 0.15]), np.array([0.55, 0.75, 0.9])
SIZE, BLUR_PX, REACH_PX = 80, 0.8, 8.0


def stripes(angle, *ends):
    """[H, W, 3] float32 codes of stripes across a direction, blurred as a lens does: colours as codes, each with the
    place [px] where it begins."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    along = (x - SIZE / 2) * np.cos(angle) + (y - SIZE / 2) * np.sin(angle)
    linear = np.broadcast_to(decode_srgb(ends[0][1]), (SIZE, SIZE, 3)).astype(np.float64)
    for (_, before), (place, after) in zip(ends, ends[1:], strict=False):
        linear = linear + ndtr((along - place) / BLUR_PX)[..., None] * (decode_srgb(after) - decode_srgb(before))
    return encode_srgb(linear).astype(np.float32)


def edge(picture, angle, reach_px=REACH_PX):
    """Of a profile through the picture's middle."""
    outward = np.array([[np.cos(angle), np.sin(angle)]])
    return face_edges(picture, np.full((1, 2), SIZE / 2), outward, np.array([reach_px]), SKIN)[0]


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.4])
@pytest.mark.parametrize("place", [-4.3, -0.25, 0.0, 1.6, 5.1])
def test_place_of_a_blurred_step(angle, place):
    assert edge(stripes(angle, (None, SKIN), (place, HAIR)), angle) == pytest.approx(place, abs=0.2)


def test_the_face_ends_at_its_own_edge_and_not_at_a_stronger_one_behind():
    """Hair of 3 px before a wall: from hair to wall it is the larger step."""
    picture = stripes(0.0, (None, SKIN), (1.0, HAIR), (5.0, WALL))
    assert np.linalg.norm(WALL - HAIR) > np.linalg.norm(SKIN - HAIR)
    assert edge(picture, 0.0) == pytest.approx(1.0, abs=0.2)


def test_no_step_no_edge():
    assert np.isnan(edge(stripes(0.0, (None, SKIN)), 0.0))


def test_a_weak_step_is_none():
    share = LEAST_CONTRAST / np.linalg.norm(SKIN)
    for times, found in ((0.9, False), (1.2, True)):
        place = edge(stripes(0.0, (None, SKIN), (1.0, (1.0 - times * share) * SKIN)), 0.0)
        assert place == pytest.approx(1.0, abs=0.1) if found else np.isnan(place)


def test_a_step_out_of_reach_is_none():
    picture = stripes(0.0, (None, SKIN), (5.0, HAIR))
    assert np.isnan(edge(picture, 0.0, reach_px=1.0))


def test_a_beard_ends_somewhere_else():
    assert np.isnan(edge(stripes(0.0, (None, HAIR), (1.0, WALL)), 0.0))


def test_stubble_is_no_edge():
    """Where colours vary on both sides as much as from side to side, mostly no step is clear."""
    found = 0
    for seed in range(40):
        brightness = np.random.default_rng(seed).uniform(0.7, 1.0, 40)
        dots = [(None, SKIN)] + [(k - 20.0, brightness[k] * SKIN) for k in range(40)]
        found += np.isfinite(edge(stripes(0.0, *dots), 0.0))
    assert found < 10
