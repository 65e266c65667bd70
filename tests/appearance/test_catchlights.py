"""Catchlights of a clip beside those of the solved light, on two balls under a lamp of known direction."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from field_check import below, field_faults
from two_eyes import LampShading, two_eyes

from shared.appearance.catchlights import catchlight, check_catchlights, iris_places
from shared.contract.records import SOLVE
from shared.geometry.eyeballs import IRIS_MM, gaze_direction
from shared.geometry.raycast import camera_hits
from shared.imaging.image_sampling import SurfaceViewer, prepare_picture
from shared.imaging.turning_eyes import TurningEyes
from shared.imaging.views import Views
from shared.rendering.eye_shine import EYE_INTENSITY, EyeShine

DISTANCE_MM, SIZE = 600.0, (480, 240)
LENS = np.array([[4500.0, 0.0, 240.0], [0.0, 4500.0, 120.0], [0.0, 0.0, 1.0]])
GAZES = np.array([[(0.0, 0.0)] * 2, [(0.2, -0.1)] * 2, [(np.nan, np.nan)] * 2])
DARK_IRIS = 0.005


@pytest.fixture(scope="module")
def scene():
    surface, _ = two_eyes(40.0)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = DISTANCE_MM
    return SimpleNamespace(eyes=TurningEyes.of(surface), viewer=SurfaceViewer.of(surface.mesh), pose=pose)


def shine_of(scene, yaw, radiance=1.0):
    lamp = gaze_direction(np.array([yaw, 0.3]))
    shading = LampShading(lamp, len(scene.viewer.mesh.vertices), radius=0.13, radiance=radiance, skin=0.0)
    return EyeShine(scene.viewer, shading, scene.eyes)


def filmed(scene, shine):
    """Views of frames with these gazes whose eyes mirror the shine's lamp."""
    face, bary, _ = camera_hits(scene.viewer.scene, scene.pose, LENS, *SIZE)
    hit, camera = face >= 0, np.array([0.0, 0.0, DISTANCE_MM])
    pictures = []
    for f, gaze in enumerate(GAZES):
        image = np.zeros((*SIZE[::-1], 3), np.float32)
        image[hit] = DARK_IRIS + EYE_INTENSITY * shine.reflection(f, gaze, camera, face[hit], bary[hit])
        pictures.append(prepare_picture(np.full(image.shape, 128, np.uint8), image, np.full(hit.shape, 255, np.uint8)))
    poses = np.repeat(scene.pose[None], len(GAZES), axis=0)
    return Views.in_one_light(poses, LENS, SIZE, "head", lambda f: pictures[f], lambda f: hit, gaze=GAZES)


def test_places_lie_evenly_within_the_iris():
    places = iris_places()
    assert np.linalg.norm(places, axis=1).max() < IRIS_MM
    np.testing.assert_allclose(places.mean(0), 0.0, atol=1e-9)
    assert len(places) == pytest.approx(np.pi * (0.8 * IRIS_MM) ** 2 / 0.25**2, rel=0.03)


def test_a_catchlight_is_where_brightness_stands_out():
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    iris = 0.1 + 0.005 * rng.standard_normal(400)
    assert catchlight(iris, directions) is None
    spot = directions @ directions[7] > 0.95
    direction, light = catchlight(iris + 0.6 * spot, directions)
    assert direction @ directions[7] > 0.98
    assert light == pytest.approx(0.6 * spot.sum(), rel=0.3)


def test_under_the_right_light_directions_and_light_agree(scene):
    found = check_catchlights(filmed(scene, shine_of(scene, 0.3)), scene.eyes, shine_of(scene, 0.3))
    assert field_faults(found, below(SOLVE, "catchlights")) == []
    assert (found["irises"], found["with_catchlight"], found["compared"]) == (4, 4, 4)  # shut eyes are not looked at
    assert found["apart_deg"]["p95"] < 2.0
    assert found["light_over_solved"] == pytest.approx(1.0, abs=0.15)


def test_a_light_that_is_off_is_told_by_how_much(scene):
    """Lamps 0.25 radians of yaw apart at 0.3 of pitch are cos(0.3) times as far apart."""
    found = check_catchlights(filmed(scene, shine_of(scene, 0.3)), scene.eyes, shine_of(scene, 0.05, radiance=2.0))
    assert found["compared"] == 4
    assert found["apart_deg"]["median"] == pytest.approx(np.degrees(0.25 * np.cos(0.3)), abs=2.0)
    assert found["light_over_solved"] == pytest.approx(0.5, abs=0.1)


def test_a_lamp_that_the_light_lacks_is_not_compared(scene):
    found = check_catchlights(filmed(scene, shine_of(scene, 0.3)), scene.eyes, shine_of(scene, 0.3, radiance=0.0))
    assert (found["with_catchlight"], found["compared"]) == (4, 0)
    assert field_faults(found, below(SOLVE, "catchlights")) == []
    assert "apart_deg" not in found


def test_nothing_is_said_of_eyes_that_stay_shut(scene):
    views = filmed(scene, shine_of(scene, 0.3))
    assert check_catchlights(replace(views, gaze=np.full_like(GAZES, np.nan)), scene.eyes, shine_of(scene, 0.3)) is None
