"""Rims of irises: found in drawn mean pictures whatever is beside them, left to the network where little is seen."""

import numpy as np
import pytest
from scipy.special import ndtr

from shared.tracking.iris_rim import MeanPicture, fit_rims

NETWORK_MM = 5.4


def picture(centre=(0.0, 0.0), radius=5.9, lids=3.5, spacing=0.4, noise=1.0, glint=False, sides=(150.0, 220.0)):
    """A dark iris with a pupil and fibres on white that is brighter on one side, seen between lids so far from the
    middle."""
    along = np.arange(-8.4, 8.4, spacing)
    places = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    places = places[(np.linalg.norm(places, axis=1) < 8.4) & (np.abs(places[:, 1]) < lids)]
    arm = places - centre
    off, angle = np.linalg.norm(arm, axis=1), np.arctan2(arm[:, 1], arm[:, 0])
    iris = np.where(off < 2.2, 20.0, 80.0 + 6.0 * np.sin(9.0 * angle))
    white = np.mean(sides) + 0.5 * (sides[1] - sides[0]) * np.cos(angle)
    light = iris + ndtr((off - radius) / 0.4) * (white - iris)
    if glint:
        light[np.linalg.norm(places - [-4.5, 1.5], axis=1) < 1.2] = 255.0
    light += np.random.default_rng(3).normal(0.0, noise, len(light))
    return MeanPicture(places, light, np.ones(len(places)), spacing)


@pytest.mark.parametrize("case", [{}, {"glint": True}, {"lids": 2.8}, {"sides": (110.0, 230.0)}, {"spacing": 0.6}])
def test_a_circle_beside_the_networks_and_larger_is_found(case):
    centres = np.array([[0.6, 0.4], [-0.7, 0.3]])
    found, radius_mm = fit_rims([picture(centre=centre, **case) for centre in centres], NETWORK_MM)
    assert np.abs(found - centres).max() < (0.1 if case.get("lids") is None else 0.2)
    assert radius_mm == pytest.approx(5.9, rel=0.02)


def test_what_is_hardly_seen_stays_where_the_network_has_it():
    flat = MeanPicture(picture().places, np.full(len(picture().places), 90.0), np.ones(len(picture().places)), 0.4)
    found, radius_mm = fit_rims([flat, flat], NETWORK_MM)
    assert np.abs(found).max() < 0.01 and radius_mm == pytest.approx(NETWORK_MM, rel=1e-3)
    (across, up), *_ = fit_rims([picture((0.6, 0.4), lids=0.5)], NETWORK_MM)[0]
    assert abs(across - 0.6) < 0.1 and 0.0 < up < 0.3


def test_both_eyes_have_one_radius():
    """Of an eye that shows little the other one tells it."""
    _, alone = fit_rims([picture(radius=5.9)], NETWORK_MM)
    circles, both = fit_rims([picture(radius=5.9), picture(radius=5.9, lids=0.6)], NETWORK_MM)
    assert both == pytest.approx(alone, rel=0.005) and circles.shape == (2, 2)
