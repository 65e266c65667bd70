"""How far lids are open, and when they are shut, on lids drawn in head space."""

import numpy as np
import pytest

from shared.geometry.transforms import WORLD_FROM_CAMERA, project, rigid, rotation_from_vector
from shared.tracking.lids import closures, from_shut, lid_apertures, lids_of

FRAMES = 80
INTRINSICS = np.array([[1700.0, 0.0, 320.0], [0.0, 1700.0, 320.0], [0.0, 0.0, 1.0]])
CENTRES = np.array([[-31.0, 32.0, 71.0], [31.0, 32.0, 71.0]])
WIDTH_MM, OPEN_MM, SHUT_MM = 28.0, 9.0, 1.5


def poses_of(degrees: float) -> np.ndarray:
    phase = np.linspace(0.0, 2.0 * np.pi, FRAMES)
    turn = np.stack([0.4 * np.sin(2 * phase), np.sin(phase), 0 * phase], axis=-1) * np.radians(degrees)
    rotation = WORLD_FROM_CAMERA.T @ rotation_from_vector(turn)
    return rigid(rotation, np.broadcast_to([0.0, 20.0, 900.0], (FRAMES, 3)))


def drawn(apertures_mm: np.ndarray, poses: np.ndarray, noise_px: float = 0.2) -> np.ndarray:
    """Lids [F, 2, 16, 2] px, open by apertures [F, 2] mm."""
    lids = np.zeros((FRAMES, 2, 16, 2))
    along = np.concatenate([np.linspace(0, 1, 9), np.linspace(0, 1, 9)[1:-1]])
    above = np.repeat([-0.4, 0.6], [9, 7]) * np.where((along == 0) | (along == 1), 0.0, 1.0)
    for eye, outward in ((0, -1.0), (1, 1.0)):
        for f, pose in enumerate(poses):
            x = outward * WIDTH_MM * (0.5 - along)
            points = CENTRES[eye] + np.stack([x, apertures_mm[f, eye] * above, 0 * x], axis=-1)
            lids[f, eye] = project(points, pose, INTRINSICS)[0]
    return lids + noise_px * np.random.default_rng(5).standard_normal(lids.shape)


def blinking() -> np.ndarray:
    """[F, 2] mm: open, but for three blinks of three frames each and a wink of the right eye."""
    openings = np.full((FRAMES, 2), OPEN_MM)
    for start in (12, 38, 60):
        openings[start : start + 3] = SHUT_MM
    openings[25:28, 0] = SHUT_MM
    return openings


@pytest.mark.parametrize("degrees", [4.0, 30.0])
def test_apertures_and_widths_are_those_of_the_eye_under_any_pose(degrees):
    poses = poses_of(degrees)
    apertures, widths = lid_apertures(drawn(np.full((FRAMES, 2), OPEN_MM), poses, 0.0), CENTRES, poses, INTRINSICS)
    assert np.allclose(apertures, OPEN_MM, rtol=0.03) and np.allclose(widths, WIDTH_MM, rtol=0.06)


def test_blinks_and_winks_are_found_and_nothing_else():
    poses, openings = poses_of(25.0), blinking()
    found = lids_of(drawn(openings, poses), CENTRES, poses, INTRINSICS)
    assert np.array_equal(found.shut, openings < 0.5 * OPEN_MM)
    assert np.allclose(found.open_mm, OPEN_MM, rtol=0.05)
    assert np.allclose(found.openness[openings == OPEN_MM], 1.0, atol=0.15)


def test_lids_that_follow_the_pose_are_not_shut():
    """Who looks at the camera while nodding down raises the lids: that is no blink."""
    poses = poses_of(25.0)
    openings = OPEN_MM * (1.0 - 0.35 * np.sin(np.linspace(0, 2 * np.pi, FRAMES)))[:, None] * np.ones(2)
    assert not lids_of(drawn(openings, poses), CENTRES, poses, INTRINSICS).shut.any()


def test_eyes_that_stay_shut_are_shut_and_squinting_ones_are_not():
    poses = poses_of(25.0)
    shut, squinting = (
        lids_of(drawn(np.full((FRAMES, 2), opening), poses), CENTRES, poses, INTRINSICS).shut for opening in (1.8, 5.2)
    )
    assert shut.all() and not squinting.any()


def test_an_eye_that_is_not_seen_is_neither_open_nor_shut():
    poses, lids = poses_of(25.0), None
    lids = drawn(blinking(), poses)
    lids[:, 1] = np.nan
    lids[5:9, 0] = np.nan
    found = lids_of(lids, CENTRES, poses, INTRINSICS)
    assert np.isnan(found.openness[:, 1]).all() and not found.shut[:, 1].any() and np.isnan(found.open_mm[1])
    assert np.isnan(found.openness[5:9, 0]).all() and found.shut[12:15, 0].all()


def test_openness_counts_from_what_shut_lids_read():
    blinks, open_eyes = np.array([[1.0, 0.3], [np.nan, 0.65], [-0.2, 1.0]]), np.array([[1.0, 0.9], [0.55, 1.0]])
    assert np.allclose(from_shut(blinks)[:, 1], [0.0, 0.5, 1.0])
    assert np.allclose(from_shut(blinks)[[0, 2], 0], [1.0, -1.0 / 3.0])
    assert np.allclose(from_shut(open_eyes), (open_eyes - 0.1) / 0.9)


def test_lids_are_shut_as_far_as_their_aperture_says():
    """Open eyes that wander are open, a blink shuts all the way, and what reads as half open is rather shut: lids come
    down before the network sees it, so that of the way 0.5 it is 1 - 0.375^2, but for the slack of a quarter."""
    openness = np.array([1.0, 1.1, 0.95, 0.55, 0.1, 0.25, 0.55, 1.0])[:, None] * np.ones(2)
    half = (1.0 - 0.375**2 - 0.25) / 0.75
    expected = np.array([0.0, 0.0, 0.0, half, 1.0, 1.0, half, 0.0])[:, None] * np.ones(2)
    np.testing.assert_allclose(closures(openness, openness < 0.3), expected, atol=1e-12)


def test_eyes_that_are_shut_throughout_stay_as_they_are():
    """What the network reads between shut lids wanders by more than half."""
    openness = np.array([[1.0, 1.0], [0.2, 1.0], [1.4, 0.1], [np.nan, 1.0]])
    sometimes = np.array([[True, False]] * 2 + [[True, True], [False, False]])
    assert (closures(openness, sometimes).max(0) > 0.3).all()
    np.testing.assert_array_equal(closures(openness, np.ones((4, 2), bool)), np.zeros((4, 2)))


def test_lids_that_are_not_seen_do_as_the_others():
    openness = np.array([[1.0, 1.0], [0.1, np.nan], [np.nan, np.nan], [1.0, 1.0]])
    shut = openness < 0.5
    np.testing.assert_allclose(closures(openness, shut), [[0.0, 0.0], [1.0, 1.0], [0.5, 0.5], [0.0, 0.0]])
    np.testing.assert_array_equal(closures(np.full((3, 2), np.nan), np.zeros((3, 2), bool)), np.zeros((3, 2)))
