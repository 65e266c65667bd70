"""What keeps a rounding from becoming a result: choices with a margin, sums in doubles, OpenCV's plain code."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
import shapes

from shared.capture.landmarks import warped
from shared.compute.processor import use_baseline_opencv
from shared.geometry.transforms import rigid, rotation_from_vector
from shared.rendering.transfer import spread_vertices
from shared.tracking.first_poses import choose_references
from shared.tracking.tracked_clip import local_contrast


@pytest.fixture
def optimised():
    """As OpenCV is loaded, whatever stage ran in this process before."""
    before = cv2.useOptimized()
    cv2.setUseOptimized(True)
    yield
    cv2.setUseOptimized(before)


def test_opencv_leaves_the_processors_own_code(optimised):
    assert cv2.useOptimized()
    use_baseline_opencv()
    assert not cv2.useOptimized()


def test_other_threads_leave_ipp_too():
    """OpenCV switches IPP thread by thread, and stages compute in several; of that nothing is said on the terminal."""
    code = ("import threading, cv2\n"
            "from shared.compute.processor import use_baseline_opencv\n"
            "use_baseline_opencv()\n"
            "thread = threading.Thread(target=lambda: print(cv2.ipp.useIPP()))\n"
            "thread.start()\nthread.join()\nprint(cv2.ipp.useIPP())\n")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.split(), done.stderr) == (["False", "False"], "")


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
    crop = warped(picture, turn, 96)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    assert crop.dtype == np.float32
    assert np.abs(crop * 255 - cv2.warpAffine(picture, turn, (96, 96), flags=flags)).max() < 1.01
    beyond = warped(picture, np.array([[1.0, 0.0, -40.0], [0.0, 1.0, -30.0]]), 64)
    assert not beyond[:30].any() and not beyond[:, :40].any() and beyond[31:, 41:].min() > 0.0
    assert not warped(picture, np.array([[1.0, 0.0, 500.0], [0.0, 1.0, 500.0]]), 64).any()


def test_contrast_takes_each_codes_logarithm_from_a_table_of_doubles():
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    log = np.log(grey.astype(float) + 8.0).astype(np.float32)
    detail = log - cv2.GaussianBlur(log, (0, 0), 3.0)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), 5.0)) + 0.02
    expected = np.clip(np.rint(detail / spread * 45.0 + 128.0), 0, 255)
    assert np.array_equal(local_contrast(grey, 3.0, 5.0, 0.02), expected)
