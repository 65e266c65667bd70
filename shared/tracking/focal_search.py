"""The focal length looked for over its whole range: a bundle adjustment alone finds the minimum next to its start.

Poses and points that were solved with a wrong lens fit it well: head, turn and distance have given way, and freeing the
focal length there moves it by a few per cent only, however wrong it is; tracks against the texture of such a head have
given way, too. So a thin part of the dense flow, which follows the pictures alone, is adjusted under lenses over a
range, each held, from poses at the distance that goes with it. What is left of the cost tells which one it asks for.

References: [Triggs2000], section 9, and [Szeliski1997] (the trade between focal length, distance and relief).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.tracking.bundle import BundleProblem, BundleSolution, BundleState, Tracks, adjust, zoomed

STEP = np.log(5.0) / 4.0
GAINS = np.exp(STEP * np.arange(-4, 5))
"""Tried, over the given focal length: neighbours are half as long again, so that each minimum has one beside it."""
MOST_FRAMES, MOST_POINTS = 24, 300
"""Of the clip that are looked at; a quarter of a second for each lens."""
PRIOR_MM = 40.0
"""Deviation of the points about their start. Those of a wrong lens are off by some tens of millimetres in depth: a
tighter prior would hold the lens that they come from."""
ITERATIONS = 15
FAR = 0.5 * STEP
"""Distance of logarithms up to which a lens is the given one's neighbour: the adjustment of all tracks finds those."""


@dataclass(frozen=True)
class Candidate:
    """A lens far from the given one that fits better: gain over the given focal length, a thin solution under it.

    advantage: by how much its cost is lower, in squared units of the tracks' noise.
    """

    gain: float
    tracks: Tracks
    solution: BundleSolution
    advantage: float


def look_elsewhere(
    tracks: Tracks, poses: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, loss_scale: float
) -> Candidate | None:
    """The best lens of those over the range, None where it is the given one or its neighbour.

    tracks, poses [F, 4, 4], points [N, 3]: the solution under the given lens, noise as the tracks have it for
    themselves: what a wrong lens leaves of errors must not count as noise.
    """
    frames = np.unique(np.linspace(0, len(poses) - 1, MOST_FRAMES).round().astype(int))
    some = np.unique(np.linspace(0, len(points) - 1, MOST_POINTS).round().astype(int))
    thin, poses, points = tracks.subset(frames, some), poses[frames], points[some]

    def solve(gain: float) -> tuple[float, BundleSolution]:
        lens, start = zoomed(intrinsics, gain), farther(poses, points, gain)
        solved = adjust(
            thin, start, points, lens, loss_scale=loss_scale, prior_mm=PRIOR_MM, max_iterations=ITERATIONS
        )
        problem = BundleProblem(thin, points, lens, loss_scale=loss_scale, prior_mm=PRIOR_MM)
        return problem.cost(BundleState(solved.camera_from_points, solved.points)), solved

    costs = np.array([solve(gain)[0] for gain in GAINS])
    lowest = int(costs.argmin())
    gain = float(GAINS[lowest] * np.exp(STEP * _vertex(costs, lowest)))
    if abs(np.log(gain)) < FAR:
        return None
    left, solved = solve(gain)
    advantage = costs[len(GAINS) // 2] - left
    return Candidate(gain, thin, solved, float(advantage)) if advantage > 0 else None


def _vertex(costs: np.ndarray, lowest: int) -> float:
    """Where, in steps from the lowest cost, the parabola through it and its neighbours ends; 0 at either end."""
    if not 0 < lowest < len(costs) - 1:
        return 0.0
    before, here, after = costs[lowest - 1 : lowest + 2]
    return float(0.5 * (before - after) / max(before - 2.0 * here + after, 1e-12))


def farther(poses: np.ndarray, points: np.ndarray, gain: float) -> np.ndarray:
    """Poses [F, 4, 4] with the cloud, points [N, 3] mm, `gain` times as far away: as large as before under as long a
    lens."""
    moved = np.array(poses, np.float64)
    depth = poses[:, 2, :3] @ points.mean(0) + poses[:, 2, 3]
    moved[:, 2, 3] += (gain - 1.0) * depth
    return moved
