"""Eyeballs that turn with a known gaze: their texture, sampled and rendered, against a painted ball."""

import numpy as np
import pytest
from shapes import FACING, two_balls

from shared.geometry.eyeballs import gaze_rotation
from shared.geometry.surface import Surface
from shared.geometry.transforms import camera_centres, rigid
from shared.imaging.image_sampling import SurfaceViewer, prepare_picture
from shared.imaging.texels import TexelSurface
from shared.imaging.turning_eyes import EyeTexels, TurningEyes, depth_in_polygon
from shared.rendering.render import LookingEyes, SurfaceMaps, render_frame

SIZE, LENS = (200, 100), np.array([[900.0, 0, 100], [0, 900.0, 50], [0, 0, 1]])
POSE = rigid(FACING, np.array([0.0, 0.0, 400.0]))
CENTRES, RADIUS = np.array([[-25.0, 0.0, 0.0], [25.0, 0.0, 0.0]]), 15.0
GAZES = np.random.default_rng(3).uniform(-0.45, 0.45, (12, 2, 2))
MAP = 128


def paint(directions):
    """[..., 3] colours of an eye that looks straight ahead: an iris with a rim, and rays on it."""
    x, y, z = np.moveaxis(directions, -1, 0)
    iris = 1.0 / (1.0 + np.exp((np.arccos(np.clip(z, -1.0, 1.0)) - 0.4) / 0.03))
    rays = 0.15 * np.cos(5.0 * np.arctan2(y, x)) * np.hypot(x, y)
    return (0.8 - (0.55 + rays) * iris)[..., None] * [1.0, 0.9, 0.8]


def picture_of(gaze):
    """A frame of both eyes, closed form."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    rays = np.stack([(u - 100) / 900, (v - 50) / 900, np.ones_like(u)], axis=-1) @ POSE[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    linear, mask = np.zeros((*u.shape, 3), np.float32), np.zeros(u.shape, np.uint8)
    for centre, own in zip(CENTRES, gaze, strict=True):
        away = centre - camera_centres(POSE[None])[0]
        along = rays @ away
        squared = RADIUS**2 - away @ away + along**2
        hit = squared > 0
        directions = ((along - np.sqrt(np.maximum(squared, 0.0)))[..., None] * rays - away) / RADIUS
        linear[hit] = paint(directions[hit] @ gaze_rotation(own))
        mask[hit] = 255
    return prepare_picture(np.full((*u.shape, 3), 128, np.uint8), linear, mask)


@pytest.fixture(scope="module")
def eyes():
    surface = two_balls(CENTRES, RADIUS)
    texels, viewer = TexelSurface(surface.mesh, MAP), SurfaceViewer.of(surface.mesh)
    turning = TurningEyes.of(surface)
    return texels, viewer, EyeTexels(texels, viewer, turning, np.zeros(len(surface.mesh.faces), bool))


def frame_of(eyes, gaze):
    """A frame as it is without turning, and as it is with."""
    texels, viewer, eye_texels = eyes
    view = viewer.view(POSE, LENS, SIZE)
    still = texels.frame_view(view, picture_of(gaze), LENS, texels.mesh.vertices)
    return still, eye_texels.turned(still, view, gaze)


def mean_texture(eyes, kind):
    total, weight = np.zeros((len(eyes[0]), 3)), np.zeros(len(eyes[0]))
    for gaze in GAZES:
        samples, _ = eyes[0].samples(frame_of(eyes, gaze)[kind])
        total[samples.rows] += samples.weight[:, None] * samples.colours
        weight[samples.rows] += samples.weight
    return total / np.maximum(weight, 1e-9)[:, None], weight


def test_a_painted_eye_comes_back_sharp(eyes):
    truth = paint(eyes[2].directions)
    front = eyes[2].directions[:, 2] > 0.85
    errors = []
    for kind in (0, 1):
        mean, weight = mean_texture(eyes, kind)
        counts = front & (weight > 1.0)
        assert counts.sum() > 0.9 * front.sum()
        errors.append(np.abs(mean - truth)[counts])
    assert np.median(errors[1]) < 0.01 and np.quantile(errors[1], 0.98) < 0.06
    assert np.median(errors[1]) < 0.1 * np.median(errors[0]), "without gaze the average is mud"


def test_values_belong_to_the_place_and_not_to_the_texel(eyes):
    """What is given per vertex, here its position, comes from where the gaze turned the texel to."""
    gaze = GAZES[0]
    _, turned = frame_of(eyes, gaze)
    samples, places = eyes[0].samples(turned)
    at = np.searchsorted(eyes[2].rows, samples.rows)
    side = eyes[2].side[at]
    expected = np.einsum("nij,nj->ni", gaze_rotation(gaze)[side], eyes[2].directions[at])
    found = places - CENTRES[side]
    np.testing.assert_allclose(found / np.linalg.norm(found, axis=1, keepdims=True), expected, atol=1e-5)


def test_straight_ahead_a_texel_is_seen_where_it_lies(eyes):
    still, turned = frame_of(eyes, np.zeros((2, 2)))
    (first, places), (second, places_too) = eyes[0].samples(still), eyes[0].samples(turned)
    common, a, b = np.intersect1d(first.rows, second.rows, return_indices=True)
    assert len(common) > 0.8 * len(first.rows)
    np.testing.assert_allclose(second.colours[b], first.colours[a], atol=1e-3)
    np.testing.assert_allclose(places_too[b], places[a], atol=1e-3)


def test_a_shut_eye_says_nothing_and_the_other_one_does(eyes):
    gaze = GAZES[0].copy()
    gaze[1] = np.nan
    rows = frame_of(eyes, gaze)[1].rows
    assert set(eyes[2].side[np.searchsorted(eyes[2].rows, rows)]) == {0}


def test_lids_of_the_picture_bound_what_counts(eyes):
    texels, viewer, eye_texels = eyes
    view = viewer.view(POSE, LENS, SIZE)
    still = texels.frame_view(view, picture_of(GAZES[0]), LENS)
    slit = np.array([[-40.0, -6.0], [40.0, -6.0], [40.0, 6.0], [-40.0, 6.0]])
    middles = np.array([[100.0 - 900 * 25 / 400, 50.0], [100.0 + 900 * 25 / 400, 50.0]])
    turned = eye_texels.turned(still, view, GAZES[0], middles[:, None] + slit)
    below = turned.moved.values[:, 1] / turned.moved.values[:, 2]
    assert len(below) > 50 and np.abs(below - 50.0).max() < 6.0
    unseen = eye_texels.turned(still, view, GAZES[0], np.full((2, 4, 2), np.nan))
    assert len(unseen.rows) == 0


class FlatShading:
    """E of 1 and no S, so that only the map shows."""

    def irradiance(self, frame):
        return np.ones((2 * 2562, 3), np.float32)

    def reflection(self, frame):
        return np.zeros((2 * 2562, 3), np.float32)

    def arriving(self, frame, directions):
        return np.ones((len(directions), 3))

    def blocked_light(self, frame):
        return np.ones((1, 3))

    stand_in = np.zeros(2 * 2562, int)


def test_a_re_render_turns_the_texture(eyes):
    texels, viewer, eye_texels = eyes
    albedo = texels.dilated(texels.to_image(paint(eye_texels.directions).astype(np.float32)))
    maps = SurfaceMaps(albedo, np.zeros((MAP, MAP), np.float32))

    def rendered(gaze):
        eyes = None if gaze is None else LookingEyes(eye_texels.eyes, gaze)
        return render_frame(viewer, FlatShading(), maps, 0, POSE, LENS, SIZE, eyes=eyes)

    for gaze in GAZES[:3]:
        picture, covered = rendered(gaze)
        error = np.abs(picture - picture_of(gaze).levels[0])[covered == 1.0]
        assert np.median(error) < 0.01 and np.quantile(error, 0.95) < 0.08
    assert np.array_equal(rendered(np.full((2, 2), np.nan))[0], rendered(None)[0]), "shut: straight ahead"
    np.testing.assert_allclose(rendered(np.zeros((2, 2)))[0], rendered(None)[0], atol=2e-3)


def test_depth_in_a_polygon():
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    points = np.array([[5.0, 5.0], [2.0, 5.0], [9.0, 1.5], [12.0, 5.0], [-3.0, -4.0]])
    np.testing.assert_allclose(depth_in_polygon(points, square), [5.0, 2.0, 1.0, -2.0, -5.0])
    np.testing.assert_allclose(depth_in_polygon(points, square[::-1]), [5.0, 2.0, 1.0, -2.0, -5.0])


def test_a_mesh_without_eyes_has_none_that_turn():
    surface = two_balls(CENTRES, RADIUS)
    assert TurningEyes.of(Surface(surface.mesh, surface.face_segment, ("skin",))) is None
