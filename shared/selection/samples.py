"""How many frames, surface points and directions a light is solved from: no more than tell it.

Two halves of the frames, or of the points, each tell the light by themselves. If their errors are independent, the
variance of the difference between the two lights is twice that of one, and each variance falls as the samples grow:

    sigma(n)^2 = (n_half / n) d^2 / 2           d: root mean square of ln E_1 - ln E_2 over the skin in all frames

E is the irradiance, whose error goes into the albedo as it is. A factor per channel between the two is left out: it is
the scale between light and albedo, which priors hold. From n = n_half d^2 / (2 tolerance^2) on more samples move the
light by less than the tolerance.

Reference: [Efron1982], chapter 8 (half-samples).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shared.appearance.fit import Solution, fit_appearance
from shared.appearance.observations import Capture
from shared.appearance.problem import AppearanceProblem, AppearanceSettings
from shared.imaging.frame_index import halves
from shared.rendering.precomputed_transfer import Sizes
from shared.selection.candidates import SELECTION_PRECISION

TOLERANCE = 0.007
"""Standard deviation of the log irradiance, by frames and by points each: both together 1 %, a quarter of a unit of
CIELAB's lightness."""
FEWEST_FRAMES, FEWEST_POINTS = 24, 1000
"""Three frames of 24 are held out to judge by; with fewer points a highlight falls between them."""
FRAME_STEP, POINT_STEP = 8, 500
"""Numbers are rounded up to multiples of these."""
HALF_STEPS = 2
"""Most steps of a half from the light of all."""
SOFT_RESOLUTION, SOFT_DIRECTIONS, SOFT_NODES = 8, 512, 400
"""A light on cube faces of so few texels, 11 degrees wide, holds nothing that falls between these directions, 9 degrees
apart, nor that bounces differently between so many facets and more."""


@dataclass(frozen=True)
class HalfSpread:
    """count: samples of one half; difference: d between the lights of two halves."""

    count: int
    difference: float

    def enough(self, tolerance: float) -> float:
        """Samples from which on the light's standard deviation is below the tolerance."""
        return self.count * self.difference**2 / (2.0 * tolerance**2)


@dataclass(frozen=True)
class NeededSamples:
    """frames of each light, and the sizes of the light's problem, which are enough; over_frames, over_points: why."""

    frames: int
    sizes: Sizes
    over_frames: HalfSpread
    over_points: HalfSpread

    @property
    def told(self) -> str:
        """What is enough, and why, for the log."""
        enough = f"{self.frames} frames, {self.sizes.points} points, {self.sizes.directions} directions"
        apart = [f"{half.count} {name} {100.0 * half.difference:.1f} %"
                 for half, name in ((self.over_frames, "frames"), (self.over_points, "points"))]
        return f"{enough} are enough: lights of halves lie apart, with {' and '.join(apart)}"


def enough_samples(
    capture: Capture, settings: AppearanceSettings, solution: Solution, frames: int, sizes: Sizes
) -> NeededSamples:
    """What of frames (of each light) and sizes a light needs that looks like the solution of a small capture."""
    over_frames = spread_over_frames(capture, settings, solution)
    over_points = spread_over_points(capture, settings, solution)
    lights = len(capture.frames_of_lights)
    wanted = max(FEWEST_FRAMES, _rounded_up(over_frames.enough(TOLERANCE) / lights, FRAME_STEP))
    points = max(FEWEST_POINTS, _rounded_up(over_points.enough(TOLERANCE), POINT_STEP))
    own = Sizes(points, sizes.directions, sizes.nodes)
    if settings.resolutions[-1] <= SOFT_RESOLUTION:
        own = Sizes(points, SOFT_DIRECTIONS, SOFT_NODES)
    return NeededSamples(min(frames, wanted), sizes.at_most(own), over_frames, over_points)


def spread_over_frames(capture: Capture, settings: AppearanceSettings, solution: Solution) -> HalfSpread:
    """How far lights from every other fitted frame of a capture lie apart; solution: from all of them."""
    parts = [replace(capture, fitted=fitted) for fitted in halves(capture.fitted, capture.light_index)]
    return HalfSpread(int(capture.fitted.sum()) // 2, _apart(capture, parts, settings, solution))


def spread_over_points(capture: Capture, settings: AppearanceSettings, solution: Solution) -> HalfSpread:
    """How far lights from every other point of a capture lie apart; solution: from all of them."""
    rows = np.arange(len(capture.points))
    parts = [capture.take(rows[first::2]) for first in (0, 1)]
    return HalfSpread(len(rows) // 2, _apart(capture, parts, settings, solution))


def _apart(capture: Capture, parts: Sequence[Capture], settings: AppearanceSettings, solution: Solution) -> float:
    """d of the lights of two parts, over the skin of the capture."""
    problem = AppearanceProblem.of(capture, settings)
    settings = replace(settings, steps=HALF_STEPS, precision=SELECTION_PRECISION)
    logs = []
    for part in parts:
        own = fit_appearance(part, settings, start=solution, least=HALF_STEPS - 1)
        irradiance = problem.irradiance(problem.start_from(own.state))
        logs.append(np.log(np.maximum(irradiance[:, capture.skin], 1e-9)))
    difference = logs[0] - logs[1]
    return float((difference - difference.mean((1, 2), keepdims=True)).std())


def _rounded_up(count: float, step: int) -> int:
    return step * int(np.ceil(count / step))
