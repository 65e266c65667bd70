"""The directions that light is summed along: even over the sphere, and close where a small lamp passes.

A set is an array [J, 3] of directions in head space whose lengths are their solid angles, in units of their mean
4 pi / J: of an even set all are 1, and (4 / J) sum_j V_j L_j (n . w_j) is the irradiance over pi of any.

An even set of 768 directions is seven degrees wide. That is plenty for a room, but a lamp that is smaller falls between
them: its strength then varies as the head turns, and its shadows jump. Twelve thousand directions hold it, and only
where it passes over the head are they needed.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from shared.compute.threads import thread_count
from shared.geometry.transforms import fibonacci_sphere

PARTS = 16
"""Directions that one of the even set is split into: seven degrees become less than two."""

CONCENTRATED = 15.0
"""Light of a frame from one direction of an even set, over the mean of all, from which on it comes from a lamp. Of a
room with a window it is below 8: a share of the light would hang on how many directions there are."""


def solid_angles(directions: np.ndarray) -> np.ndarray:
    """[J] sr of a set [J, 3]."""
    return np.linalg.norm(directions, axis=1) * (4.0 * np.pi / len(directions))


def widest_spacing(directions: np.ndarray) -> float:
    """Angle between neighbours of a set [J, 3] where they are farthest apart, radians."""
    return float(np.sqrt(solid_angles(directions).max()))


def concentrated(light_along: np.ndarray) -> np.ndarray:
    """[J] bool: along which directions of an even set a lamp shines in some frame; light_along [J, F, C] linear."""
    arriving = light_along.mean(2)
    return (arriving / np.maximum(arriving.mean(0), 1e-12)).max(1) > CONCENTRATED


def split_directions(directions: np.ndarray, chosen: np.ndarray, parts: int = PARTS) -> np.ndarray:
    """A set [J', 3] like the even one [J, 3] with each of the chosen [J] bool in about so many directions of its own
    cell, whose solid angles sum to its own."""
    if parts == 1 or not chosen.any():
        return directions
    finer = fibonacci_sphere(parts * len(directions))
    owner = cKDTree(directions).query(finer, workers=thread_count())[1]
    finer, owner = finer[chosen[owner]], owner[chosen[owner]]
    count = len(finer) + int((~chosen).sum())
    of_parts = finer / np.bincount(owner, minlength=len(directions))[owner, None]
    return np.concatenate([directions[~chosen], of_parts]) * (count / len(directions))
