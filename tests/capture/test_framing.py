"""The crop, its camera, and the pixels and masks inside it."""

import cv2
import numpy as np
import pytest
from toy_video import DrawnFaceNetworks, drawn_face, oval_landmarks

from shared.capture.cameras import source_intrinsics
from shared.capture.crop_pixels import area_average, display_codes, frame_mask
from shared.capture.framing import Crop, choose_crop, crop_intrinsics, face_height, head_box, own_region, pinhole
from shared.geometry.transforms import project
from shared.io.source import VideoInfo

RNG = np.random.default_rng(5)


@pytest.mark.parametrize(("side", "max_size"), [(500, 1024), (1100, 1024), (2000, 1024), (3100, 1000), (1500, 128)])
def test_the_crop_holds_every_head_in_whole_pixels(side, max_size):
    boxes = np.array([[100.3, 50.2, 100.3 + 0.8 * side, 50.2 + side], [140, 60, 150 + 0.8 * side, 40 + side]])
    crop = choose_crop(boxes, 4000, 3600, max_size)
    assert all(isinstance(value, int) for value in crop[:4])
    assert crop.x0 <= 100 and crop.y0 <= 50
    assert crop.x0 + crop.width >= boxes[:, 2].max() and crop.y0 + crop.height >= boxes[:, 3].max()
    assert max(crop.size) <= max_size
    assert (crop.width * crop.scale, crop.height * crop.scale) == crop.size
    assert crop.scale == 1 or max(crop.size) > 0.75 * max_size


def test_the_crop_stays_inside_the_picture():
    crop = choose_crop(np.array([[-40.0, -20, 700, 900]]), 640, 480, 1024)
    assert crop == Crop(0, 0, 640, 480, 1.0)
    small = choose_crop(np.array([[-40.0, -20, 2000, 1000]]), 1999, 1001, 512)
    assert small.x0 + small.width <= 1999 and small.y0 + small.height <= 1001 and max(small.size) <= 512


def test_crop_intrinsics_project_as_scaled_and_shifted_pixels():
    points, pose = RNG.uniform(-80, 80, (20, 3)), np.eye(4)
    pose[:3, 3] = 5, -10, 600
    crop = Crop(200, 120, 640, 512, 22 / 32)
    intrinsics = pinhole(1500, 1280, 720)
    source, _ = project(points, pose, intrinsics)
    cropped, _ = project(points, pose, crop_intrinsics(intrinsics, crop))
    assert np.allclose(cropped, (source - (200, 120)) * crop.scale, atol=1e-9)


def test_focal_lengths():
    info = VideoInfo(width=1280, height=720, fps=25, frame_count=10, codec="h264")
    upright = VideoInfo(width=720, height=1280, fps=25, frame_count=10, codec="h264", rotation=270)
    phone = VideoInfo(width=1920, height=1080, fps=30, frame_count=10, codec="hevc", focal_length_35mm=26.0)
    assert source_intrinsics(info, focal_length_px=1500.0)[0][0, 0] == 1500
    assert source_intrinsics(info, None, 60.0, 22.3)[0][0, 0] == pytest.approx(60 / 22.3 * 1280)
    assert source_intrinsics(upright, None, 60.0, 22.3)[0][1, 1] == pytest.approx(60 / 22.3 * 1280)
    intrinsics, known, note = source_intrinsics(upright)
    assert not known and "guess" in note and intrinsics[0, 0] == pytest.approx(1.3 * 1280)
    assert intrinsics[:2, 2].tolist() == [360, 640]
    assert source_intrinsics(phone)[0][0, 0] == pytest.approx(26 / 36 * 1920)


def test_the_head_box_grows_with_hair_of_this_person_only():
    points = oval_landmarks(np.array([200.0, 200.0]), np.array([60.0, 80.0]))
    assert face_height(points) == pytest.approx(160)
    bald = head_box(points)
    mask = np.zeros((500, 500), np.float32)
    cv2.ellipse(mask, (200, 190), (90, 150), 0, 0, 360, 1, -1)
    cv2.rectangle(mask, (310, 60), (400, 300), 1, -1)
    hairy = head_box(points, mask)
    assert hairy[1] == pytest.approx(40, abs=4) and bald[1] == pytest.approx(120 - 0.35 * 160)
    assert hairy[2] < 310 and hairy[3] == bald[3]
    shifted = head_box(points, mask[20:, 30:], (30, 20))
    assert np.allclose(shifted, hairy, atol=1.5)
    assert own_region(mask > 0.5, np.array([150, 150, 250, 250]))[100, 350] == np.False_


def test_scaling_down_averages_light_not_codes():
    codes = np.zeros((64, 64, 3), np.uint8)
    codes[::2] = 255
    small = area_average(codes, (32, 32), "srgb")
    assert small.dtype == np.uint8 and np.all(small == 188)  # sRGB code of linear 0.5
    assert area_average(codes, (64, 64), "srgb") is codes
    deep = area_average((codes.astype(np.uint16) * 257), (32, 32), "linear")
    assert deep.dtype == np.uint16 and np.all(np.abs(deep.astype(int) - 32768) <= 1)


def test_networks_see_srgb_whatever_the_transfer():
    linear = np.full((4, 4, 3), 0.2140, np.float32)
    assert np.all(display_codes(np.rint(linear * 65535).astype(np.uint16), "linear") == 127)
    codes = RNG.integers(0, 256, (4, 4, 3), np.uint8)
    assert display_codes(codes, "srgb") is codes


def test_masks_of_a_drawn_face():
    rgb = drawn_face((120, 95))
    points = oval_landmarks(np.array([120.0, 95.0]), np.array([40.0, 50.0]))
    mask = frame_mask(rgb, DrawnFaceNetworks().person_mask(rgb), points)
    y, x = np.mgrid[0:200, 0:240] + 0.5
    person = ((x - 120) / 45) ** 2 + ((y - 95) / 60) ** 2 <= 1
    oval = ((x - 120) / 40) ** 2 + ((y - 95) / 50) ** 2 <= 1
    assert set(np.unique(mask)) == {0, 128, 255}
    assert np.count_nonzero((mask > 0) != person) < 0.02 * person.sum()
    assert np.count_nonzero((mask == 255) != (oval & person)) < 0.03 * oval.sum()


def test_background_behind_a_thin_bridge_is_not_the_person():
    rgb = drawn_face((120, 95))
    person = DrawnFaceNetworks().person_mask(rgb)
    cv2.rectangle(person, (180, 20), (230, 80), 1, -1)
    cv2.line(person, (150, 60), (185, 60), 1, 2)
    points = oval_landmarks(np.array([120.0, 95.0]), np.array([40.0, 50.0]))
    assert not frame_mask(rgb, person, points)[:, 180:].any()
