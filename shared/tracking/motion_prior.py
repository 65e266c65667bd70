"""How a head moves: with modest acceleration, sudden jerks excepted.

A two-sided prior on second differences is the fixed-interval smoother of a constant-velocity model [Rauch1965]: it
looks as far ahead as back and so does not lag. Its Cauchy weights let go of true jerks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.compute.robust import ROBUST_SCALE, cauchy_weight
from shared.geometry.transforms import vector_from_rotation

LEAST_FRAMES = 8
JERK_DEVIATIONS = 3.0


@dataclass(frozen=True)
class MotionPrior:
    """time_s [F] of the frames; deviation of the acceleration: rotation in rad/s^2, translation in mm/s^2."""

    time_s: np.ndarray
    rotation: float
    translation: float

    @property
    def deviation(self) -> np.ndarray:
        """[6]: three of rotation, three of translation."""
        return np.repeat([self.rotation, self.translation], 3)

    def operator(self) -> np.ndarray:
        """[F - 2, F]: second divided differences, from positions to accelerations."""
        before, after = np.diff(self.time_s)[:-1], np.diff(self.time_s)[1:]
        step = 0.5 * (before + after)
        rows = np.arange(len(step))
        matrix = np.zeros((len(step), len(self.time_s)))
        matrix[rows, rows] = 1.0 / (before * step)
        matrix[rows, rows + 1] = -(1.0 / before + 1.0 / after) / step
        matrix[rows, rows + 2] = 1.0 / (after * step)
        return matrix

    def acceleration(self, poses: np.ndarray) -> np.ndarray:
        """[F, 4, 4] -> [F - 2, 6] of rotation (camera axes) and translation."""
        spans = np.diff(self.time_s)[:, None]
        turns = vector_from_rotation(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2))
        speed = np.concatenate([turns, np.diff(poses[:, :3, 3], axis=0)], axis=1) / spans
        return np.diff(speed, axis=0) / (0.5 * (spans[1:] + spans[:-1]))

    def cost(self, poses: np.ndarray) -> float:
        """Cauchy cost of the accelerations, in units of squared deviations."""
        ratio = self.acceleration(poses) / (JERK_DEVIATIONS * self.deviation)
        return float(JERK_DEVIATIONS**2 * np.log1p(ratio**2).sum())

    def normal_equations(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> normal matrices [6, F, F] and right-hand sides [6, F], one for each axis."""
        operator, acceleration = self.operator(), self.acceleration(poses)
        weight = cauchy_weight(acceleration, JERK_DEVIATIONS * self.deviation) / self.deviation**2
        matrices = np.stack([operator.T @ (weight[:, [axis]] * operator) for axis in range(6)])
        return matrices, -(operator.T @ (weight * acceleration)).T


def motion_prior_of(poses: np.ndarray, time_s: np.ndarray) -> MotionPrior | None:
    """The prior that a solution's own accelerations suggest: their robust spread, noise included, so it does not drag.

    None for fewer than LEAST_FRAMES frames: there is no spread to speak of. time_s [F].
    """
    if len(poses) < LEAST_FRAMES:
        return None
    spread = ROBUST_SCALE * np.abs(MotionPrior(time_s, 1.0, 1.0).acceleration(poses))
    return MotionPrior(
        time_s,
        max(float(np.median(spread[:, :3])), 1e-3),
        max(float(np.median(spread[:, 3:])), 1e-1),
    )
