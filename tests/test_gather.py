"""What a camera sees of a ball, and how near to its rim a surface that may be off is still believed."""

import numpy as np
import pytest
from shapes import sphere

from shared.gather import BALL_MM, MAXIMUM_LEAST_COSINE, MINIMUM_VIEW_COSINE, SurfaceViewer
from shared.geometry import rigid

DISTANCE, FOCAL, SIZE = 5000.0, 20000.0, 640


def seen_radius(viewer):
    """Farthest from the picture's middle that a vertex is seen, mm on the ball."""
    lens = np.array([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]])
    view = viewer.view(rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, DISTANCE])), lens, (SIZE, SIZE))
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
