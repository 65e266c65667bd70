"""What is known of skin before any clip: the table, the line through it and the surface's reflection."""

import colour
import numpy as np
import pytest

from shared.appearance.measured_skin import (
    BRIGHTEST_ALBEDO,
    LUMINANCE_SIGMA,
    MEASURED_SKINS,
    MEDIAN_LOG_LUMINANCE,
    PERSON_SIGMA,
    SURFACE_INTENSITY,
    SURFACE_SPREAD,
    fit_skin_locus,
)
from shared.imaging.color import LUMINANCE

# Median CIELAB of the readings about an individual typology angle, the surface's reflection included.
MEDIAN_CIELAB = {
    62: (68.2, 10.2, 10.2), 50: (65.7, 10.7, 13.4), 38: (62.2, 11.4, 15.7), 25: (58.3, 11.2, 17.9),
    12: (54.0, 11.7, 18.9), 0: (50.3, 11.7, 19.0), -15: (45.3, 11.1, 18.1), -30: (40.8, 11.0, 16.0),
    -45: (37.2, 10.2, 13.0), -60: (33.6, 8.7, 9.6),
}
D65 = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
SURFACE_REFLECTANCE = 0.028


def linear_of(cielab):
    return colour.XYZ_to_RGB(colour.Lab_to_XYZ(cielab, D65), "sRGB", apply_cctf_encoding=False)


@pytest.mark.parametrize("row, angle", list(enumerate(MEDIAN_CIELAB)))
def test_the_table_is_what_was_measured_less_the_surface(row, angle):
    """Medians of coordinates are not coordinates of medians: to 0.004 of albedo."""
    expected = linear_of(np.array(MEDIAN_CIELAB[angle])) - SURFACE_REFLECTANCE
    np.testing.assert_allclose(MEASURED_SKINS[row], expected, atol=0.004)
    lightness, _, yellow = MEDIAN_CIELAB[angle]
    assert abs(np.degrees(np.arctan2(lightness - 50.0, yellow)) - angle) < 4.0


def test_tones_run_from_light_to_dark_below_the_brightest():
    luminance = MEASURED_SKINS @ LUMINANCE
    assert (np.diff(luminance) < 0).all() and (np.diff(MEASURED_SKINS[:, 0]) < 0).all()
    assert MEASURED_SKINS.max() < BRIGHTEST_ALBEDO
    assert luminance[-1] < 0.04 < 0.35 < luminance[0]


def test_the_spread_of_luminance_holds_every_tone():
    away = np.abs(np.log(MEASURED_SKINS @ LUMINANCE) - MEDIAN_LOG_LUMINANCE) / LUMINANCE_SIGMA
    assert away.max() < 1.7


def test_the_locus_is_the_least_squares_line_and_no_tone_lies_off_it():
    locus = fit_skin_locus()
    luminance = np.log(MEASURED_SKINS @ LUMINANCE) - locus.mean_log_luminance
    chroma = np.log(MEASURED_SKINS[:, [0, 2]] / MEASURED_SKINS[:, [1]])
    residual = chroma - locus.offset - luminance[:, None] * locus.slope
    assert np.allclose(residual.sum(0), 0.0, atol=1e-9) and np.allclose(luminance @ residual, 0.0, atol=1e-9)
    assert (np.abs(residual) < 2.0 * locus.sigma).all() and (locus.sigma > PERSON_SIGMA).all()


@pytest.mark.parametrize("lightness, red, yellow", [
    (33.0, (6.6, 10.2), (7.1, 12.2)), (45.0, (9.1, 13.3), (15.8, 19.8)),
    (57.0, (9.1, 15.7), (13.9, 20.5)), (69.0, (7.0, 12.0), (11.7, 16.9)),
])
def test_people_of_one_lightness_differ_as_much_as_stated(lightness, red, yellow):
    """From the 10th and 90th percentiles of a* and b*, which span 2.56 standard deviations of a normal distribution;
    the darkest, whose blue is little more than the surface's, spread more in B/G."""
    def chroma(redness, yellowness):
        albedo = linear_of(np.array([lightness, redness, yellowness])) - SURFACE_REFLECTANCE
        return np.log(albedo[[0, 2]] / albedo[1])

    by_red = chroma(red[1], np.mean(yellow)) - chroma(red[0], np.mean(yellow))
    by_yellow = chroma(np.mean(red), yellow[1]) - chroma(np.mean(red), yellow[0])
    sigma = np.hypot(by_red, by_yellow) / 2.563
    assert abs(sigma[0] - PERSON_SIGMA[0]) < 0.025
    assert 0.06 < sigma[1] < (0.25 if lightness < 40 else 0.12)


def test_the_surface_has_the_index_that_is_stated():
    def intensity(index):
        return ((index - 1.0) / (index + 1.0)) ** 2 / 0.04

    assert abs(intensity(1.45) - SURFACE_INTENSITY) < 0.005
    assert abs(np.log(intensity(1.53) / SURFACE_INTENSITY) - SURFACE_SPREAD) < 0.03
    assert abs(np.log(SURFACE_INTENSITY / intensity(1.38)) - SURFACE_SPREAD) < 0.03
