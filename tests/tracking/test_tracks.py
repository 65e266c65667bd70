"""Dense tracks on a textured plane that turns before the camera, where each point's place is known."""

import cv2
import numpy as np
from shapes import turned
from toy_plane import LENS, PLANE, SIZE, plane_texture, see_plane

from shared.geometry.mesh import vertex_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import project, rigid
from shared.tracking.tracked_clip import DETAIL_SIGMA_PX, GreyFrame, local_contrast, unusable_pixels
from shared.tracking.tracks import (
    dense_tracks,
    grid_from_landmarks,
    grid_from_mesh,
    points_on_grid,
    visible_vertices,
)


def texture(size=512):
    return plane_texture(size, (4, 8, 16), 40.0)


def contrast(image, sigma_px=4.0):
    return local_contrast(image, sigma_px, 1.5 * sigma_px, 0.02)


def render(pose, image, gain=1.0):
    """What the camera sees of the textured plane, as uint8."""
    seen, hit = see_plane(pose, image)
    return np.where(hit, gain * seen, 5).clip(0, 255).astype(np.uint8)


def poses():
    turns = np.array([[0, 0, 0], [0, 0.2, 0], [0.15, -0.2, 0.05]])
    return turned(turns)


def test_tracks_find_the_skin_where_it_is_despite_a_change_of_light():
    true, gains = poses(), (1.0, 0.7, 1.0)
    images = [render(pose, texture(), gain) for pose, gain in zip(true, gains, strict=True)]
    believed = true.copy()
    believed[1:, 0, 3] += 2.0  # the warp is wrong by 2 mm, two pixels
    scene = RayScene(PLANE.vertices, PLANE.faces)
    everything = np.ones(len(PLANE.faces), bool)
    grid = grid_from_mesh(scene, PLANE.faces, everything, true[0], LENS, np.array([25, 25, 215, 215.0]), 0, 2.0)
    positions, _ = project(PLANE.vertices, believed, LENS)
    tracks, where = dense_tracks(
        grid,
        [contrast(image) for image in images],
        [np.zeros((SIZE, SIZE), np.uint8)] * 3,
        positions,
        np.ones((3, len(PLANE.vertices)), bool),
        count=300,
        search_px=6.0,
    )
    expected = project(points_on_grid(grid, where, PLANE.vertices), true, LENS)[0]
    error = np.linalg.norm(tracks - expected, axis=-1)
    assert np.isfinite(error).mean() > 0.7
    assert np.nanmedian(error[0]) < 0.02
    assert np.nanmedian(error[1:]) < 0.12


def test_hidden_vertices_give_no_tracks():
    true = poses()
    image = contrast(render(true[0], texture()))
    grid = grid_from_landmarks(project(PLANE.vertices, true[0], LENS)[0], 0, 1.0)
    visible = np.ones((2, len(PLANE.vertices)), bool)
    visible[1] = False
    positions = project(PLANE.vertices, true[[0, 0]], LENS)[0]
    no_mask = [np.zeros((SIZE, SIZE), np.uint8)] * 2
    tracks, _ = dense_tracks(grid, [image] * 2, no_mask, positions, visible, count=100, search_px=5.0)
    assert np.isfinite(tracks[0]).any()
    assert np.isnan(tracks[1]).all()


def test_visibility_needs_a_clear_and_frontal_view():
    near = PLANE.vertices * 0.3 + [0, 0, 100.0]
    vertices = np.concatenate([PLANE.vertices, near])
    faces = np.concatenate([PLANE.faces, PLANE.faces + len(PLANE.vertices)])
    scene, normals = RayScene(vertices, faces), vertex_normals(vertices, faces)
    seen = visible_vertices(scene, vertices, normals, poses()[0], 0.2)
    assert not seen[len(PLANE.vertices) // 2]
    assert seen[len(PLANE.vertices) :].all() and seen[0]
    behind = rigid(np.diag([-1.0, -1, 1]), np.array([0, 0, 900.0]))
    assert not visible_vertices(scene, vertices, normals, behind, 0.2).any()


def test_clipped_and_crushed_pixels_are_unusable():
    image = np.full((20, 20, 3), 120, np.uint8)
    image[5, 5] = 255
    image[14, 14] = 3
    bad = unusable_pixels(cv2.split(image))
    assert bad[3:8, 3:8].all() and bad[12:17, 12:17].all()
    assert bad.sum() == 50


def test_green_and_blue_stand_in_where_red_alone_is_clipped():
    skin = np.stack([np.full((128, 128), 255.0), 0.8 * texture(128), 0.5 * texture(128)], axis=2)
    frame = GreyFrame.of(np.uint8(skin.clip(0, 255)), np.zeros((128, 128), bool))
    red = np.stack([skin[..., 1]] * 3, axis=2)
    unclipped = GreyFrame.of(np.uint8(red.clip(0, 255)), np.zeros((128, 128), bool))
    assert not frame.unusable.any() and frame.red_clipped.all()
    assert unclipped.cool is None and unclipped.red_clipped is None
    for found, expected in zip(frame.contrast(200.0), unclipped.contrast(200.0), strict=True):
        assert np.corrcoef(found.ravel().astype(float), expected.ravel().astype(float))[0, 1] > 0.95


def test_the_border_of_clipped_red_leaves_no_trace_in_the_contrast():
    skin = np.stack([np.full((128, 128), 220.0), 0.8 * texture(128), 0.5 * texture(128)], axis=2).clip(0, 255)
    skin[:, 64:, 0] = 255
    frame = GreyFrame.of(np.uint8(skin), np.zeros((128, 128), bool))
    cool = local_contrast(frame.cool, DETAIL_SIGMA_PX, 2.25 * DETAIL_SIGMA_PX, 0.05)
    grey = local_contrast(frame.grey, DETAIL_SIGMA_PX, 2.25 * DETAIL_SIGMA_PX, 0.05)
    detail = frame.detail()
    assert frame.red_clipped[:, 62:].all() and not frame.red_clipped[:, :62].any()
    assert (detail[:, 59:] == cool[:, 59:]).all() and (detail[:, :52] == grey[:, :52]).all()


def test_a_pixel_of_two_clipped_channels_or_of_the_background_says_nothing():
    image = np.full((40, 40, 3), 120, np.uint8)
    image[10, 10] = 255, 255, 120
    image[30, 30, 0] = 255
    background = np.zeros((40, 40), bool)
    background[:, 30:] = True
    frame = GreyFrame.of(image, background)
    assert frame.unusable[8:13, 8:13].all() and frame.unusable[:, 30:].all()
    assert frame.unusable[28:33, 28:30].sum() == 0
    assert frame.red_clipped.sum() == 5 * 2


def test_local_contrast_ignores_gain():
    image = np.clip(texture(128), 60, 200)
    bright, dark = contrast(image.astype(np.uint8), 5.0), contrast((image * 0.5).astype(np.uint8), 5.0)
    assert np.corrcoef(bright.ravel().astype(float), dark.ravel().astype(float))[0, 1] > 0.97


def test_local_contrast_s_floor_leaves_noise_dark():
    rng = np.random.default_rng(1)
    noise = (100 + rng.normal(size=(80, 80))).round().astype(np.uint8)
    loud, quiet = (local_contrast(noise, 4.0, 6.0, floor).astype(float).std() for floor in (0.001, 0.1))
    assert quiet < 0.2 * loud
    flat = local_contrast(np.full((40, 40), 90, np.uint8), 4.0, 6.0, 0.02)
    assert np.abs(flat.astype(int) - 128).max() <= 1
