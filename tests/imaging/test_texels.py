"""Texels of a map as points on a surface: samples block by block, means around vertices, gutters, wide blurs."""

import numpy as np
from scipy.ndimage import gaussian_filter
from shapes import FACING, sphere

from shared.appearance.texture import pooled_specular
from shared.geometry.transforms import rigid
from shared.imaging.image_sampling import SurfaceViewer, prepare_picture
from shared.imaging.texels import FrameView, TexelSurface

LENS = np.array([[900.0, 0, 200], [0, 900.0, 200], [0, 0, 1]])
BALL = sphere(50.0, 4)


def seen_ball(size):
    """A map's surface on a ball, and a frame of it with noise for a picture."""
    rng = np.random.default_rng(1)
    codes = rng.integers(0, 256, (400, 400, 3)).astype(np.uint8)
    picture = prepare_picture(codes, codes.astype(np.float32) / 255, np.full((400, 400), 255, np.uint8))
    surface, pose = TexelSurface(BALL, size), rigid(FACING, np.array([0.0, 0, 600]))
    view = SurfaceViewer.of(BALL).view(pose, LENS, (400, 400))
    return surface, surface.frame_view(view, picture, LENS, BALL.vertices)


def test_blocks_show_what_the_whole_does():
    surface, frame = seen_ball(512)
    whole, places = surface.samples(frame)
    blocks = frame.blocks()
    assert len(blocks) == 2 and np.array_equal(np.concatenate(blocks), frame.rows)
    parts, values = zip(*(surface.samples(frame, rows) for rows in blocks), strict=True)
    for name in ("rows", "colours", "weight", "saturation"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_allclose(joined, getattr(whole, name), atol=1e-6)
    np.testing.assert_array_equal(np.concatenate(values), places)
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 50.0, rtol=0.01)


def test_samples_lie_where_the_pinhole_camera_sees_them():
    surface, frame = seen_ball(128)
    ramp = np.stack(np.meshgrid(np.arange(400) + 0.5, np.arange(400) + 0.5), axis=-1)
    picture = np.concatenate([ramp, np.zeros((400, 400, 1))], axis=2).astype(np.float32)
    ramped = prepare_picture(np.full((400, 400, 3), 128, np.uint8), picture, np.full((400, 400), 255, np.uint8))
    samples, places = surface.samples(FrameView(frame.rows, frame.table, ramped, frame.saturation, frame.focal_length))
    expected = 900.0 * places[:, :2] * [1.0, -1.0] / (600.0 - places[:, 2:]) + 200.0
    np.testing.assert_allclose(samples.colours[:, :2], expected, atol=0.15)


def test_vertices_take_the_weighted_mean_of_their_texels():
    surface = TexelSurface(BALL, 64)
    rng = np.random.default_rng(2)
    values, weight = rng.normal(size=(2, len(surface), 3)).astype(np.float32)
    weight = weight**2
    share = np.zeros((len(BALL.vertices), len(surface)))
    for corner in range(3):
        share[BALL.faces[surface.face, corner], np.arange(len(surface))] += surface.bary[:, corner]
    means, total = surface.to_vertices(values, weight)
    np.testing.assert_allclose(total, share @ weight, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(means * total, share @ (weight * values), rtol=1e-5, atol=1e-5)


def test_gutters_take_the_nearest_texel_and_the_rest_stays():
    surface = TexelSurface(BALL, 64)
    image = surface.to_image(np.arange(1.0, len(surface) + 1.0), elsewhere=-1.0)
    filled = surface.dilated(image)
    assert (image < 0).any() and np.array_equal(filled[image > 0], image[image > 0])
    row, column = np.divmod(surface.pixel, 64)
    for y, x in np.argwhere(image < 0)[::37]:
        distance = np.hypot(row - y, column - x)
        assert distance[int(filled[y, x]) - 1] == distance.min()


class Equations:
    """Equations of texels whose intensity each tells with the same precision."""

    def __init__(self, values):
        self.values = values

    def specular_equations(self):
        return np.full(len(self.values), 6e3), 6e3 * self.values


def test_wide_pooling_over_blocks_is_a_gaussian():
    surface = TexelSurface(BALL, 256)
    image = 0.5 + 0.4 * np.tile(np.sin(2 * np.pi * np.arange(256) / 128), (256, 1))
    exact = gaussian_filter(surface.to_image(image.ravel()[surface.pixel]), 32.0)
    exact /= gaussian_filter(surface.to_image(np.ones(len(surface))), 32.0)
    found = pooled_specular(surface, Equations(image.ravel()[surface.pixel]), 32.0, 0.5, 1e3)
    np.testing.assert_allclose(found, exact.ravel()[surface.pixel], atol=4e-3)
    assert np.ptp(found) > 0.15
