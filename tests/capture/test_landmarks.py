"""The face networks on rendered heads, whose true landmarks are known, and the geometry around them."""

import cv2
import numpy as np
import pytest

from shared.capture.landmarks import (
    EYE_CORNERS_LEFT,
    EYE_CORNERS_RIGHT,
    LIPS,
    OVAL,
    Detection,
    FaceNetworks,
    _crop_to_image,
    _suppress,
    _windows,
)
from shared.errors import InputError
from shared.geometry.transforms import rotation_from_vector
from shared.tracking.models import load_face_networks, load_head_model
from tools.setup.head_model.embedding import DISTANCE_MM, FOCAL_LENGTH_PX, RENDER_SIZE, render_head

LIGHT = (0.3, 0.4, 0.8)


@pytest.fixture(scope="module")
def networks() -> FaceNetworks:
    try:
        return load_face_networks()
    except InputError as error:
        pytest.skip(f"the face networks are not set up: {error}")


@pytest.fixture(scope="module")
def portrait(networks):
    """A picture of another head than the mean, and where its landmarks truly are: uint8 [H, W, 3], [468, 2] px."""
    model = load_head_model()
    level = model.subdivided().subdivided()
    vertices = level.shape(0.7 * np.random.default_rng(12).standard_normal(50))
    colour = np.tile([0.62, 0.42, 0.33], (len(vertices), 1))
    colour[np.unique(level.faces[level.segment("lips")])] = (0.52, 0.24, 0.22)
    colour[np.unique(level.faces[level.segment("brows")])] = (0.15, 0.1, 0.08)
    colour[np.unique(level.faces[level.segment("eyes")])] = (0.75, 0.72, 0.7)
    rotation = rotation_from_vector(np.array([0.05, 0.15, 0.0]))
    picture, _, _ = render_head(vertices, level.faces, colour, rotation, LIGHT)
    points = level.landmarks(vertices) @ rotation.T
    truth = points[:, :2] * (1, -1) * (FOCAL_LENGTH_PX / (DISTANCE_MM - points[:, 2:])) + RENDER_SIZE / 2
    return picture, truth


def _inner() -> np.ndarray:
    return np.setdiff1d(np.arange(468), OVAL)


class TestGeometry:
    def test_crop_is_a_similarity_around_the_face(self):
        crop = _crop_to_image(np.array([100.0, 50.0]), 80.0, np.array([3.0, 4.0]))
        assert np.allclose(crop @ [96, 96, 1], [100, 50])
        assert np.allclose(crop[:, :2] @ [192, 0], 1.5 * 80 * np.array([0.6, 0.8]))
        assert np.linalg.det(crop[:, :2]) == pytest.approx((1.5 * 80 / 192) ** 2)

    @pytest.mark.parametrize("size", [(480, 270), (270, 480), (300, 300)])
    def test_windows_cover_the_picture_with_overlap(self, size):
        covered = np.zeros(size[::-1], int)
        for x0, y0, x1, y1 in _windows(*size, 130):
            assert x1 - x0 == y1 - y0 == 130
            covered[y0:y1, x0:x1] += 1
        assert covered.min() >= 1 and covered[size[1] // 2, size[0] // 2] >= 2

    def test_suppression_merges_overlaps_and_keeps_neighbours(self):
        def at(x: float, score: float) -> Detection:
            return Detection(score, np.array([x, 0, x + 10, 10]), np.full((6, 2), x))

        kept = _suppress([at(1.0, 0.6), at(0.0, 0.9), at(40.0, 0.7)])
        assert [d.score for d in kept] == [0.9, 0.7]
        assert kept[0].box[0] == pytest.approx((0.9 * 0.0 + 0.6 * 1.0) / 1.5)
        assert _suppress([]) == []


class TestNetworks:
    def test_landmarks_are_where_the_head_has_them(self, networks, portrait):
        picture, truth = portrait
        (found,) = networks.detect(picture)
        assert found.score > 0.8
        presence, points = networks.landmarks(picture, found)
        face_width = np.ptp(truth[list(OVAL), 0])
        error = np.linalg.norm(points[:, :2] - truth, axis=1) / face_width
        assert presence > 0.99 and np.median(error[_inner()]) < 0.04 and np.median(error[list(LIPS)]) < 0.05

    def test_keypoints_and_points_agree_on_the_sides(self, networks, portrait):
        picture, truth = portrait
        found = networks.detect(picture)[0]
        _, points = networks.landmarks(picture, found)
        assert found.keypoints[0, 0] < found.keypoints[1, 0]
        for keypoint, corners in ((0, EYE_CORNERS_RIGHT), (1, EYE_CORNERS_LEFT)):
            for place in (points[list(corners), :2].mean(0), truth[list(corners)].mean(0)):
                assert np.linalg.norm(found.keypoints[keypoint] - place) < 8

    def test_half_a_pixel_of_shift_is_half_a_pixel(self, networks, portrait):
        """Pixel centres at +0.5: enlarging a picture n times multiplies landmark coordinates by n."""
        picture, _ = portrait
        _, points = networks.landmarks(picture, networks.detect(picture)[0])
        large = cv2.resize(picture, None, fx=3, fy=3, interpolation=cv2.INTER_LINEAR)
        _, large_points = networks.landmarks(large, networks.detect(large)[0])
        offset = (large_points[:, :2] - 3 * points[:, :2])[_inner()]
        assert np.all(np.abs(offset.mean(0)) < 0.5)

    @pytest.mark.parametrize("degrees", [-30, 25])
    def test_turned_pictures_give_turned_landmarks(self, networks, portrait, degrees):
        picture, _ = portrait
        _, points = networks.landmarks(picture, networks.detect(picture)[0])
        turn = cv2.getRotationMatrix2D((RENDER_SIZE / 2 - 0.5, RENDER_SIZE / 2 - 0.5), degrees, 1.0)
        turned = cv2.warpAffine(picture, turn, (RENDER_SIZE, RENDER_SIZE), borderMode=cv2.BORDER_REPLICATE)
        _, turned_points = networks.landmarks(turned, networks.detect(turned)[0])
        expected = (points[:, :2] - 0.5) @ turn[:, :2].T + turn[:, 2] + 0.5
        assert np.median(np.linalg.norm(turned_points[:, :2] - expected, axis=1)) < 3.0

    def test_tracking_needs_no_detection(self, networks, portrait):
        picture, _ = portrait
        _, points = networks.landmarks(picture, networks.detect(picture)[0])
        shifted = np.roll(picture, (4, -6), axis=(0, 1))
        presence, tracked = networks.track(shifted, points)
        assert presence > 0.99
        assert np.median(np.linalg.norm(tracked[:, :2] - points[:, :2] - (-6, 4), axis=1)) < 1.5

    @pytest.mark.parametrize(("size", "face_scale"), [((480, 270), 0.35), ((1280, 720), 0.35), ((1280, 720), 0.6)])
    def test_small_faces_are_found(self, networks, portrait, size, face_scale):
        picture, truth = portrait
        small = cv2.resize(picture, None, fx=face_scale, fy=face_scale, interpolation=cv2.INTER_AREA)
        frame = np.full((size[1], size[0], 3), 124, np.uint8)
        x, y = size[0] // 2 + 20, size[1] // 3
        frame[y : y + small.shape[0], x : x + small.shape[1]] = small
        presence, points = networks.landmarks(frame, networks.detect(frame)[0])
        error = points[:, :2] - (truth * face_scale + (x, y))
        assert presence > 0.9
        assert np.median(np.linalg.norm(error[_inner()], axis=1)) < 0.05 * face_scale * np.ptp(truth[:, 0])

    def test_two_faces_are_two(self, networks, portrait):
        picture, _ = portrait
        found = networks.detect(np.concatenate([picture, picture[:, ::-1]], axis=1))
        assert len(found) == 2 and abs(found[0].box[0] - found[1].box[0]) > RENDER_SIZE / 2

    def test_one_face_is_found_without_its_neighbours_and_two_are_not(self, networks, portrait):
        picture, _ = portrait
        presence, points = networks.find_alone(picture, 0.5)
        for previous in (None, points + 20.0):
            expected_presence, expected = networks.find(picture, previous, 0.5)
            assert presence == pytest.approx(expected_presence, abs=1e-4)
            assert np.allclose(points, expected, atol=1e-3)
        assert networks.find_alone(np.concatenate([picture, picture[:, ::-1]], axis=1), 0.5) is None
        assert networks.find_alone(np.full_like(picture, 90), 0.5) is None
        assert networks.find_alone(picture, 1.1) is None

    def test_nothing_is_found_where_nothing_is(self, networks):
        noise = np.random.default_rng(3).integers(0, 256, (240, 320, 3), dtype=np.uint8)
        assert networks.detect(noise) == [] and networks.detect(np.full_like(noise, 90)) == []

    def test_person_mask_covers_the_head(self, networks, portrait):
        picture, truth = portrait
        mask = networks.person_mask(picture)
        assert mask.shape == picture.shape[:2] and mask.dtype == np.float32
        assert mask.min() >= 0 and mask.max() <= 1
        centre = truth.mean(0).astype(int)
        assert mask[centre[1], centre[0]] > 0.9 and mask[:20, :20].max() < 0.1

    def test_a_damaged_network_is_one_clear_line(self, tmp_path):
        path = tmp_path / "face.tflite"
        path.write_bytes(b"not a network")
        with pytest.raises(InputError, match="run make setup"):
            FaceNetworks(path, path, path)
