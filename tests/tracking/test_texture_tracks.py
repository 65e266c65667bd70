"""Tracks against the mean texture of a textured plane, where each texel's place in each picture is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from shapes import turned
from toy_plane import LENS, PLANE, SIZE, plane_texture, see_plane

from shared.compute.robust import ROBUST_SCALE
from shared.geometry.atlas import BORDER_TEXELS, PlacedFrame, build_atlas, place_frame, sample
from shared.geometry.transforms import project
from shared.tracking.texture_tracks import LEAST_SPREAD, MeanContrast, Windows, mean_texture, track_frame

EVERY_FACE, EVERY_VERTEX = np.ones(len(PLANE.faces), bool), np.ones(len(PLANE.vertices), bool)
CLEAN = np.zeros((SIZE, SIZE), np.uint8)
WINDOWS = Windows(sigma=5.0, search=6.0, steps=6)
NOISE = 3.0
TURNS = [(yaw, pitch) for yaw in (-0.15, -0.05, 0.05, 0.15) for pitch in (-0.1, 0.0, 0.1)]


def skin(size=720):
    """A texture with detail from two texels up, code values about 128."""
    return plane_texture(size, (5, 9), 35.0)


def render(pose, image, noise=0.0, seed=0):
    """What the camera sees of the textured plane, [H, W] uint8."""
    seen, hit = see_plane(pose, image)
    seen = np.where(hit, seen, 128)
    return (seen + noise * np.random.default_rng(seed).normal(size=seen.shape)).round().clip(0, 255).astype(np.uint8)


def pose_of(yaw=0.0, pitch=0.0, shift=(0.0, 0.0)):
    return turned([pitch, yaw, 0.0], (*shift, 900.0))


def plane_atlas(count=300, usable=EVERY_FACE):
    return build_atlas(PLANE, usable, 1.0, count)


def placed_at(atlas, pose, visible=EVERY_VERTEX, unusable=CLEAN):
    return place_frame(atlas, PLANE.vertices, pose, LENS, visible, unusable)


def mean_of(atlas, image, noise=NOISE):
    """The mean texture of noisy pictures from known poses."""
    pairs = []
    for seed, turn in enumerate(TURNS):
        placed = placed_at(atlas, pose_of(*turn))
        picture = sample(render(pose_of(*turn), image, noise, 100 + seed), placed.layout, cv2.INTER_CUBIC)
        pairs.append((picture.astype(np.float32), placed.shown))
    return mean_texture(lambda: iter(pairs))


@pytest.fixture(scope="module")
def atlas():
    return plane_atlas()


@pytest.fixture(scope="module")
def texture(atlas):
    return mean_of(atlas, skin())


def test_atlas_spreads_texels_of_the_wanted_size():
    atlas = plane_atlas(count=300)
    assert atlas.valid.shape == (180, 180) and atlas.valid.all()
    assert 200 < len(atlas.rows) < 420
    assert min(atlas.rows.min(), atlas.columns.min()) >= BORDER_TEXELS
    assert max(atlas.rows.max(), atlas.columns.max()) < 180 - BORDER_TEXELS
    assert len(np.unique(np.diff(np.unique(atlas.rows)))) == 1
    assert 3 * len(atlas.rows) < len(plane_atlas(count=1200).rows) < 6 * len(atlas.rows)


def test_atlas_interpolates_positions_exactly(atlas):
    row, column = np.mgrid[0:180, 0:180] + 0.5
    expected = np.stack([column - 90.0, 90.0 - row, 0 * row], axis=-1)
    assert np.abs(atlas.spread(PLANE.vertices) - expected).max() < 1e-3
    assert np.abs(atlas.points(PLANE.vertices) - expected[atlas.rows, atlas.columns]).max() < 1e-3


def test_atlas_of_some_faces_is_cut_to_them():
    left = PLANE.vertices[PLANE.faces].mean(1)[:, 0] < 0
    atlas = plane_atlas(usable=left)
    assert atlas.valid.shape == (180, 90)
    assert atlas.points(PLANE.vertices)[:, 0].max() < 0
    assert np.allclose(atlas.spread(PLANE.vertices)[:, -1, 0], -0.5, atol=1e-3)


def test_placed_frame_lies_where_the_surface_is_seen(atlas):
    pose = pose_of(0.3, 0.1)
    placed = placed_at(atlas, pose)
    expected = project(atlas.points(PLANE.vertices), pose, LENS)[0]
    # linear between vertices in the picture, so that perspective within a face leaves a little
    assert np.abs(placed.layout[atlas.rows, atlas.columns] - expected).max() < 0.15
    assert placed.shown.all()


def test_placed_frame_marks_hidden_vertices_and_spoilt_pixels(atlas):
    hidden, spoilt = EVERY_VERTEX.copy(), CLEAN.copy()
    hidden[40] = False  # the middle
    spoilt[50:70, 100:130] = 1
    placed = placed_at(atlas, pose_of(), hidden, spoilt)
    assert placed.shown[85:95, 85:95].sum() == 0
    x, y = placed.layout[..., 0], placed.layout[..., 1]
    in_block = (x > 100) & (x < 130) & (y > 50) & (y < 70)
    assert in_block.sum() > 500 and placed.shown[in_block].sum() == 0
    far = ~in_block & (np.hypot(x - 120, y - 120) > 40)
    assert placed.shown[far].all()


def test_placed_frame_shows_nothing_outside_the_picture(atlas):
    placed = placed_at(atlas, pose_of(shift=(80.0, 0.0)))
    outside = placed.layout[..., 0] > SIZE
    assert outside.any() and placed.shown[outside].sum() == 0
    assert placed.shown[placed.layout[..., 0] < SIZE - 1].all()


def test_mean_texture_ignores_an_outlier_frame():
    rng = np.random.default_rng(1)
    truth = rng.uniform(60, 200, (20, 20)).astype(np.float32)
    pairs = [(truth + 2 * rng.normal(size=truth.shape).astype(np.float32), np.ones((20, 20))) for _ in range(12)]
    pairs.append((truth + 60, np.ones((20, 20))))
    calls = []

    def frames():
        calls.append(1)
        return iter(pairs)

    texture = mean_texture(frames)
    plain = np.mean([image for image, _ in pairs], axis=0)
    assert len(calls) == 2
    assert np.abs(texture.mean - truth).mean() < 0.4 * np.abs(plain - truth).mean()
    assert np.median(texture.spread) < 0.7 * np.median(np.std([image for image, _ in pairs], axis=0))


def test_mean_texture_counts_only_what_is_shown():
    image, shown = np.full((6, 6), 90.0, np.float32), np.ones((6, 6))
    shown[:, :2] = 0
    texture = mean_texture(lambda: iter([(image, shown)] * 3))
    assert np.all(texture.seen[:, :2] == 0) and np.allclose(texture.seen[:, 2:], 3.0)
    assert np.allclose(texture.mean[:, 2:], 90.0)
    assert np.allclose(texture.spread, LEAST_SPREAD)


@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (0.3, -0.4), (-0.8, 0.5)])
def test_track_finds_a_known_offset(atlas, texture, shift_px):
    true = pose_of(0.1, 0.05)
    believed = true.copy()
    believed[:2, 3] += shift_px  # a pixel is a millimetre
    found, whitening = track_frame(atlas, texture, render(true, skin(), NOISE), placed_at(atlas, believed), WINDOWS)
    error = found - project(atlas.points(PLANE.vertices), true, LENS)[0]
    good = np.isfinite(found[:, 0])
    assert good.mean() > 0.85
    assert np.median(np.linalg.norm(error[good], axis=1)) < 0.05
    assert np.abs(error[good].mean(0)).max() < 0.02
    assert np.all(whitening[good][:, 0, 0] > 0) and np.all(whitening[~good] == 0)


def test_track_follows_a_pose_that_is_turned_wrongly(atlas, texture):
    true, believed = pose_of(0.18, 0.05), pose_of(0.1)
    found, _ = track_frame(atlas, texture, render(true, skin(), NOISE), placed_at(atlas, believed), WINDOWS)
    points = atlas.points(PLANE.vertices)
    before = np.linalg.norm(project(points, believed, LENS)[0] - project(points, true, LENS)[0], axis=1)
    after = np.linalg.norm(found - project(points, true, LENS)[0], axis=1)
    tracked = np.isfinite(after)
    assert tracked.mean() > 0.6
    assert np.median(after[tracked]) < 0.06 and np.median(before[tracked]) > 0.4


def test_whitening_grows_with_contrast_to_noise(atlas):
    strength, faint = [], (0.4 * (skin() - 128) + 128).astype(np.float32)
    for image, noise in ((skin(), 2.0), (skin(), 6.0), (faint, 6.0)):
        picture = render(pose_of(0.02), image, noise)
        mean, placed = mean_of(atlas, image, noise), placed_at(atlas, pose_of(0.02))
        found, whitening = track_frame(atlas, mean, picture, placed, WINDOWS)
        seen = np.isfinite(found[:, 0])
        assert seen.mean() > 0.85
        strength.append(np.median(np.linalg.norm(whitening[seen], axis=(1, 2))))
    assert strength[0] > 1.2 * strength[1] > 1.2 * 1.5 * strength[2]


@pytest.mark.parametrize("noise", [3.0, 6.0, 10.0])
def test_whitened_error_has_unit_spread_under_independent_noise(atlas, noise):
    texture, true = mean_of(atlas, skin(), noise), pose_of(0.02)
    picture = render(true, skin(), noise, seed=7)
    found, whitening = track_frame(atlas, texture, picture, placed_at(atlas, true), replace(WINDOWS, floor_px=0.0))
    error = found - project(atlas.points(PLANE.vertices), true, LENS)[0]
    whitened = np.einsum("nij,nj->ni", whitening, error)
    assert 0.6 < ROBUST_SCALE * np.nanmedian(np.abs(whitened)) < 1.6


def test_glints_that_the_mean_does_not_show_hardly_pull(atlas, texture):
    true, picture = pose_of(0.05), render(pose_of(0.05), skin(), NOISE)
    glints = np.random.default_rng(2).random(picture.shape) < 0.015
    picture[glints] = 255
    found, _ = track_frame(atlas, texture, picture, placed_at(atlas, true), WINDOWS)
    error = np.linalg.norm(found - project(atlas.points(PLANE.vertices), true, LENS)[0], axis=1)
    assert np.isfinite(error).mean() > 0.6
    assert np.nanmedian(error) < 0.06


def test_windows_that_a_frame_hides_or_mostly_hides_are_not_tracked(atlas, texture):
    pose = pose_of()
    placed = placed_at(atlas, pose)
    shown = placed.shown.copy()
    shown[:, :90] = 0
    shown[100:, 90:] *= (np.indices((80, 90)).sum(0) % 2).astype(np.float32)  # every other texel
    half_hidden = PlacedFrame(placed.layout, shown)
    found, whitening = track_frame(atlas, texture, render(pose, skin(), NOISE), half_hidden, WINDOWS)
    tracked = np.isfinite(found).all(1)
    left, lower = atlas.columns < 90, atlas.rows > 112
    assert not tracked[left].any() and np.all(whitening[left] == 0)
    assert not tracked[lower].any()
    inner = (atlas.columns > 102) & (atlas.rows < 90)
    assert tracked[inner].mean() > 0.85


def test_windows_without_texture_are_not_tracked(atlas):
    flat = MeanContrast(np.full((180, 180), 128, np.float32), np.ones((180, 180), np.float32), np.ones((180, 180)))
    found, _ = track_frame(atlas, flat, render(pose_of(), skin(), NOISE), placed_at(atlas, pose_of()), WINDOWS)
    assert np.isnan(found).all()


def test_skin_that_no_frame_of_the_mean_saw_is_not_tracked(atlas, texture):
    seen = texture.seen.copy()
    seen[:, :90] = 0
    unseen = MeanContrast(texture.mean, texture.spread, seen)
    found, _ = track_frame(atlas, unseen, render(pose_of(), skin(), NOISE), placed_at(atlas, pose_of()), WINDOWS)
    assert np.isnan(found[atlas.columns < 80]).all()
    assert np.isfinite(found[atlas.columns > 105]).mean() > 0.85


def test_nothing_is_found_of_a_head_that_is_believed_out_of_the_picture(atlas, texture):
    """As the guess for a doubtful frame may have it: no texel is shown at all."""
    placed = placed_at(atlas, pose_of(shift=(5000.0, 0.0)))
    assert not placed.shown.any()
    found, whitening = track_frame(atlas, texture, render(pose_of(), skin(), NOISE), placed, WINDOWS)
    assert found.shape == (len(atlas.rows), 2) and np.isnan(found).all()
    assert whitening.shape == (len(atlas.rows), 2, 2) and np.all(whitening == 0)


def test_offset_beyond_the_search_is_refused(atlas, texture):
    true, believed = pose_of(), pose_of(shift=(2.5, 0.0))
    narrow = Windows(sigma=5.0, search=1.5, steps=4)
    found, _ = track_frame(atlas, texture, render(true, skin(), NOISE), placed_at(atlas, believed), narrow)
    assert np.isfinite(found[:, 0]).mean() < 0.05
