"""What keeps a rounding from becoming a result: choices with a margin, sums in doubles, OpenCV's plain code."""

import cv2
import numpy as np
import pytest
import shapes

from shared.geometry import rigid, rotation_from_vector
from shared.landmarks import _warped
from shared.processor import use_baseline_opencv
from shared.solve.first_poses import choose_references
from shared.solve.light import LightPriors
from shared.solve.light_models import make_light_model
from shared.solve.light_step import conjugate_gradients
from shared.tracks import local_contrast
from shared.transfer import spread_vertices


@pytest.fixture
def optimised():
    yield
    cv2.setUseOptimized(True)


def test_opencv_leaves_the_processors_own_code(optimised):
    assert cv2.useOptimized()
    use_baseline_opencv()
    assert not cv2.useOptimized()


def test_vertices_are_spread_alike_after_a_rounding():
    """Two vertices in one cell are equally far from their mean, and a cell's edge found by bisection lies on one."""
    vertices = shapes.sphere(levels=4).vertices
    chosen = spread_vertices(vertices, 300)
    rng = np.random.default_rng(0)
    for _ in range(5):
        assert np.array_equal(spread_vertices(vertices + 1e-12 * rng.normal(size=vertices.shape), 300), chosen)


def test_references_of_a_turn_and_back_do_not_hang_on_a_hair():
    """Each view is passed twice: the first one serves, whichever is nearer by a rounding."""
    yaw = np.r_[np.linspace(0, 0.5, 10), np.linspace(0.5, -0.5, 20), np.linspace(-0.5, 0, 10)]
    rng = np.random.default_rng(1)

    def chosen(noise):
        vectors = np.stack([0.01 * np.sin(7 * yaw), yaw, np.zeros_like(yaw)], axis=1)
        turns = rotation_from_vector(vectors + noise * rng.normal(size=vectors.shape))
        return choose_references(rigid(turns, np.tile([0.0, 0.0, 500.0], (len(yaw), 1))), 3)

    expected = chosen(0.0)
    assert len(set(expected)) == 3
    assert all(chosen(1e-9) == expected for _ in range(10))


def test_crops_for_landmarks_are_not_rounded_to_codes():
    rng = np.random.default_rng(2)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (90, 120, 3)).astype(np.uint8), (0, 0), 2.0)
    turn = np.array([[0.5, -0.1, 10.3], [0.1, 0.5, 5.7]])
    crop = _warped(picture, turn, 96)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    assert crop.dtype == np.float32
    assert np.abs(crop * 255 - cv2.warpAffine(picture, turn, (96, 96), flags=flags)).max() < 1.01
    beyond = _warped(picture, np.array([[1.0, 0.0, -40.0], [0.0, 1.0, -30.0]]), 64)
    assert not beyond[:30].any() and not beyond[:, :40].any() and beyond[31:, 41:].min() > 0.0
    assert not _warped(picture, np.array([[1.0, 0.0, 500.0], [0.0, 1.0, 500.0]]), 64).any()


def test_contrast_takes_each_codes_logarithm_from_a_table_of_doubles():
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    log = np.log(grey.astype(float) + 8.0).astype(np.float32)
    detail = log - cv2.GaussianBlur(log, (0, 0), 3.0)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), 5.0)) + 0.02
    expected = np.clip(np.rint(detail / spread * 45.0 + 128.0), 0, 255)
    assert np.array_equal(local_contrast(grey, 3.0, 5.0, 0.02), expected)


def test_a_light_steps_preconditioner_is_near_the_inverse_of_its_prior():
    """It is symmetric and positive, channels apart, and with it fewer products serve."""
    model, rng = make_light_model("cubemap", 4), np.random.default_rng(3)
    params, priors = 0.5 * rng.normal(size=(96, 3)), LightPriors(smooth=3.0, white=2.0)
    solve = model.preconditioner(params, priors)
    a, b = rng.normal(size=(2, 96, 3))
    assert np.isclose((a * solve(b)).sum(), (b * solve(a)).sum())
    assert (a * solve(a)).sum() > 0.0
    alone = np.zeros((96, 3))
    alone[:, 1] = a[:, 1]
    assert np.allclose(solve(a)[:, 1], solve(alone)[:, 1]) and not solve(alone)[:, [0, 2]].any()
    prior = model.prior(params, priors)[2]
    rows = rng.normal(size=(5, 288))

    def product(x):
        return prior(x) + x + (rows.T @ (rows @ x.ravel())).reshape(x.shape)

    exact = conjugate_gradients(product, a, 400, 1e-12)
    plain, helped = (conjugate_gradients(product, a, 10, 0.0, *how) for how in ((), (solve,)))
    assert np.linalg.norm(helped - exact) < 0.2 * np.linalg.norm(plain - exact)


def test_lights_of_few_numbers_and_several_lights_are_preconditioned_too():
    rng, priors = np.random.default_rng(4), LightPriors()
    few = make_light_model("harmonics_2", 4)
    right = rng.normal(size=(9, 3))
    assert np.array_equal(few.preconditioner(np.zeros((9, 3)), priors)(right), right)
    several, one = make_light_model("cubemap", 4, lights=2), make_light_model("cubemap", 4)
    params, right = rng.normal(size=(2, 192, 3))
    own = [one.preconditioner(part, priors)(part_right) for part, part_right in
           zip(np.split(params, 2), np.split(right, 2), strict=True)]
    assert np.allclose(several.preconditioner(params, priors)(right), np.concatenate(own))
