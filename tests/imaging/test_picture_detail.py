"""Widths of edges and shares of noise against pictures made with known ones."""

import cv2
import numpy as np
import pytest

from shared.imaging.color import encode_srgb
from shared.imaging.picture_detail import ClipDetail, edge_width, flatness, noise_share


def patches(blur_px, noise=0.0, level=0.3, seed=0):
    """Squares of several greys in every direction, blurred; noise in linear light."""
    rng = np.random.default_rng(seed)
    large = np.kron(rng.uniform(0.05, 1.0, (8, 8)), np.ones((96, 96))).astype(np.float32)
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


@pytest.mark.parametrize(("curve", "flat"), [
    (encode_srgb, False),
    (lambda light: encode_srgb(np.minimum(2.0 * light, 1.0)), False),
    (lambda light: (420.0 + 261.5 * np.log10((light + 0.01) / 0.19)) / 1023.0, True),  # Sony's S-Log3
])
def test_a_logarithmic_curve_is_told_from_a_bright_picture(curve, flat):
    """A face of reflectance 0.4 with pupils and nostrils of 0.04."""
    light = np.full((192, 192), 0.4)
    light[90:110, 90:120] = 0.04
    codes = np.repeat(np.uint8(np.round(255 * curve(light)))[..., None], 3, axis=2)
    assert flatness(codes, INSIDE) == pytest.approx(curve(np.array(0.04)) / curve(np.array(0.4)), abs=0.02)
    assert any("logarithmic" in text for text in warnings_of(codes)) == flat


def warnings_of(*pictures, height_px=150.0):
    """Of a clip of 60 frames that show the pictures in turn."""
    detail = ClipDetail(60)
    for number in range(60):
        detail.look(number, pictures[number // 2 % len(pictures)], INSIDE, height_px)
    return detail.warnings()


def test_only_blurred_or_noisy_clips_are_complained_of():
    assert warnings_of(patches(0.7)) == []
    blurred = warnings_of(patches(3.0))
    assert len(blurred) == 1 and "blurred" in blurred[0] and "px high" in blurred[0]
    assert warnings_of(patches(3.0), height_px=800.0) == []  # a large face shows enough detail all the same
    noisy = warnings_of(patches(0.7, 0.3 * 0.2))
    assert len(noisy) == 1 and "noise is" in noisy[0]


def test_frames_that_a_motion_blurs_are_noticed_among_sharp_ones():
    sharp, smeared = patches(1.2), cv2.blur(patches(1.2), (15, 1))
    found = warnings_of(sharp, sharp, sharp, smeared)
    assert len(found) == 1 and "blurred by motion" in found[0]
    assert warnings_of(sharp, sharp, sharp, smeared, height_px=800.0) == []
    assert warnings_of(sharp, sharp, sharp, patches(1.5)) == []


def test_a_face_that_is_hardly_seen_says_nothing():
    detail = ClipDetail(3)
    detail.look(0, patches(3.0), np.zeros((192, 192), bool), 150.0)
    assert detail.warnings() == []
