"""How living eyes move: gaze, and lids that follow it and blink, for every frame of a clip.

Gaze is that of shared.geometry.eyeballs. Both eyes look at one point, so that they converge; a point that stands still
in the room is held while the head turns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.compute.smooth_step import smooth_step
from shared.geometry.eyeballs import gaze_towards
from shared.geometry.transforms import camera_centres
from tools.synthesis.eyes import LivingEyes
from tools.synthesis.head import Head

GAZES = ("ahead", "camera", "wander")
FURTHEST_DEG = 40.0
"""No eye turns further."""
FIXATION_S = (0.25, 0.8)
TARGET_DEG, TARGET_MM = (11.0, 6.0), (500.0, 2000.0)
"""Deviation of points that wandering eyes look at, sideways and up, from straight ahead; their distance."""
SACCADE_S_PER_DEG, SACCADE_S = 0.0022, 0.021
"""A saccade lasts SACCADE_S and that much longer for each degree [Carpenter1988]."""
CLOSING_S, SHUT_S, OPENING_S = 0.09, 0.05, 0.17
FOLLOW = 0.6
"""By how much of the iris' way up or down the upper lid follows."""
LOWEST, HIGHEST = 0.45, -0.35
"""Amounts (LivingEyes.lids) beyond which it does not."""
LID_STEP = 0.04
"""Lids move in steps of this amount, so that few states need to be rendered."""
HALF_SHUT = 0.5
"""Aperture below which the gaze is not seen."""


@dataclass(frozen=True)
class EyeMotion:
    """gaze [F, 2, 2] radians, known while shut as well; lids [F]: the amount of LivingEyes.lids of both eyes."""

    gaze: np.ndarray
    lids: np.ndarray


def eye_motion(eyes: LivingEyes, poses: np.ndarray, fps: float, seed: int, gaze: str, share: float,
               blinks_per_second: float, opening_mm: float) -> EyeMotion:
    """Of a clip with poses [F, 4, 4]. gaze: one of GAZES; share: of the turn to the camera that `camera` makes;
    opening_mm: of lids at rest."""
    rng = np.random.default_rng([seed, 12])
    ways = {"ahead": lambda: np.zeros((len(poses), 2, 2)), "camera": lambda: share * towards_camera(eyes, poses),
            "wander": lambda: wandering(eyes, poses, fps, rng)}
    most = np.radians(FURTHEST_DEG)
    turned = np.clip(ways[gaze](), -most, most)
    follow = np.clip(-FOLLOW * eyes.radius * turned[:, :, 1].mean(1) / opening_mm, HIGHEST, LOWEST)
    shut = blink_curve(len(poses), fps, blinks_per_second, np.random.default_rng([seed, 13]))
    lids = follow + (1.0 - follow) * shut
    return EyeMotion(turned, LID_STEP * np.round(lids / LID_STEP))


def true_eyes(eyes: LivingEyes, head: Head, motion: EyeMotion) -> dict[str, np.ndarray]:
    """What gt/poses.npz says of a clip's eyes, right then left: gaze [F, 2, 2] radians, NaN while lids are more than
    half shut; aperture [F, 2]: height of their opening relative to lids at rest; eyeball_centres [2, 3] and
    eyeball_radius, mm, head space."""
    amounts, which = np.unique(motion.lids, return_inverse=True)
    aperture = np.stack([eyes.openings(head, amount) for amount in amounts])[which] / eyes.openings(head, 0.0)
    gaze = np.where(aperture[..., None] < HALF_SHUT, np.nan, motion.gaze)
    return {"gaze": gaze, "aperture": aperture, "eyeball_centres": eyes.centres,
            "eyeball_radius": np.float64(eyes.radius)}


def towards_camera(eyes: LivingEyes, poses: np.ndarray) -> np.ndarray:
    """[F, 2, 2] gaze that looks into the camera."""
    return gaze_towards(camera_centres(poses)[:, None] - eyes.centres)


def wandering(eyes: LivingEyes, poses: np.ndarray, fps: float, rng: np.random.Generator) -> np.ndarray:
    """[F, 2, 2] gaze that rests on points of the room, one after the other, and jumps between them."""
    count, between = len(poses), eyes.centres.mean(0)
    gaze, frame = np.zeros((count, 2, 2)), 0
    while frame < count:
        yaw, pitch = np.radians(TARGET_DEG) * rng.normal(size=2)
        ahead = np.array([np.tan(yaw), np.tan(pitch), 1.0]) * rng.uniform(*TARGET_MM)
        in_camera = poses[frame, :3, :3] @ (between + ahead) + poses[frame, :3, 3]
        end = min(count, frame + max(2, round(fps * rng.uniform(*FIXATION_S))))
        turn, place = poses[frame:end, :3, :3], poses[frame:end, :3, 3]
        target = np.einsum("fji,fj->fi", turn, in_camera - place)
        gaze[frame:end] = gaze_towards(target[:, None] - eyes.centres)
        if frame:
            _jump(gaze, frame, end, fps)
        frame = end
    return gaze


def _jump(gaze: np.ndarray, frame: int, end: int, fps: float) -> None:
    """A saccade from the frame before `frame` to where it leads, over as many frames as its size takes."""
    start = gaze[frame - 1].copy()
    size = np.degrees(np.abs(gaze[frame] - start).max())
    frames = (SACCADE_S + SACCADE_S_PER_DEG * size) * fps
    for i in range(frame, end):
        gaze[i] = start + smooth_step((i - frame + 1) / max(frames, 1.0)) * (gaze[i] - start)


def blink_curve(frames: int, fps: float, per_second: float, rng: np.random.Generator) -> np.ndarray:
    """[F] how far lids are shut by blinks, 0 to 1: evenly many in each part of the clip, at a random time in it."""
    count = round(per_second * frames / fps) or int(per_second > 0)
    time, shut = np.arange(frames) / fps, np.zeros(frames)
    part = frames / fps / max(count, 1)
    lasts = CLOSING_S + SHUT_S + OPENING_S
    for number in range(count):
        start = part * number + rng.uniform(0.0, max(part - lasts, 0.0))
        closing = smooth_step((time - start) / CLOSING_S)
        opening = smooth_step((time - start - CLOSING_S - SHUT_S) / OPENING_S)
        shut = np.maximum(shut, closing * (1.0 - opening))
    return shut
