"""What an eyeball looks like where no frame shows it: a round iris, and white behind it.

Albedo as a function of the angle from the eye's axis, the same for both eyes: what texels at this angle show in the
median, and what is usual of the white where none does. So the iris goes on under the lid and the white behind it, and
skin says nothing of either.
"""

from __future__ import annotations

import numpy as np

from shared.geometry.eyeballs import IRIS_MM

LIMBUS_MM = 1.0
"""How far beyond the iris the white begins to be white."""
BIN = 0.03
"""Radians of angle that share a value: a third of a millimetre or more of an eye."""
RING_STEP, WHITE_STEP = 0.3, 0.03
"""Standard deviations of the log albedo from one bin to the next: of the iris and its rim, and of the white."""
USUAL_WHITE, WHITE_SIGMA, WHITE_TINT = np.log(0.55), 0.3, 0.1
"""Log albedo of the white of an eye, and its standard deviations: of brightness, and of a channel about it."""
MODEL_SIGMA = 0.1
"""Standard deviation of the log albedo of a bin, however many texels say the same: they share the model's errors."""


def round_albedo(
    angle: np.ndarray, iris_angle: float, log_albedo: np.ndarray, information: np.ndarray
) -> np.ndarray:
    """Log albedo [E, 3] of an eyeball's texels by their angle [E] from its axis alone, radians.

    iris_angle: of the iris' rim; log_albedo [E, 3]: what samples say, of precision information [E, 3]. The most likely
    profile: a Gaussian chain of bins, solved in closed form.
    """
    count = int(np.ceil(np.pi / BIN))
    bins = np.minimum((angle / BIN).astype(int), count - 1)
    means, known = _medians(bins, count, log_albedo, information)
    rim = (iris_angle * (1.0 + LIMBUS_MM / IRIS_MM)) / BIN
    step = np.where(np.arange(1, count) < rim, RING_STEP, WHITE_STEP) ** -2.0
    chain = np.diag(np.append(step, 0.0) + np.insert(step, 0, 0.0)) - np.diag(step, 1) - np.diag(step, -1)
    white = np.zeros(count)
    white[-1] = 1.0
    # The white is about neutral everywhere, and as bright as usual where nothing shows it, right behind.
    usual = np.full((3, 3), WHITE_SIGMA**2) + WHITE_TINT**2 * np.eye(3)
    neutral = (np.eye(3) - 1.0 / 3.0) / WHITE_TINT**2
    matrix = np.kron(np.eye(3), chain) + np.diag(known.T.ravel()) + np.kron(np.linalg.inv(usual), np.diag(white))
    matrix += np.kron(neutral, np.diag(np.arange(count) > rim))
    right = (known * means).T.ravel() + np.kron(np.linalg.inv(usual) @ np.full(3, USUAL_WHITE), white)
    return np.linalg.solve(matrix, right).reshape(3, count).T[bins]


def _medians(
    bins: np.ndarray, count: int, log_albedo: np.ndarray, information: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted median of each bin and channel [count, 3], and its precision."""
    means, known = np.zeros((2, count, 3))
    for k in np.unique(bins):
        own = np.nonzero(bins == k)[0]
        for c in range(3):
            weight = np.minimum(information[own, c], MODEL_SIGMA**-2)
            order = np.argsort(log_albedo[own, c])
            share = np.cumsum(weight[order])
            means[k, c] = log_albedo[own[order[np.searchsorted(share, 0.5 * share[-1])]], c]
            known[k, c] = share[-1] / (1.0 + share[-1] * MODEL_SIGMA**2)
    return means, known
