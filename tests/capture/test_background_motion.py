"""capture.moves against the background: drawn clips of a still and of a carried camera, passers-by, plain walls and
compression."""

import cv2
import numpy as np
import pytest
from toy_video import write_video

from shared.capture.background_motion import BackgroundMotion, background_of, contradiction
from shared.geometry.transforms import rotation_from_vector
from shared.io.video import open_video

WIDTH, HEIGHT, FRAMES, KEY_EVERY = 320, 240, 48, 4
CENTRE, HALF = np.array([160.0, 130.0]), np.array([42.0, 56.0])
SWAY = 0.35 * np.sin(np.linspace(0, 2 * np.pi, FRAMES))
"""Yaw of the head against the camera, rad."""
CARRIED = 260.0 * SWAY
"""Where the background is in the picture, px, when the camera causes that yaw."""


def pattern(seed, width, height):
    """uint8 [height, width, 3] with detail of several sizes."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.uniform(0, 1, (height // n + 2, width // n + 2, 3)).astype(np.float32), (width, height),
                         interpolation=cv2.INTER_CUBIC) for n in (6, 17, 40)]
    return np.clip(60 + 45 * sum(layers), 0, 255).astype(np.uint8)


def face_points(yaw):
    """[468, 3] px: the front of an ellipsoid, turned."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(468, 3))
    directions[:, 2] = -np.abs(directions[:, 2])
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * [*HALF, HALF[0]]
    turned = points @ rotation_from_vector(np.array([0.0, yaw, 0.0])).T
    return turned + [*CENTRE, 0.0] + rng.normal(0, 0.3, (468, 3))


def clip(shift, yaw=SWAY, wall="detailed", walker=None, noise=2.0):
    """Frames [F] of a textured head before a wall that moves by shift [F] px; walker: [F] x of somebody 100 px wide."""
    scene = pattern(0, WIDTH + 600, HEIGHT) if wall == "detailed" else np.full((HEIGHT, WIDTH + 600, 3), 150, np.uint8)
    passer, skin = pattern(7, 100, 200), pattern(3, WIDTH, HEIGHT)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    head = ((x - CENTRE[0]) / HALF[0]) ** 2 + ((y - CENTRE[1]) / HALF[1]) ** 2 <= 1
    body = (np.abs(x - CENTRE[0]) < 70) & (y > CENTRE[1] + HALF[1] - 5)
    rng = np.random.default_rng(5)
    frames = []
    for i in range(len(shift)):
        move = np.array([[1, 0, shift[i] - 300.0], [0, 1, 0]])
        picture = cv2.warpAffine(scene, move, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        if walker is not None:
            left, right = np.clip([walker[i], walker[i] + 100], 0, WIDTH).astype(int)
            start = left - int(walker[i])
            picture[40:, left:right] = passer[:, max(start, 0):max(start, 0) + right - left]
        turned = np.roll(skin, round(60 * yaw[i]), axis=1)
        picture = np.where((head | body)[..., None], turned, picture)
        frames.append(np.clip(picture + rng.normal(0, noise, picture.shape), 0, 255).astype(np.uint8))
    return frames


def said(frames, yaw=SWAY):
    """What contradicts "head" and what "camera"."""
    motion = BackgroundMotion()
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    person = ((x - CENTRE[0]) / HALF[0]) ** 2 + ((y - CENTRE[1]) / HALF[1]) ** 2 <= 1
    person = (person | ((np.abs(x - CENTRE[0]) < 70) & (y > CENTRE[1] + HALF[1] - 5))).astype(np.float32)
    background = background_of((HEIGHT, WIDTH), person, (0, 0, WIDTH, HEIGHT))
    for i, rgb in enumerate(frames):
        luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        motion.follow(luma)
        if i % KEY_EVERY == 0:
            motion.set_key(i, luma, background, face_points(yaw[i]))
    return contradiction(motion.stretches, "head"), contradiction(motion.stretches, "camera")


def compressed(frames, folder):
    video = write_video(folder / "clip.mp4", frames, options={"crf": "38", "preset": "ultrafast"})
    return [codes for _, codes in open_video(video)]


WALK = np.linspace(-140, 330, FRAMES)


@pytest.mark.parametrize("walker, hard", [(None, False), (WALK, False), (None, True)])
def test_a_still_camera(tmp_path, walker, hard):
    frames = clip(0 * SWAY, walker=walker)
    head, camera = said(compressed(frames, tmp_path) if hard else frames)
    assert head == ""
    assert "stands still" in camera and "set capture.moves to head" in camera


@pytest.mark.parametrize("walker, hard", [(None, False), (WALK, False), (None, True)])
def test_a_carried_camera(tmp_path, walker, hard):
    frames = clip(CARRIED, walker=walker)
    head, camera = said(compressed(frames, tmp_path) if hard else frames)
    assert "the camera moved: set capture.moves to camera" in head
    assert camera == ""


@pytest.mark.parametrize("shift", [0 * SWAY, CARRIED])
def test_a_plain_wall_says_nothing(tmp_path, shift):
    frames = clip(shift, wall="plain", noise=4.0)
    assert said(frames) == said(compressed(frames, tmp_path)) == ("", "")


def test_a_hand_held_camera_that_sways_a_little_is_let_pass():
    assert said(clip(6.0 * np.sin(np.linspace(0, 25, FRAMES))))[0] == ""


def test_a_head_that_turns_while_the_camera_goes_its_own_way():
    own = 50.0 * np.cos(np.linspace(0, 4 * np.pi, FRAMES))
    head, camera = said(clip(own))
    assert "camera moved" in head and "do not follow the background's motion" in camera


def test_a_head_that_hardly_turns_proves_nothing():
    still = 0 * SWAY
    assert said(clip(still, still), still) == ("", "")


def test_a_long_slow_arc_is_seen_in_spite_of_tiny_steps():
    yaw = np.linspace(-0.1, 0.1, 96)
    head, camera = said(clip(260.0 * yaw, yaw), yaw)
    assert "camera moved" in head and camera == ""


def test_the_background_is_what_lies_outside_the_person_and_not_below():
    person = np.zeros((100, 100), np.float32)
    person[30:100, 30:70] = 1.0
    background = background_of((200, 300), person, (100, 20, 200, 120))
    assert background[10, 150] and background[60, 50] and background[60, 110]
    assert not background[90, 150] and not background[60, 126] and not background[150, 150]
