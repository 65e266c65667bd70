"""The iris network on drawn eyes, whose centre, rim and lids are known."""

import cv2
import numpy as np
import pytest

from shared.capture.iris import BESIDE_LIDS_PX, LOWER_LID, UPPER_LID, EyePicture, EyePoints, crop_of_eye
from shared.tracking.models import own_iris_network

HEIGHT, WIDTH, ENLARGED = 120, 160, 8
CORNERS = np.array([[52.0, 62.0], [108.0, 60.0]])
"""Outer and inner, of a subject's right eye."""
CENTRE, RADIUS = np.array([76.0, 58.0]), 11.0


@pytest.fixture(scope="module")
def network():
    return own_iris_network()


def drawn_eye() -> np.ndarray:
    """Skin, an almond of white between the corners, an iris with a pupil: uint8 [H, W, 3]."""
    big = np.full((HEIGHT * ENLARGED, WIDTH * ENLARGED, 3), (196, 150, 128), np.uint8)
    along = np.linspace(0, 1, 60)[:, None]
    arch = np.sin(np.pi * along) * (0.0, 1.0)
    line = CORNERS[0] + along * (CORNERS[1] - CORNERS[0])
    almond = np.concatenate([line - 13.0 * arch, (line + 10.0 * arch)[::-1]])
    inside = np.zeros(big.shape[:2], np.uint8)
    cv2.fillPoly(inside, [np.rint(almond * ENLARGED).astype(np.int32)], 1)
    ball = np.full_like(big, (226, 220, 214))
    centre = tuple(np.rint(CENTRE * ENLARGED).astype(int).tolist())
    cv2.circle(ball, centre, round(RADIUS * ENLARGED), (92, 74, 56), -1)
    cv2.circle(ball, centre, round(0.4 * RADIUS * ENLARGED), (14, 12, 12), -1)
    big[inside == 1] = ball[inside == 1]
    cv2.polylines(big, [np.rint(almond * ENLARGED).astype(np.int32)], True, (70, 45, 40), ENLARGED)
    return cv2.resize(big, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def mirrored(points: np.ndarray) -> np.ndarray:
    return points * (-1, 1) + (WIDTH, 0)


def test_the_crop_is_turned_level_and_its_x_runs_inwards():
    for left, corners in ((False, CORNERS), (True, mirrored(CORNERS))):
        crop = crop_of_eye(corners, left)
        assert np.allclose(crop @ [32, 32, 1], corners.mean(0))
        assert np.allclose(crop[:, :2] @ [64, 0], 2.3 * (corners[1] - corners[0]))
        assert crop[1, 1] > 0 and np.sign(np.linalg.det(crop[:, :2])) == (-1 if left else 1)


def test_the_iris_is_where_it_was_drawn(network):
    found = network.eye(drawn_eye(), CORNERS)
    assert np.linalg.norm(found.iris[0] - CENTRE) < 1.0
    inner, above, outer, below = found.iris[1:]
    assert inner[0] - CENTRE[0] == pytest.approx(RADIUS, rel=0.15)
    assert CENTRE[0] - outer[0] == pytest.approx(RADIUS, rel=0.15)
    assert above[1] < CENTRE[1] < below[1]


def test_the_lids_enclose_the_iris_and_run_from_outer_to_inner_corner(network):
    lids = network.eye(drawn_eye(), CORNERS).lids
    lower, upper = lids[list(LOWER_LID)], lids[list(UPPER_LID)]
    assert (np.diff(lower[:, 0]) > 0).all() and (np.diff(upper[:, 0]) > 0).all()
    assert upper[4, 1] < CENTRE[1] < lower[4, 1]


def test_a_mirrored_picture_gives_mirrored_points(network):
    picture = drawn_eye()
    right = network.eye(picture, CORNERS)
    left = network.eye(np.ascontiguousarray(picture[:, ::-1]), mirrored(CORNERS), left=True)
    assert np.allclose(mirrored(left.iris), right.iris, atol=0.05)
    assert np.allclose(mirrored(left.lids), right.lids, atol=0.05)


def test_half_a_pixel_of_shift_is_half_a_pixel(network):
    """Pixel centres at +0.5: enlarging a picture n times multiplies the points by n."""
    picture = drawn_eye()
    large = cv2.resize(picture, None, fx=3, fy=3, interpolation=cv2.INTER_LINEAR)
    once, thrice = network.eye(picture, CORNERS), network.eye(large, 3 * CORNERS)
    assert np.abs(thrice.iris / 3 - once.iris).max() < 0.3


def test_both_eyes_come_from_the_face_and_a_hidden_one_is_none(network):
    landmarks = np.zeros((468, 2))
    landmarks[[33, 133]], landmarks[[263, 362]] = CORNERS, (80.0, 50.0)
    right, left = network.eyes(drawn_eye(), landmarks)
    assert isinstance(right, EyePoints) and left is None
    assert np.array_equal(right.iris, network.eye(drawn_eye(), CORNERS).iris)


def test_the_picture_of_an_eye_lies_about_its_lids_and_within_the_frame():
    rgb, lids = drawn_eye(), np.array([[2.2, 40.0], [30.0, 52.6]])
    picture = EyePicture.of(rgb, lids)
    first, last = 40 - BESIDE_LIDS_PX, 53 + BESIDE_LIDS_PX
    assert picture.corner.tolist() == [0, first] and picture.grey.shape == (last - first, 30 + BESIDE_LIDS_PX)
    assert np.array_equal(picture.grey, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)[first:last, : 30 + BESIDE_LIDS_PX])
    outside = EyePicture.of(rgb, lids + (WIDTH, 0))
    assert outside.grey.shape[1] >= 1 and outside.corner[0] <= WIDTH - 1
