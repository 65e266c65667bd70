"""What eyes mirror: normals of cornea and eyeball, and a lamp's place in a picture of it."""

import numpy as np
import pytest
from two_eyes import RADIUS_MM, LampShading, two_eyes

from shared.geometry.eyeballs import IRIS_MM, gaze_direction
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.turning_eyes import TurningEyes
from shared.rendering.eye_shine import CORNEA_MM, EYE_INTENSITY, EyeShine, cornea_normals

APART_MM, CAMERA = 60.0, np.array([0.0, 0.0, 600.0])


def test_a_smooth_surface_of_the_tear_film_s_index():
    assert EYE_INTENSITY == pytest.approx(0.626, abs=1e-3)


def test_normals_are_the_cornea_s_within_the_iris_and_the_eyeball_s_beyond():
    axis = gaze_direction(np.array([0.3, -0.1]))
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angles = np.array([0.0, 0.1, 0.3, 0.6, 1.2, 3.0])
    offsets = RADIUS_MM * (np.cos(angles)[:, None] * axis + np.sin(angles)[:, None] * side)
    normals = cornea_normals(offsets, np.broadcast_to(axis, offsets.shape))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    tilt = np.arctan2(normals @ side, normals @ axis)
    distance = RADIUS_MM * np.sin(angles)
    inside = (distance < IRIS_MM - 1.0) & (angles < 1.0)
    assert inside.sum() == 3
    np.testing.assert_allclose(tilt[inside], np.arcsin(distance[inside] / CORNEA_MM), atol=1e-12)
    np.testing.assert_allclose(tilt[~inside], angles[~inside], atol=1e-12)


@pytest.mark.parametrize("gaze", [(0.0, 0.0), (0.25, 0.1)])
def test_the_catchlight_stands_where_the_cornea_mirrors_the_lamp(gaze):
    """On a cornea about a centre c it is near c + r h, with h halfway between the lamp and the camera."""
    surface, centres = two_eyes(APART_MM)
    eyes, lamp = TurningEyes.of(surface), gaze_direction(np.array([0.3, 0.25]))
    shine = EyeShine(SurfaceViewer.of(surface.mesh), LampShading(lamp, len(surface.mesh.vertices)), eyes)
    face = eyes.balls[0].faces
    found = shine.reflection(0, np.array([gaze, gaze]), CAMERA, face, np.full((len(face), 3), 1 / 3))[:, 0]
    bright = found > 0.03
    assert 3 <= bright.sum() < 0.02 * len(face)
    np.testing.assert_allclose(found[bright], 0.04, rtol=0.05)  # F0 where light falls in steeply
    places = surface.mesh.vertices[surface.mesh.faces[face[bright]]].mean((0, 1)) - centres[0]
    axis, to_camera = gaze_direction(np.array(gaze)), (CAMERA - centres[0]) / np.linalg.norm(CAMERA - centres[0])
    half = lamp + to_camera
    half /= np.linalg.norm(half)
    across = CORNEA_MM * (half - (half @ axis) * axis)
    np.testing.assert_allclose(places - (places @ axis) * axis, across, atol=0.4)


def test_what_the_head_covers_is_seen_as_skin():
    """Towards the other eye, no light arrives but what that one sends on."""
    surface, _ = two_eyes(APART_MM)
    eyes = TurningEyes.of(surface)
    viewer = SurfaceViewer.of(surface.mesh)
    shine = EyeShine(viewer, LampShading(np.array([1.0, 0.0, 0.0]), len(surface.mesh.vertices)), eyes)
    face = eyes.balls[0].faces
    found = shine.reflection(0, np.full((2, 2), np.nan), CAMERA, face, np.full((len(face), 3), 1 / 3))[:, 0]
    assert found.max() < 0.3, "the lamp itself stands behind the other eye"
    assert (found > 0.25 * 0.04).any()
