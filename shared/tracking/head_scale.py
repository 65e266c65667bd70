"""How large the head is: by a length that was measured, or else by its irises and the head model together.

A clip of one camera tells the size of nothing. The fitted model has that of the mean adult, about which heads vary; the
visible iris has nearly the same width in all adults. Both tell the logarithm of one factor, and count by their
variances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MODEL_DEVIATION = 0.05
"""Of the logarithm of a head's size about the fitted model's: the model's own identities have 0.06 before they are
fitted, and on four subjects of known size it was off by 0.02 to 0.08."""
IRIS_DIAMETER_MM, IRIS_DEVIATION_MM = 11.7, 0.4
"""Of the visible iris of adults, across [Ruefer2005]."""
PUPIL_DEVIATION_MM = 0.5
"""Of a pupil distance as opticians measure it."""


@dataclass(frozen=True)
class HeadScale:
    """factor: by which a head as the model sized it grows; log_deviation: of its size; method: what says so."""

    factor: float
    log_deviation: float
    method: str

    def record(self) -> dict:
        """For tracking.json and run.json."""
        return {"method": self.method, "factor": round(self.factor, 5), "log_deviation": round(self.log_deviation, 5)}


BY_MODEL = HeadScale(1.0, MODEL_DEVIATION, "the head model's mean size and identity prior")


def scale_by_iris(radius_mm: float, radius_deviation_mm: float) -> HeadScale:
    """The head model's size and that of irises which under it have the radius_mm, as log-normals; radius_deviation_mm:
    how well that was measured."""
    told = np.log(0.5 * IRIS_DIAMETER_MM / radius_mm)
    variance = (IRIS_DEVIATION_MM / IRIS_DIAMETER_MM) ** 2 + (radius_deviation_mm / radius_mm) ** 2
    weight = MODEL_DEVIATION**2 / (MODEL_DEVIATION**2 + variance)
    return HeadScale(float(np.exp(weight * told)), float(np.sqrt(weight * variance)),
                     "the irises' diameter and the head model's mean size")


def scale_by_length(given_mm: float, centres: np.ndarray, centre_sigma: np.ndarray) -> HeadScale:
    """By the distance given_mm of the pupils of eyes that look far away, which is that of the centres about which the
    eyes turn; centres and their deviations centre_sigma [2, 3] mm under the head model's size."""
    between = centres[1] - centres[0]
    distance = float(np.linalg.norm(between))
    deviation = np.sqrt(np.square(centre_sigma * between / distance).sum())
    return HeadScale(given_mm / distance, float(np.hypot(PUPIL_DEVIATION_MM / given_mm, deviation / distance)),
                     "the pupil distance of subject.yaml")
