"""Widths of edges and shares of noise against pictures made with known ones."""

import cv2
import numpy as np
import pytest

from shared.imaging.color import encode_srgb
from shared.imaging.picture_detail import ClipDetail, edge_width, noise_share


def patches(blur_px, noise=0.0, level=0.3, seed=0):
    """Squares of several greys in every direction, blurred; noise in linear light."""
    rng = np.random.default_rng(seed)
    large = np.kron(rng.uniform(0.2, 1.0, (8, 8)), np.ones((96, 96))).astype(np.float32)
    turned = cv2.warpAffine(large, cv2.getRotationMatrix2D((384, 384), 20, 1.0), (768, 768), borderMode=cv2.BORDER_WRAP)
    light = level * cv2.resize(turned, (192, 192), interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(light, (0, 0), blur_px) if blur_px else light
    light = light + noise * rng.normal(size=light.shape)
    return np.repeat(np.uint8(np.round(255 * encode_srgb(np.clip(light, 0, 1))))[..., None], 3, axis=2)


INSIDE = np.zeros((192, 192), bool)
INSIDE[20:-20, 20:-20] = True


@pytest.mark.parametrize("blur_px", [1.5, 2.5, 4.0])
def test_the_width_of_edges_is_that_of_the_blur(blur_px):
    assert edge_width(patches(blur_px), INSIDE) == pytest.approx(np.hypot(blur_px, 0.4), rel=0.2)


def test_sharp_edges_are_thin_with_noise_too():
    assert edge_width(patches(0.0), INSIDE) < 1.0
    assert edge_width(patches(2.5, noise=0.004), INSIDE) == pytest.approx(2.5, rel=0.3)


def test_blur_along_one_direction_counts():
    smeared = cv2.blur(patches(0.7), (9, 1))
    assert edge_width(smeared, INSIDE) > 2.0 > 1.3 > edge_width(patches(0.7), INSIDE)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_noise_is_told_from_drawing(share):
    level = 0.3 * 0.65
    assert noise_share(patches(0.7, share * level), INSIDE) == pytest.approx(share, rel=0.3)
    assert noise_share(patches(0.7), INSIDE) < 0.012


def warnings_of(picture, height_px):
    detail = ClipDetail(60)
    for number in range(60):
        detail.look(number, picture, INSIDE, height_px)
    return detail.warnings()


def test_only_blurred_or_noisy_clips_are_complained_of():
    assert warnings_of(patches(0.7), 150.0) == []
    blurred = warnings_of(patches(3.0), 150.0)
    assert len(blurred) == 1 and "blurred" in blurred[0] and "px high" in blurred[0]
    assert warnings_of(patches(3.0), 800.0) == []  # a large face shows enough detail all the same
    noisy = warnings_of(patches(0.7, 0.3 * 0.2), 150.0)
    assert len(noisy) == 1 and "noise is" in noisy[0]


def test_a_face_that_is_hardly_seen_says_nothing():
    detail = ClipDetail(3)
    detail.look(0, patches(3.0), np.zeros((192, 192), bool), 150.0)
    assert detail.warnings() == []
