"""A disc for a head, on a wall of one colour: alpha, composite and what is left of the old head, in closed form."""

import numpy as np
import pytest
from shapes import FACING, sphere

from shared.geometry.transforms import rigid
from shared.imaging.image_sampling import SurfaceViewer
from shared.rendering.compositing import LEAST_AGREED, STRIP_SHARE, head_layers, over
from shared.rendering.render import head_coverage

SIZE = (300, 320)
OLD, NEW = np.float32([0.5, 0.3, 0.2]), np.float32([0.05, 0.6, 0.1])
WALL, CLOTH = np.float32([0.1, 0.2, 0.4]), np.float32([0.3, 0.3, 0.3])
STRIP = round(STRIP_SHARE * SIZE[1])


def disc(radius, middle=(160.2, 120.7)):
    """float64 [H, W]: coverage of a disc, from 8 x 8 samples a pixel."""
    rows, columns = ((np.arange(8 * side) + 0.5) / 8 for side in SIZE)
    inside = (columns - middle[0]) ** 2 + (rows[:, None] - middle[1]) ** 2 < radius**2
    return inside.reshape(SIZE[0], 8, SIZE[1], 8).mean((1, 3))


def mixed(share, colour):
    return (share[..., None] * colour + (1.0 - share[..., None]) * WALL).astype(np.float32)


def render(coverage, colour):
    """Not darkened where the head covers a pixel in part."""
    return np.where(coverage[..., None] > 0.0, colour, 0.0).astype(np.float32)


@pytest.mark.parametrize("colour", [OLD, NEW])
def test_a_head_where_the_old_one_was(colour):
    """The same head gives the frame; one of another colour leaves nothing of the old one, and no rim."""
    share = disc(80.0)
    layers = head_layers(mixed(share, OLD), share > 0.5, share)
    assert layers.agreed > 0.99
    assert np.abs(layers.alpha - share).max() < 0.2 and np.abs(layers.alpha - share).mean() < 1e-3
    found = layers.composite(render(share, colour))
    assert np.abs(found - mixed(share, colour)).max() < 0.06
    np.testing.assert_array_equal(found[layers.alpha == 1.0], np.broadcast_to(colour, found.shape)[layers.alpha == 1.0])
    untouched = (layers.alpha == 0.0) & (layers.patch[..., 3] == 0.0)
    assert untouched.mean() > 0.7
    np.testing.assert_array_equal(found[untouched], mixed(share, OLD)[untouched])


def test_what_is_handed_over_is_what_is_shown():
    """Premultiplied colours over the patch over the frame are the composite."""
    share = disc(80.0)
    layers = head_layers(mixed(share, OLD), share > 0.5, share)
    picture, layer = render(share, NEW), layers.premultiplied(render(share, NEW))
    some = layer[..., 3] > 0.0
    np.testing.assert_allclose(layer[some][:, :3], layer[some][:, 3:] * NEW, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(layer[..., 3], layers.alpha)
    np.testing.assert_array_equal(over(layer, over(layers.patch, layers.frame)), layers.composite(picture))
    assert (layers.patch[..., :3] <= layers.patch[..., 3:] + 1e-6).all()


@pytest.mark.parametrize("narrower_px", [2, STRIP - 2])
def test_a_head_that_is_narrower_shows_the_wall_beside_it(narrower_px):
    share, coverage = disc(80.0), disc(80.0 - narrower_px)
    layers = head_layers(mixed(share, OLD), share > 0.5, coverage)
    found = layers.composite(render(coverage, NEW))
    assert np.abs(found - mixed(coverage, NEW)).max() < 0.06


def test_a_head_that_is_wider_ends_where_the_person_does():
    share, coverage = disc(80.0), disc(80.0 + STRIP - 3)
    layers = head_layers(mixed(share, OLD), share > 0.5, coverage)
    assert np.abs(layers.composite(render(coverage, NEW)) - mixed(share, NEW)).max() < 0.06


def test_the_body_stays_as_filmed_and_the_head_fades_into_it():
    head, frame, person = disc(80.0), mixed(disc(80.0), OLD), disc(80.0) > 0.5
    person[150:], frame[150:] = True, CLOTH
    layers = head_layers(frame, person, head)
    found = layers.composite(render(head, NEW))
    below = slice(210, None)
    np.testing.assert_array_equal(found[below], frame[below])
    column = layers.alpha[120:215, 160]
    assert column[0] == 1.0 and column[-1] == 0.0 and (np.diff(column) <= 1e-6).all()
    assert 2 < np.count_nonzero((column > 0.02) & (column < 0.98)) < 2 * STRIP
    assert np.abs(found[:120] - mixed(disc(80.0), NEW)[:120]).max() < 0.06


def test_a_mask_of_something_else_is_not_believed():
    share = disc(80.0)
    layers = head_layers(mixed(share, OLD), disc(40.0, (60.0, 60.0)) > 0.5, share)
    assert layers.agreed < LEAST_AGREED
    np.testing.assert_allclose(layers.alpha, share, atol=1e-6)
    np.testing.assert_array_equal(layers.background, mixed(share, OLD))


def test_a_bite_out_of_the_mask_leaves_no_hole():
    share = disc(80.0)
    bitten = (share > 0.5) & (disc(20.0, (100.0, 90.0)) < 0.5)
    layers = head_layers(mixed(share, OLD), bitten, share)
    assert LEAST_AGREED < layers.agreed < 1.0
    assert np.abs(layers.alpha - share).max() < 0.4 and layers.alpha[disc(70.0) == 1.0].min() > 0.95


def test_coverage_is_that_of_the_whole_picture_wherever_the_head_is():
    viewer = SurfaceViewer.of(sphere(50.0, 3))
    lens = np.array([[200.0, 0.0, 30.0], [0.0, 200.0, 20.0], [0.0, 0.0, 1.0]])
    near, beside = (rigid(FACING, np.array([x, 0.0, 400.0])) for x in (0.0, -300.0))
    found = head_coverage(viewer, None, near, lens, (60, 50))
    assert found.shape == (50, 60) and set(np.unique(found)) <= {0.0, 0.25, 0.5, 0.75, 1.0}
    radius = 200.0 * 50.0 / np.sqrt(400.0**2 - 50.0**2)
    rows, columns = np.mgrid[:50, :60] + 0.5
    np.testing.assert_array_equal(found == 1.0, found > 0.99)
    inside = np.hypot(columns - 30.0, rows - 20.0)
    assert found[inside < radius - 1.5].min() == 1.0 and found[inside > radius + 1.5].max() == 0.0
    assert head_coverage(viewer, None, beside, lens, (60, 50)).max() == 0.0
