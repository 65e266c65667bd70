"""Irises followed by their texture, on drawn eyes whose gaze is known."""

from dataclasses import replace

import numpy as np
import pytest

from shared.capture.iris import EyePicture, SeenEyes
from shared.geometry.eyeballs import gaze_direction, gaze_rotation, gaze_towards
from shared.geometry.raycast import pixel_directions
from shared.geometry.transforms import WORLD_FROM_CAMERA, camera_centres, project, rigid, rotation_from_vector
from shared.tracking.gaze import solve_gaze
from shared.tracking.iris_texture import follow_irises, lay_on_rims

FRAMES, RADIUS_MM, IRIS_MM, SIZE = 24, 12.0, 5.85, 400
LENS = np.array([[1700.0, 0, 200], [0, 1700.0, 200], [0, 0, 1]])
CENTRES = np.array([[-31.0, 12.0, 60.0], [31.0, 12.0, 60.0]])
SKIN, WHITE = 150.0, 200.0
ALONG = np.concatenate([np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)[1:-1]])
LIDS_MM = np.stack([13.0 * ALONG, np.repeat([-4.0, 5.0], [9, 7]) * (1 - ALONG**2), 10.0 - 6.0 * ALONG**2], axis=-1)


def poses() -> np.ndarray:
    """[F, 4, 4] of a head that turns to both sides and nods."""
    phase = np.linspace(0.0, 2.0 * np.pi, FRAMES)
    turn = np.stack([0.4 * np.sin(2 * phase), np.sin(phase), 0 * phase], axis=-1) * np.radians(22.0)
    return rigid(WORLD_FROM_CAMERA.T @ rotation_from_vector(turn), np.broadcast_to([0.0, 10.0, 900.0], (FRAMES, 3)))


def iris_centres(gaze: np.ndarray) -> np.ndarray:
    """[F, 2, 2] px of eyes with gaze [F, 2, 2]."""
    places = CENTRES + RADIUS_MM * gaze_direction(gaze)
    return np.stack([project(own, pose, LENS)[0] for own, pose in zip(places, poses(), strict=True)])


def drawn(gaze: np.ndarray, light: np.ndarray, glint: bool) -> SeenEyes:
    """Eyes with gaze [F, 2, 2], seen between lids that stand still, in light of the strengths [F]; their irises are
    said to look straight ahead by a quarter too much. glint: a lamp's mirror image stays where it is in the picture."""
    frames, said = [], iris_centres(0.75 * gaze)
    for f, pose in enumerate(poses()):
        towards = pixel_directions(LENS, SIZE, SIZE) @ pose[:3, :3]
        camera = camera_centres(pose)
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        codes, lids = np.full((SIZE, SIZE), SKIN), []
        for side, centre in enumerate(CENTRES):
            beside = camera - centre
            half = towards @ beside
            under = half**2 - beside @ beside + RADIUS_MM**2
            arm = beside + (-half - np.sqrt(np.maximum(under, 0)))[..., None] * towards
            own = arm @ gaze_rotation(gaze[f, side])
            off, angle = np.hypot(own[..., 0], own[..., 1]), np.arctan2(own[..., 1], own[..., 0])
            iris = np.where(off < 2.0, 15.0, 80.0 + 12.0 * np.sin(7 * angle) + 8.0 * np.sin(2.0 * off))
            lids.append(project(centre + LIDS_MM * ((-1, 1)[side], 1, 1), pose, LENS)[0])
            upper, lower = (
                np.interp(np.arange(SIZE) + 0.5, *lids[side][rows][np.argsort(lids[side][rows, 0])].T)
                for rows in ([0, *range(9, 16), 8], list(range(9)))
            )
            rows = np.arange(SIZE)[:, None] + 0.5
            open_here = (under > 0) & (rows > np.minimum(upper, lower)) & (rows < np.maximum(upper, lower))
            open_here &= np.abs(np.arange(SIZE) + 0.5 - lids[side][:, 0].mean()) < 0.45 * np.ptp(lids[side][:, 0])
            codes = np.where(open_here, np.where(off < IRIS_MM, iris, WHITE), codes)
            if glint:
                x, y = lids[side].mean(0) - (3.0, 2.0)
                across = np.hypot(np.arange(SIZE) - x, rows - y)
                codes[across < 2.5] = 255.0 / light[f]
        picture = np.repeat(np.clip(light[f] * codes, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        frames.append((np.stack(lids), tuple(EyePicture.of(picture, own) for own in lids)))
    irises = np.repeat(said[:, :, None], 5, axis=2) + [[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]]
    return SeenEyes(irises, np.stack([lids for lids, _ in frames]), tuple(pictures for _, pictures in frames))


def gaze_on_the_camera() -> np.ndarray:
    gaze = gaze_towards(camera_centres(poses())[:, None] - CENTRES)
    return gaze - np.median(gaze, axis=0)


@pytest.mark.parametrize(("varies", "glint"), [(0.0, False), (0.3, False), (0.0, True)])
def test_irises_that_the_network_puts_too_near_to_the_middle_are_found(varies, glint):
    gaze = gaze_on_the_camera()
    light = 1.0 - varies * np.linspace(0, 1, FRAMES)
    seen = drawn(gaze, light, glint)
    found, counts, time_s = seen.iris_px, np.ones((FRAMES, 2), bool), np.arange(FRAMES) / 10
    for _ in range(3):
        solved = solve_gaze(found, counts, CENTRES, RADIUS_MM, poses(), LENS, time_s)
        now = replace(seen, iris_px=found)
        found = follow_irises(now, solved.gaze, solved.centres, solved.iris_distance_mm, poses(), LENS)
    before, after = (np.linalg.norm(px[:, :, 0] - iris_centres(gaze), axis=-1) for px in (seen.iris_px, found))
    assert np.quantile(before, 0.9) > 2.0
    assert np.median(after) < 0.15 * np.median(before) and np.quantile(after, 0.9) < 0.3 * np.quantile(before, 0.9)


def test_the_rim_goes_with_the_centre_and_eyes_without_gaze_stay():
    gaze = gaze_on_the_camera()
    seen = drawn(gaze, np.ones(FRAMES), glint=False)
    known = 0.75 * gaze
    known[5], known[7, 1] = np.nan, np.nan
    pictures = tuple((None, None) if f == 5 else own for f, own in enumerate(seen.pictures))
    found = follow_irises(replace(seen, pictures=pictures), known, CENTRES, RADIUS_MM, poses(), LENS)
    assert np.array_equal(found[5], seen.iris_px[5]) and np.array_equal(found[7, 1], seen.iris_px[7, 1])
    rims, before = found - found[:, :, :1], seen.iris_px - seen.iris_px[:, :, :1]
    assert np.allclose(rims, before, atol=1e-9) and (found[8] != seen.iris_px[8]).all()


@pytest.mark.parametrize("share", [0.0, 0.15])
def test_lids_that_leave_little_or_nothing_to_look_at_leave_irises_that_are_finite(share):
    gaze = gaze_on_the_camera()
    seen = drawn(gaze, np.ones(FRAMES), glint=False)
    middle = seen.lids_px.mean(2, keepdims=True)
    narrow = replace(seen, lids_px=middle + (seen.lids_px - middle) * (1.0, share))
    found = follow_irises(narrow, 0.75 * gaze, CENTRES, RADIUS_MM, poses(), LENS)
    off = np.linalg.norm(found[:, :, 0] - iris_centres(gaze), axis=-1)
    assert np.isfinite(found).all() and off.max() < 4.0


def test_circles_beside_the_irises_and_too_small_are_laid_on_their_rims():
    """By the same in all frames; an eye of which nothing is seen stays."""
    gaze = gaze_on_the_camera()
    seen = drawn(gaze, np.ones(FRAMES), glint=False)
    true = iris_centres(gaze)
    mm_px, aside = LENS[0, 0] / 840.0, np.array([[1.0, 0.8], [-1.2, 0.6]])
    rims = 5.3 * mm_px * np.array([[0, 0], [1, 0], [0, -1], [-1, 0], [0, 1]])
    given = replace(seen, iris_px=true[:, :, None] + aside[:, None] + rims)
    known = gaze.copy()
    known[..., 0] += aside[:, 0] / (mm_px * RADIUS_MM)
    known[..., 1] -= aside[:, 1] / (mm_px * RADIUS_MM)
    known[5] = np.nan
    found = lay_on_rims(given, known, CENTRES, RADIUS_MM, 5.3, poses(), LENS)
    assert np.array_equal(found[5], given.iris_px[5])
    kept = np.arange(FRAMES) != 5
    off = np.linalg.norm(found[kept][:, :, 0] - true[kept], axis=-1)
    assert np.linalg.norm(aside, axis=1).min() > 1.2 and np.median(off) < 0.3
    radius = np.linalg.norm(found[kept][:, :, 1] - found[kept][:, :, 0], axis=-1) / mm_px
    assert np.median(radius) == pytest.approx(IRIS_MM, rel=0.03)
    shut = replace(given, lids_px=given.lids_px * 0.0 + given.lids_px.mean(2, keepdims=True))
    laid = lay_on_rims(shut, known, CENTRES, RADIUS_MM, 5.3, poses(), LENS)
    np.testing.assert_allclose(laid, given.iris_px, atol=0.05)
