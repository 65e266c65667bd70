"""Facial actions by the names that ARKit gave them and most rigs know.

The head model's actions go by names of its own, some of them for both sides at once. Those are parted at the middle of
the face, and an action of which the model has one side only is mirrored for the other.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial import cKDTree

from shared.compute.smooth_step import smooth_step
from shared.tracking.head_model import HeadModel

ARKIT_NAMES = tuple(
    """browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft
    cheekSquintRight eyeBlinkLeft eyeBlinkRight eyeLookDownLeft eyeLookDownRight eyeLookInLeft eyeLookInRight
    eyeLookOutLeft eyeLookOutRight eyeLookUpLeft eyeLookUpRight eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight
    jawForward jawLeft jawOpen jawRight mouthClose mouthDimpleLeft mouthDimpleRight mouthFrownLeft mouthFrownRight
    mouthFunnel mouthLeft mouthLowerDownLeft mouthLowerDownRight mouthPressLeft mouthPressRight mouthPucker mouthRight
    mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper mouthSmileLeft mouthSmileRight mouthStretchLeft
    mouthStretchRight mouthUpperUpLeft mouthUpperUpRight noseSneerLeft noseSneerRight tongueOut""".split()
)
"""The 52 blend shape locations of ARKit; left and right are the subject's own."""
BOTH_SIDES = ("mouth_press", "mouth_stretch", "nose_sneer")
"""Actions of the model that move both sides: sums of a left and a right one."""
MIRRORED = {"jaw_left": "jaw_right"}
MIDDLE_MM = 8.0
"""Half the width over which an action of both sides is parted."""


def arkit_name(name: str) -> str:
    """eye_blink_left -> eyeBlinkLeft."""
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)


def lacking_names(names: tuple[str, ...]) -> list[str]:
    """ARKit's names that are not among these."""
    return [name for name in ARKIT_NAMES if name not in names]


def named_actions(model: HeadModel) -> dict[str, np.ndarray]:
    """{ARKit's name: displacements [V, 3] mm of the model's vertices}, in ARKit's order, then what ARKit has no name
    for. Left and right parts of one action add up to it."""
    left = _left_share(model.template[:, 0])[:, None]
    found = {}
    for name, moves in zip(model.expression_names, np.asarray(model.expression_basis, np.float64), strict=True):
        if name in BOTH_SIDES:
            found |= {arkit_name(f"{name}_left"): left * moves, arkit_name(f"{name}_right"): (1.0 - left) * moves}
        else:
            found[arkit_name(name)] = moves
        if name in MIRRORED:
            found[arkit_name(MIRRORED[name])] = _mirrored(model.template, moves)
    return {name: found[name] for name in in_order(found)}


def in_order(names: Iterable[str]) -> list[str]:
    """In ARKit's order, then those that ARKit does not have."""
    order = {name: k for k, name in enumerate(ARKIT_NAMES)}
    return sorted(names, key=lambda name: (order.get(name, len(order)), name))


def _left_share(x: np.ndarray) -> np.ndarray:
    """[V]: 1 on the head's own left, 0 on its right, smooth over the middle; x [V] mm."""
    return smooth_step(0.5 + 0.5 * x / MIDDLE_MM)


def _mirrored(template: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Displacements [V, 3] on the other side of a symmetric template [V, 3]."""
    other = cKDTree(template).query(template * (-1.0, 1.0, 1.0))[1]
    return moves[other] * (-1.0, 1.0, 1.0)
