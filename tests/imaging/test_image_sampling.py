"""Samples of pictures, what a camera sees of a surface, and how near to the rim one that may be off is believed."""

import numpy as np
import pytest
from shapes import FACING, LENS, grid_plane, nods, sphere

from shared.geometry.mesh import normalised
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import rigid
from shared.imaging.image_sampling import (
    BALL_MM,
    MAXIMUM_LEAST_COSINE,
    MINIMUM_VIEW_COSINE,
    SurfaceViewer,
    prepare_picture,
    sample_colours,
    sample_inside,
    sample_points_in_frames,
    sample_saturation,
    texel_size,
)

DISTANCE, FOCAL, SIZE = 5000.0, 20000.0, 640


def seen_radius(viewer):
    """Farthest from the picture's middle that a vertex is seen, mm on the ball."""
    lens = np.array([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]])
    view = viewer.view(rigid(FACING, np.array([0.0, 0.0, DISTANCE])), lens, (SIZE, SIZE))
    seen = view.weight > 0
    return np.linalg.norm(view.pixels[seen] - SIZE / 2, axis=1).max() * DISTANCE / FOCAL


@pytest.fixture(scope="module")
def viewer():
    return SurfaceViewer.of(sphere(BALL_MM, levels=6))


def test_a_sure_surface_is_seen_up_to_the_least_cosine(viewer):
    rim = BALL_MM * np.sqrt(1.0 - MINIMUM_VIEW_COSINE**2)
    assert seen_radius(viewer.within_rim(0.0)) == seen_radius(viewer) == pytest.approx(rim, abs=2.0)


def test_an_unsure_surface_keeps_twice_its_error_from_the_rim(viewer):
    error_mm = 2.0
    assert BALL_MM - seen_radius(viewer.within_rim(error_mm)) == pytest.approx(2.0 * error_mm, abs=1.5)


def test_most_of_any_surface_is_believed(viewer):
    within = viewer.within_rim(1000.0)
    assert within.least_cosine == MAXIMUM_LEAST_COSINE and viewer.least_cosine == MINIMUM_VIEW_COSINE


def flat_picture(height=120, width=160, codes=None, linear=None):
    codes = np.full((height, width, 3), 128, np.uint8) if codes is None else codes
    linear = np.full((height, width, 3), 0.2, np.float32) if linear is None else linear
    return prepare_picture(codes, linear, np.full((height, width), 255, np.uint8))


def test_ramps_are_sampled_at_any_footprint():
    """Colour u + 2 v: pixel centres at integer + 0.5, and the levels of the pyramid agree to 0.07 pixels (OpenCV's
    bicubic kernel bends ramps by that much)."""
    v, u = np.mgrid[0:128, 0:160] + 0.5
    picture = flat_picture(128, 160, linear=np.stack([u + 2 * v] * 3, axis=-1).astype(np.float32))
    assert len(picture.levels) > 1
    pixels = np.random.default_rng(0).uniform(30, 98, (50, 2))
    expected = pixels[:, 0] + 2 * pixels[:, 1]
    for footprint in (None, np.full(50, 0.5), np.full(50, 1.5), np.full(50, 2.0), np.full(50, 3.0)):
        assert np.allclose(sample_colours(picture, pixels, footprint)[:, 1], expected, atol=0.2)


def test_wide_footprints_average():
    stripes = np.tile(np.array([0.0, 1.0], np.float32), 80)[None, :, None] * np.ones((128, 1, 3), np.float32)
    picture = flat_picture(128, 160, linear=stripes)
    pixels = np.array([[64.5, 50.5], [65.5, 50.5]])
    assert np.allclose(sample_colours(picture, pixels)[:, 0], [0.0, 1.0], atol=1e-6)
    assert np.allclose(sample_colours(picture, pixels, np.full(2, 2.0)), 0.5, atol=1e-6)


def test_clipped_and_crushed_channels_are_marked():
    codes = np.full((64, 64, 3), 128, np.uint8)
    codes[10:20, 10:20, 0] = 255
    codes[40:50, 40:50, 2] = 0
    saturation = flat_picture(64, 64, codes=codes).saturation
    found = sample_saturation(saturation, np.array([[15.0, 15.0], [45.0, 45.0], [30.0, 30.0]]))
    assert found.tolist() == [[1, 0, 0], [0, 0, -1], [0, 0, 0]]
    codes16 = (codes.astype(np.uint16) * 257).astype(np.uint16)
    linear = np.zeros((64, 64, 3), np.float32)
    assert np.array_equal(prepare_picture(codes16, linear, codes[..., 0]).saturation,
                          flat_picture(64, 64, codes).saturation)


def test_weight_fades_towards_the_mask():
    mask = np.zeros((64, 64), np.uint8)
    mask[:, 20:] = 128
    picture = prepare_picture(np.full((64, 64, 3), 99, np.uint8), np.zeros((64, 64, 3), np.float32), mask)
    weight = sample_inside(picture, np.array([[10.5, 30.5], [20.5, 30.5], [22.5, 30.5], [40.5, 30.5]]))
    assert weight[0] == 0.0 and weight[1] < weight[2] < weight[3] == 1.0


def test_the_camera_sees_the_front_of_a_ball():
    ball = sphere(40.0, 4)
    viewer = SurfaceViewer.of(ball)
    pose = nods(np.array([0.0]), distance=400.0)[0]
    view = viewer.view(pose, LENS, (160, 120))
    towards = normalised(np.array([0, 0, 400.0]) - ball.vertices)
    assert np.allclose(view.towards_camera, towards)
    cosine = (towards * ball.vertices).sum(1) / 40.0
    assert np.allclose(view.cosine, cosine, atol=0.02)
    assert (view.weight[cosine < 0.15] == 0).all()
    assert np.allclose(view.weight[cosine > 0.4], view.cosine[cosine > 0.4] ** 2)
    assert np.allclose(view.depth, 400.0 - ball.vertices[:, 2])


BEFORE_THE_WALL = rigid(FACING, np.array([0, 0, 450.0])), LENS, (160, 120)


def plate_before_wall():
    """A wall, of which a plate 50 mm before it hides part, and a viewer of both."""
    wall, plate = grid_plane(41, 80.0), grid_plane(9, 30.0)
    vertices = np.concatenate([wall.vertices, plate.vertices + [0, 0, 50.0]])
    mesh = wall.replace(vertices=vertices, faces=np.concatenate([wall.faces, plate.faces + len(wall.vertices)]))
    return wall, SurfaceViewer(mesh, RayScene(mesh.vertices, mesh.faces), margin_mm=4.0)


def test_what_lies_behind_an_edge_is_left_out_with_a_margin():
    """Wall vertices next to the plate's shadow are not trusted either."""
    wall, viewer = plate_before_wall()
    view = viewer.view(*BEFORE_THE_WALL)
    reach = np.abs(wall.vertices[:, :2]).max(1)
    shadow = 15.0 * 450.0 / 400.0
    on_wall = view.weight[: len(wall.vertices)]
    assert (on_wall[reach < shadow + 1.5] == 0).all()
    in_picture = reach < 38.0
    assert (on_wall[in_picture & (reach > shadow + 12.0)] > 0.9).all()
    assert (view.weight[len(wall.vertices) :] > 0.9).all()


def test_a_view_of_some_vertices_is_the_whole_view_there():
    """Also next to what hides them: the margin is that of the whole mesh."""
    wall, viewer = plate_before_wall()
    index = np.arange(0, len(wall.vertices), 7)[::-1]
    limited, rows = viewer.limited_to(index)
    whole, part = viewer.view(*BEFORE_THE_WALL), limited.view(*BEFORE_THE_WALL)
    assert len(part.weight) < len(whole.weight)
    assert 0.1 < (whole.weight[index] == 0).mean() < 0.9
    for name, values in vars(whole).items():
        assert np.array_equal(getattr(part, name)[rows], values[index]), name


def test_samples_are_the_colours_behind_the_vertices():
    """The picture shows each pixel's own coordinates, so samples must equal the projections."""
    ball = sphere(40.0, 3)
    viewer = SurfaceViewer.of(ball)
    v, u = np.mgrid[0:120, 0:160] + 0.5
    picture = flat_picture(linear=np.stack([u, v, 0 * u + 1], axis=-1).astype(np.float32))
    poses = nods(np.array([0.0, 25.0]), distance=450.0)
    index = np.nonzero(np.abs(ball.vertices[:, 1]) < 20)[0][::2]
    samples = sample_points_in_frames(viewer, index, [picture, picture], poses, LENS)
    for f in range(2):
        in_camera = ball.vertices[index] @ poses[f, :3, :3].T + poses[f, :3, 3]
        pixels = 300.0 * in_camera[:, :2] / in_camera[:, 2:] + [80, 60]
        seen = samples.weight[:, f] > 0
        assert 0.3 < seen.mean() < 0.6
        assert np.allclose(samples.colours[seen, f, :2], pixels[seen], atol=0.05)
        assert (samples.colours[~seen, f] == 0).all()
    assert np.array_equal(samples.frames(np.array([1])).points(np.arange(3)).colours, samples.colours[:3, 1:])


def test_texels_of_a_square_are_squares():
    assert np.allclose(texel_size(grid_plane(5, 64.0), 128), 0.5)
