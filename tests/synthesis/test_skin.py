"""Synthetic skin beside measured faces."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from shared.appearance.measured_skin import MEASURED_SKINS, PERSON_SIGMA
from shared.imaging.color import LUMINANCE
from tools.synthesis.head import random_head
from tools.synthesis.skin import (
    HAEMOGLOBIN_ABSORPTION,
    HAEMOGLOBIN_SPREAD,
    YELLOW_SPREAD,
    Complexion,
    SkinPainter,
    skin_of,
)
from tools.synthesis.subject import PRESETS, head_model, light_of


@pytest.mark.parametrize("measured", MEASURED_SKINS, ids=[f"Y{skin @ LUMINANCE:.2f}" for skin in MEASURED_SKINS])
def test_every_measured_tone_is_some_amount_of_melanin(measured):
    nearest = minimize_scalar(lambda tone: np.square(np.log(skin_of(tone) / measured)).sum(), bounds=(0.1, 1.7))
    np.testing.assert_allclose(np.log(skin_of(nearest.x) / measured), 0.0, atol=0.07)


def test_the_stated_tones_are_the_lightest_and_the_darkest():
    np.testing.assert_allclose(skin_of(0.15), MEASURED_SKINS[0], rtol=0.06)
    np.testing.assert_allclose(skin_of(1.6), MEASURED_SKINS[-1], rtol=0.06)


def test_people_differ_as_measured_ones_do():
    """Fair skin, on which the light that no pigment takes away is little."""
    per_amount = HAEMOGLOBIN_ABSORPTION[1] - HAEMOGLOBIN_ABSORPTION[0]
    assert abs(HAEMOGLOBIN_SPREAD * per_amount - PERSON_SIGMA[0]) < 0.01
    assert abs(YELLOW_SPREAD - PERSON_SIGMA[1]) < 0.01


@pytest.mark.parametrize("tone", [0.2, 0.9])
def test_a_painted_face_has_the_tone_that_is_asked_for(tone):
    """Medians of cheeks and forehead over a few people: within what people differ by."""
    head = random_head(head_model(0), 0, False)
    ratios = []
    for seed in range(6):
        painter = SkinPainter(head, 96, seed)
        albedo = painter.paint(Complexion(tone=tone, freckles=0.0)).albedo
        skin = np.median(albedo[painter.inside("forehead", "cheek_left", "cheek_right")], axis=0)
        ratios.append(np.log(skin / skin_of(tone)))
    assert np.abs(np.mean(ratios, axis=0)).max() < 0.15
    tint = np.array(ratios)[:, 0] - np.array(ratios)[:, 1]
    assert 0.02 < tint.std(ddof=1) < 0.16


def test_dark_skin_is_exposed_for_by_half():
    """What faces the light's middle: fair skin as bright as the default's, dark skin darker, but by half in stops."""
    def brightness(tone):
        settings = replace(PRESETS["tiny"], tone=tone)
        return float(light_of("even", settings).mean() * skin_of(tone).mean())

    usual = brightness(PRESETS["tiny"].tone)
    assert brightness(0.15) == pytest.approx(usual, rel=1e-5)
    darker = skin_of(1.6).mean() / skin_of(PRESETS["tiny"].tone).mean()
    assert brightness(1.6) == pytest.approx(usual * np.sqrt(darker), rel=1e-5)
    assert darker < 0.2
