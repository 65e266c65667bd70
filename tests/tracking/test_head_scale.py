"""The head's size from irises, model and a given length."""

import numpy as np
import pytest

from shared.geometry.mesh import Mesh
from shared.geometry.surface import Surface
from shared.geometry.transforms import project, rigid
from shared.tracking.eyes import head_scale
from shared.tracking.fit_head import HeadFit
from shared.tracking.head_scale import (
    BY_MODEL,
    IRIS_DEVIATION_MM,
    IRIS_DIAMETER_MM,
    MODEL_DEVIATION,
    scale_by_iris,
    scale_by_length,
)
from shared.tracking.track_head import HeadTrack


def test_an_iris_of_the_mean_size_changes_nothing_and_makes_it_surer():
    found = scale_by_iris(0.5 * IRIS_DIAMETER_MM, 0.15)
    assert found.factor == pytest.approx(1.0) and found.log_deviation < MODEL_DEVIATION


def test_two_log_normals_are_combined_by_their_variances():
    radius, deviation = 5.4, 0.2
    variance = (IRIS_DEVIATION_MM / IRIS_DIAMETER_MM) ** 2 + (deviation / radius) ** 2
    grid = np.linspace(-0.4, 0.4, 80_001)
    told = np.log(0.5 * IRIS_DIAMETER_MM / radius)
    density = np.exp(-0.5 * ((grid - told) ** 2 / variance + grid**2 / MODEL_DEVIATION**2))
    mean = (grid * density).sum() / density.sum()
    spread = np.sqrt(((grid - mean) ** 2 * density).sum() / density.sum())
    found = scale_by_iris(radius, deviation)
    assert np.log(found.factor) == pytest.approx(mean, abs=1e-6)
    assert found.log_deviation == pytest.approx(spread, rel=1e-4)


def test_an_iris_that_is_hardly_measured_leaves_the_model():
    found = scale_by_iris(4.0, 40.0)
    assert found.factor == pytest.approx(1.0, abs=1e-3)
    assert found.log_deviation == pytest.approx(MODEL_DEVIATION, rel=1e-3)


def test_a_given_length_goes_before_both():
    centres = np.array([[-30.0, 32.0, 71.0], [30.0, 32.0, 71.0]])
    found = scale_by_length(66.0, centres, np.full((2, 3), 0.8))
    assert found.factor == pytest.approx(1.1)
    assert found.log_deviation == pytest.approx(np.hypot(0.5 / 66.0, np.sqrt(2) * 0.8 / 60.0))


@pytest.fixture
def tracked_head():
    rng = np.random.default_rng(1)
    points, vertices = rng.normal(0, 50, (20, 3)), rng.normal(0, 80, (30, 3))
    fit = HeadFit(1.3, np.eye(3)[[1, 2, 0]], np.array([3.0, -4.0, 9.0]), np.zeros(50), np.zeros(25), vertices)
    poses = rigid(np.tile(np.diag([1.0, -1.0, -1.0]), (4, 1, 1)), rng.normal(0, 9, (4, 3)) + (0, 0, 900.0))
    return HeadTrack(camera_from_head=poses, covariance=np.tile(np.eye(6) + 0.1, (4, 1, 1)), fit=fit,
                     points_head=points, sigma_mm=np.full(20, 0.2), error_px=np.zeros((4, 20)),
                     reliable=np.ones(4, bool), noise_factor=1.0, focal_gain=1.0, focal_deviation=0.01,
                     focal_solved=False, held_out_px=(0.2, 0.2))


def test_a_grown_head_looks_the_same(tracked_head):
    grown = tracked_head.scaled(1.07)
    intrinsics = np.array([[1500.0, 0, 300], [0, 1500.0, 280], [0, 0, 1]])
    small = tracked_head.points_head, tracked_head.fit.vertices
    for before, after in zip(small, (grown.points_head, grown.fit.vertices), strict=True):
        assert np.allclose(after, 1.07 * before)
        assert np.allclose(project(before, tracked_head.camera_from_head, intrinsics)[0],
                           project(after, grown.camera_from_head, intrinsics)[0])
    points = np.random.default_rng(2).normal(size=(5, 3))
    assert np.allclose(grown.fit.to_head(points), 1.07 * tracked_head.fit.to_head(points))
    ratio = np.diagonal(grown.covariance, axis1=1, axis2=2) / np.diagonal(tracked_head.covariance, axis1=1, axis2=2)
    assert np.allclose(ratio, [1, 1, 1, 1.07**2, 1.07**2, 1.07**2])


def test_without_irises_the_model_says_the_size_unless_a_length_is_given(model):
    surface = Surface(Mesh(model.template, model.faces, model.uvs, model.face_uvs), model.face_segment,
                      model.segment_names)
    assert head_scale(surface, None, None) == BY_MODEL and BY_MODEL.factor == 1.0
    given = head_scale(surface, None, 70.0)
    assert given.factor > 1.0 and "subject.yaml" in given.method
