"""Eyes drawn between lids that stand still in the head, whose gaze is known."""

import numpy as np

from shared.capture.iris import EyePicture, SeenEyes
from shared.geometry.eyeballs import gaze_direction, gaze_rotation, gaze_towards
from shared.geometry.raycast import pixel_directions
from shared.geometry.transforms import WORLD_FROM_CAMERA, camera_centres, project, rigid, rotation_from_vector

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
