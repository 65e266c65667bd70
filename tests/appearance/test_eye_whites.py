"""The whites of the eyes: which pictures of them count, and what they say of the light's scale."""

from __future__ import annotations

import numpy as np
import pytest
from field_check import below, field_faults
from shapes import FACING, two_balls

from shared.appearance.albedo_scale import Highlights, resolve_scale
from shared.appearance.chart_scale import describe_scale
from shared.appearance.eye_whites import (
    LEAST_FRAMES,
    LEVEL_SIGMA,
    USUAL_ALBEDO,
    WITHIN_MM,
    WhitesSeen,
    describe_whites,
    whites_statement,
)
from shared.appearance.measured_skin import TYPICAL_SKIN
from shared.contract.records import SOLVE
from shared.geometry.eyeballs import IRIS_MM, gaze_rotation
from shared.geometry.transforms import camera_centres, project, rigid
from shared.imaging.image_sampling import Samples, SurfaceViewer, prepare_picture
from shared.imaging.turning_eyes import TurningEyes, depth_in_polygon
from shared.imaging.views import Views

SIZE, FOCAL_LENGTH, DEPTH_MM = (240, 120), 1300.0, 500.0
LENS = np.array([[FOCAL_LENGTH, 0, 120], [0, FOCAL_LENGTH, 60], [0, 0, 1]])
POSE = rigid(FACING, np.array([0.0, 0.0, DEPTH_MM]))
CENTRES, RADIUS = np.array([[-25.0, 0.0, 0.0], [25.0, 0.0, 0.0]]), 12.0
WHITE, IRIS, SKIN = np.array([0.6, 0.55, 0.5]), 0.05, np.array([0.5, 0.25, 0.2])
FRAMES = 6
GAZES = np.random.default_rng(3).uniform(-0.3, 0.3, (FRAMES, 2, 2))


def opening(half_height_mm: float) -> np.ndarray:
    """[2, 16, 2] px: an almond about each eyeball's front."""
    around = 2.0 * np.pi * np.arange(16) / 16
    rim = np.stack([10.0 * np.cos(around), half_height_mm * np.sin(around), np.full(16, RADIUS)], 1)
    return np.stack([project(centre + rim, POSE, LENS)[0] for centre in CENTRES])


def picture_of(gaze: np.ndarray, lids_px: np.ndarray, clipped: bool = False):
    """A frame of both eyes behind skin with two openings, closed form."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    rays = np.stack([(u - 120) / FOCAL_LENGTH, (v - 60) / FOCAL_LENGTH, np.ones_like(u)], axis=-1) @ POSE[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    linear = np.broadcast_to(SKIN.astype(np.float32), (*u.shape, 3)).copy()
    for centre, own, polygon in zip(CENTRES, gaze, lids_px, strict=True):
        away = centre - camera_centres(POSE[None])[0]
        along = rays @ away
        squared = RADIUS**2 - away @ away + along**2
        inside = depth_in_polygon(np.stack([u.ravel(), v.ravel()], 1), polygon).reshape(u.shape) > 0.0
        seen = (squared > 0) & inside
        outward = ((along - np.sqrt(np.maximum(squared, 0.0)))[..., None] * rays - away) / RADIUS
        local = outward[seen] @ gaze_rotation(own)
        iris = (np.hypot(local[:, 0], local[:, 1]) * RADIUS < IRIS_MM) & (local[:, 2] > 0)
        linear[seen] = np.where(iris[:, None], IRIS, WHITE)
    codes = np.full((*u.shape, 3), 255 if clipped else 128, np.uint8)
    return prepare_picture(codes, linear, np.full(u.shape, 255, np.uint8))


def views_of(gazes: np.ndarray, lids_px: np.ndarray) -> Views:
    return Views.in_one_light(
        camera_from_head=np.tile(POSE, (len(gazes), 1, 1)), lens=LENS, size=SIZE, moves="head",
        read_picture=lambda f: None, read_mask=lambda f: None, gaze=gazes,
        lids_px=np.tile(lids_px, (len(gazes), 1, 1, 1)),
    )


def seen_in(gazes: np.ndarray, half_height_mm: float, clipped: bool = False) -> WhitesSeen:
    surface = two_balls(CENTRES, RADIUS)
    lids_px = opening(half_height_mm)
    whites = WhitesSeen(TurningEyes.of(surface), SurfaceViewer.of(surface.mesh).scene, views_of(gazes, lids_px))
    pictures = [picture_of(np.nan_to_num(gaze), lids_px, clipped) for gaze in gazes]
    assert list(whites.looked_at(pictures)) == pictures
    return whites


def test_only_the_white_well_within_the_lids_counts():
    """No sample has a trace of iris or skin, whatever the gaze; and much of the white is seen."""
    rows, samples = seen_in(GAZES, 4.5).samples(np.ones(FRAMES, bool))
    found = samples.colours[samples.weight > 0]
    assert len(rows) > 24 and len(found) > 100
    np.testing.assert_allclose(found, np.broadcast_to(WHITE, found.shape), atol=0.01)


def test_places_lie_in_the_opening_by_the_margin():
    whites = seen_in(GAZES, 4.5)
    rows, samples = whites.samples(np.ones(FRAMES, bool))
    pixels, depth = project(whites.places.positions[rows], POSE, LENS)
    within = np.max([depth_in_polygon(pixels, polygon) for polygon in opening(4.5)], axis=0)
    assert (within * depth / FOCAL_LENGTH).min() > WITHIN_MM


@pytest.mark.parametrize("why", ["shut", "narrow", "held out"])
def test_what_shows_no_white_says_nothing(why):
    gazes = np.full_like(GAZES, np.nan) if why == "shut" else GAZES
    whites = seen_in(gazes, 1.0 if why == "narrow" else 4.5)
    fitted = np.arange(FRAMES) < (LEAST_FRAMES - 1 if why == "held out" else FRAMES)
    assert not len(whites.samples(fitted)[0])


def test_whites_that_are_burnt_out_say_nothing():
    rows, samples = seen_in(GAZES, 4.5, clipped=True).samples(np.ones(FRAMES, bool))
    assert len(rows) > 24 and (samples.saturation[samples.weight > 0] == 1).all()
    assert whites_statement(samples, np.ones((3, *samples.weight.shape))) is None


@pytest.mark.parametrize("clip", [0.55, 0.45])
def test_what_burns_out_does_not_leave_the_shaded_part_to_speak(clip):
    """Albedo about USUAL_ALBEDO, of which all above clip is burnt out: the median is the same while it is not."""
    scatter = 0.1 * np.random.default_rng(2).normal(size=(40, 12))
    irradiance = np.ones((3, 40, 12))
    samples = samples_of(np.full(3, USUAL_ALBEDO), irradiance, scatter)
    full, _ = whites_statement(samples, irradiance)
    burnt = samples.colours > clip
    cut = Samples(np.minimum(samples.colours, clip), samples.weight, burnt.astype(np.int8), samples.towards_camera)
    said = whites_statement(cut, irradiance)
    if clip < USUAL_ALBEDO:
        assert said is None
    else:
        np.testing.assert_array_equal(said[0], full)
        kept = samples.colours[~burnt.any(-1)]
        assert np.median(kept) < 0.94 * USUAL_ALBEDO


def samples_of(albedo: np.ndarray, irradiance: np.ndarray, error: np.ndarray) -> Samples:
    colours = np.moveaxis(albedo[:, None, None] * irradiance, 0, -1) + error[..., None]
    shape = colours.shape[:2]
    return Samples(colours, np.ones(shape), np.zeros(colours.shape, np.int8), np.zeros((*shape, 3)))


def test_a_light_twice_too_bright_makes_whites_half_as_bright():
    irradiance = np.random.default_rng(0).uniform(0.5, 1.5, (3, 20, 12))
    samples = samples_of(np.full(3, USUAL_ALBEDO), irradiance, np.zeros((20, 12)))
    log_factor, covariance = whites_statement(samples, 2.0 * irradiance)
    np.testing.assert_allclose(log_factor, -np.log(2.0), atol=1e-9)
    assert covariance.mean() == pytest.approx(LEVEL_SIGMA**2, rel=0.05)
    said = describe_whites(20, log_factor, covariance)
    np.testing.assert_allclose(said["albedo"], USUAL_ALBEDO / 2.0)
    described = describe_scale(None, np.array([0.5, 0.3, 0.22]), said)
    assert field_faults(described, below(SOLVE, "albedo_scale")) == []
    assert "whites of the eyes" in described["method"]


def test_shadows_that_the_light_gets_wrong_say_little_and_scatter_makes_unsure():
    """A third of the places lie in shadow and are far brighter than their light says."""
    irradiance = np.ones((3, 30, 12))
    irradiance[:, :10] = 0.05
    shadowed = np.zeros((30, 12))
    shadowed[:10] = 0.1
    log_factor, sure = whites_statement(samples_of(np.full(3, 0.5), irradiance, shadowed), irradiance)
    np.testing.assert_allclose(log_factor, 0.0, atol=1e-9)
    scattered = 0.5 * np.exp(0.8 * np.random.default_rng(1).normal(size=(30, 12))) - 0.5
    unsure = whites_statement(samples_of(np.full(3, 0.5), np.ones((3, 30, 12)), scattered), np.ones((3, 30, 12)))[1]
    assert unsure.mean() > 2.0 * sure.mean()
    of_tint = np.array([1.0, -1.0, 0.0])
    assert of_tint @ unsure @ of_tint > 2.0 * (of_tint @ sure @ of_tint), "what scatters them has a colour"


def test_whites_move_the_scale_as_far_as_they_are_sure():
    skin, wanted = np.log(TYPICAL_SKIN), np.full(3, -0.8)
    alone, *_ = resolve_scale(skin, np.zeros(3), None, (0.7, 0.25))

    def with_whites(sigma: float) -> np.ndarray:
        return resolve_scale(skin, np.zeros(3), None, (0.7, 0.25), whites=(wanted, sigma**2 * np.eye(3)))[0]

    np.testing.assert_allclose(with_whites(1e-3), wanted, atol=1e-3)
    np.testing.assert_allclose(with_whites(1e3), alone, atol=1e-3)
    assert (np.diff([factor.mean() for factor in map(with_whites, (0.1, 0.3, 1.0, 3.0))]) > 0).all()


def test_wide_highlights_do_not_darken_skin_beside_bright_whites():
    """Highlights that need twice their usual strength ask for twice the light; whites at their usual albedo do not."""
    skin = np.log(TYPICAL_SKIN)
    strong = Highlights(np.full(3, 1.4), np.full(3, 1e4), np.full(3, 5.0))
    whites = np.zeros(3), 0.33**2 + 0.5 * 0.15**2 * np.eye(3)
    without, *_ = resolve_scale(skin, np.zeros(3), strong, (0.7, 0.25))
    beside, intensity, *_ = resolve_scale(skin, np.zeros(3), strong, (0.7, 0.25), whites=whites)
    assert (without > 0.5).all() and (0.0 < beside).all() and (beside < 0.75 * without).all()
    assert intensity > 0.7


def test_highlights_that_contradict_the_whites_move_the_scale_by_little_at_a_time():
    """With two answers that are about as likely each step of the light would take the other."""
    skin = np.log(TYPICAL_SKIN)
    whites = np.full(3, -0.5), 0.33**2 + 0.5 * 0.15**2 * np.eye(3)

    def resolved(strength: float) -> float:
        found = Highlights(np.full(3, strength), np.full(3, 200.0), np.full(3, 10.0))
        return resolve_scale(skin - 0.2, np.zeros(3), found, (0.7, 0.25), whites=whites)[0].mean()

    moved = np.diff([resolved(strength) for strength in np.arange(0.7, 2.0, 0.02)])
    assert (0.0 < moved).all() and (moved < 0.02).all()
