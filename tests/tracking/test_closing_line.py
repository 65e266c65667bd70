"""The line between shut lids, drawn on a plane before a turning camera."""

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from shared.geometry.transforms import WORLD_FROM_CAMERA, project, rigid, rotation_from_vector
from shared.tracking.closing_line import LONGER, closing_line

SIZE = 160
LENS = np.array([[1800.0, 0.0, 80.0], [0.0, 1800.0, 80.0], [0.0, 0.0, 1.0]])
CENTRES = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).reshape(-1, 2) + 0.5
DOWN = np.array([0.0, -1.0, 0.0])
HALF_MM = 14.0


def poses(count: int = 12) -> np.ndarray:
    turn = np.stack([0 * np.linspace(-1, 1, count), np.linspace(-0.3, 0.3, count), 0 * np.arange(count)], axis=1)
    rotation = WORLD_FROM_CAMERA.T @ rotation_from_vector(turn)
    return rigid(rotation, np.broadcast_to([0.0, 0.0, 900.0], (count, 3)))


def line_at(x: np.ndarray, below_mm: float) -> np.ndarray:
    return np.stack([x, 0.012 * x**2 - 2.0 - below_mm, 0 * x], axis=-1)


def drawn(below_mm: float, longer: float, depth: int, fold: bool = False) -> list[np.ndarray]:
    """Contrast pictures with the line so far below the contour, by a share longer at its outer end (at -x)."""
    rng, pictures = np.random.default_rng(2), []
    x = np.linspace(-HALF_MM * (1 + 2 * longer), HALF_MM, 200)
    for pose in poses():
        noise = cv2.GaussianBlur(rng.standard_normal((SIZE, SIZE)), (0, 0), 1.0)
        picture = 128.0 + 6.0 * noise
        for down, dark in [(below_mm, depth)] + ([(below_mm + 4.5, depth // 2)] if fold else []):
            pixels = project(line_at(x, down), pose[None], LENS)[0][0]
            distance = cKDTree(pixels).query(CENTRES)[0].reshape(SIZE, SIZE)
            picture -= dark * np.exp(-0.5 * np.square(distance))
        pictures.append(np.clip(picture, 0, 255).astype(np.uint8))
    return pictures


CONTOUR = line_at(np.linspace(-HALF_MM, HALF_MM, 9), 0.0)


@pytest.mark.parametrize(("below_mm", "fold"), [(0.5, False), (2.0, False), (3.0, True)])
def test_the_line_is_found_where_it_is(below_mm, fold):
    found = closing_line(drawn(below_mm, 0.0, 100, fold), CONTOUR, DOWN, poses(), LENS)
    assert np.abs(found - line_at(found[:, 0], below_mm)).max() < 0.3
    assert found[0, 0] == pytest.approx(-HALF_MM, abs=2.0) and found[-1, 0] == pytest.approx(HALF_MM, abs=2.0)


def test_a_line_that_is_longer_than_the_contour_is_followed():
    found = closing_line(drawn(1.0, 0.15, 100), CONTOUR, DOWN, poses(), LENS)
    length = 2.0 * HALF_MM
    assert -HALF_MM - (LONGER + 0.02) * length < found[0, 0] < -HALF_MM - 0.1 * length


def test_without_a_line_it_is_where_it_is_expected():
    found = closing_line(drawn(0.0, 0.0, 0), CONTOUR, DOWN, poses(), LENS)
    below = line_at(found[:, 0], 0.0)[:, 1] - found[:, 1]
    assert (np.abs(below - 1.2) < 1.5).all() and np.ptp(found[:, 0]) == pytest.approx(2.0 * HALF_MM, rel=0.1)
