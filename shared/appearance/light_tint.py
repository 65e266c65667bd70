"""What a grey place in the picture says of its light's tint.

The place's own level says nothing of the light's: neither how light a grey it is nor how it is turned is known. Its
ratios of channels are the light's, as far as it is grey and sees the light that the face does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

GREY_SIGMA = 0.05
"""Standard deviation of log R/G and of log B/G between a place called grey and the light on the face: walls and cards
are not quite neutral, and another mix of window, lamps and walls shines on them than on the face."""


@dataclass(frozen=True)
class LightTint:
    """log_ratios: log R/G and log B/G of a light's mean irradiance; sigma: their standard deviations."""

    log_ratios: tuple[float, float]
    sigma: tuple[float, float]

    @classmethod
    def from_record(cls, record: Mapping[str, Sequence[float]]) -> LightTint:
        """Of `grey` in frames.json, which GreyWatch.record wrote."""
        red, green, blue = np.log(record["colour"])
        sigma_red, sigma_blue = np.hypot(record["log_sigma"], GREY_SIGMA)
        return cls((float(red - green), float(blue - green)), (float(sigma_red), float(sigma_blue)))


def describe_tints(tints: Sequence[LightTint | None]) -> list[dict]:
    """What solve.json says of the lights whose tint was measured: which of them, the logarithms and their deviations as
    they were counted."""
    return [{"light": k, "log_ratios": np.round(tint.log_ratios, 4).tolist(),
             "log_sigma": np.round(tint.sigma, 4).tolist()} for k, tint in enumerate(tints) if tint is not None]


def tint_in_words(tints: Sequence[LightTint | None]) -> str:
    """What the prior on the lights' colour is, for methods texts."""
    if not any(tints):
        return "a light that is white on average"
    if all(tints):
        return "a light of the tint that a grey place in the picture shows"
    return "lights of the tint that a grey place in the picture shows, white on average where none is named"
