"""Lids that slide over the eyeballs: a blink closes them without cutting through the ball.

Displacements of the head model are straight, and its eyeballs are a third too large. Here a vertex keeps to the ball:
it turns about the ball's centre towards where its displacement points, and its distance from the ball changes by as
much as the model's does. How much of the model's blink shuts this head's lids is found from the gap between their
margins; then both margins are laid on one curve halfway between them, in height and in depth, and the lids' skin
follows as a thin plate. The half-shut eye is an in-between, on the same way around the ball.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from shared.geometry.eyeballs import Eyeball, eyeballs_of
from shared.geometry.mesh import normalised
from shared.tracking.fit_lids import LidMargins, followed
from shared.tracking.fit_surface import ThinPlate
from shared.tracking.head_model import HeadModel

MIDDLE = 0.3, 0.7
"""Of the way from corner to corner: here the gap between the lids is measured."""
MOST_BLINK = 1.5
"""Of the model's blink: so much of it is tried."""
CURVE_DEGREE = 5
CLEAR_MM = 0.3
"""Skin comes so near to the ball at most. What is nearer at rest stays so: the rims of a fitted head's lids are deeper
than real ones and reach into it."""
FOLLOW = 0.3, 0.6
"""Shares of the angle by which the gaze goes up or down with which the lower and the upper lid go [Becker1988]. On a
real person's clip lids went by more for small turns and by less for large ones; of four pairs, re-renders of this one
are nearest to it in structure."""
HALF = 0.5
"""Weight of the in-between."""


@dataclass(frozen=True, eq=False)
class Eyelids:
    """The lids of a head: vertices [V, 3] mm; balls: the right and the left eyeball; before: the model's; plate and
    margins: of the model at the head's level; soft [n]: vertices of lids and sockets."""

    model: HeadModel
    vertices: np.ndarray
    balls: tuple[Eyeball, Eyeball]
    before: tuple[Eyeball, Eyeball]
    plate: ThinPlate
    margins: LidMargins
    soft: np.ndarray

    @classmethod
    def of(cls, model: HeadModel, vertices: np.ndarray, splits: int) -> Eyelids | None:
        """model: at the head's level, `splits` times finer than the one that is tracked with. None where it has no
        lids."""
        margins = LidMargins.of(model, splits)
        if margins is None:
            return None
        balls, before = (eyeballs_of(model.surface(places)) for places in (vertices, model.template))
        soft = np.unique(model.faces[model.segment("lids", "eye_sockets")])
        return cls(model, vertices, balls, before, ThinPlate(model), margins, soft)

    def blink(self, eye: int, moves: np.ndarray, carried: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacements [V, 3] mm that shut an eye, 0 right and 1 left, and those that half shut it.

        moves [V, 3] mm: the model's blink; carried [V, 3] mm: the same on this head.
        """
        ball, model_ball = self.balls[eye], self.before[eye]
        start, end = (np.linalg.norm(self.model.template + each - model_ball.centre, axis=1) for each in (0.0, moves))
        arms = self.vertices - ball.centre

        def slid(share: float) -> np.ndarray:
            """[V, 3] from the ball's centre after a share of the blink."""
            length = np.linalg.norm(arms, axis=1) + share * (end - start)
            return normalised(arms + share * carried) * length[:, None]

        share = _shutting(lambda share: _gap(slid(share), self.margins.fronts[eye]))
        shut = _clear(self._met(slid(share), eye), arms, ball)
        length = HALF * (np.linalg.norm(arms, axis=1) + np.linalg.norm(shut, axis=1))
        half = normalised(normalised(arms) + normalised(shut)) * length[:, None]
        return shut - arms, half - arms

    def following(self, eye: int, up: float) -> np.ndarray:
        """Displacements [V, 3] mm of lids that follow a gaze which is so far up, radians; below 0: down. Both margins
        turn about the ball's centre, corners stay."""
        ball, held, moves = self.balls[eye], [], []
        arms = self.vertices - ball.centre
        for loop, front, gain in zip(self.margins.loops[eye], self.margins.fronts[eye], FOLLOW, strict=True):
            for own, share in ((loop, np.linspace(0.0, 1.0, len(loop))), front):
                azimuth, height, length = _polar(arms[own])
                turn = gain * up * np.sqrt(np.sin(np.pi * share))
                held.append(own)
                moves.append(_cartesian(azimuth, height + turn, length) - arms[own])
        moved = followed(self.plate, held, moves)
        return _clear(arms + moved, arms, ball) - arms

    def _met(self, arms: np.ndarray, eye: int) -> np.ndarray:
        """Arms [V, 3] from the ball's centre, with both margins on one curve about the ball."""
        fronts = self.margins.fronts[eye]
        curves = [_Curve.through(arms[own]) for own, _ in fronts]
        held, moves = [], []
        for loop, (own, share) in zip(self.margins.loops[eye], fronts, strict=True):
            azimuth = _polar(arms[own])[0]
            height, length = np.mean([curve.at(azimuth, curves) for curve in curves], axis=0)
            met = _cartesian(azimuth, height, length) - arms[own]
            order, way = np.argsort(share), np.linspace(0.0, 1.0, len(loop))
            rim = np.stack([np.interp(way, share[order], met[order, k]) for k in range(3)], axis=1)
            # The rim behind a margin goes with it, but for the corners.
            held += [own, loop]
            moves += [met, rim * np.sqrt(np.sin(np.pi * way))[:, None]]
        return arms + followed(self.plate, held, moves)

    def clear_of_balls(self, moves: np.ndarray) -> np.ndarray:
        """Displacements moves [V, 3] mm with lids pushed out of the eyeballs to where they may be."""
        cleared = moves.copy()
        for ball in self.balls:
            own = self.soft[np.sign(self.vertices[self.soft, 0]) == np.sign(ball.centre[0])]
            arms = self.vertices[own] - ball.centre
            cleared[own] = _clear(arms + moves[own], arms, ball) - arms
        return cleared


def _clear(arms: np.ndarray, at_rest: np.ndarray, ball: Eyeball) -> np.ndarray:
    """Arms [n, 3] from a ball's centre, made longer where they end too near to the ball; at_rest [n, 3]."""
    length = np.linalg.norm(arms, axis=1)
    least = np.minimum(np.linalg.norm(at_rest, axis=1), ball.radius + CLEAR_MM)
    return arms * (np.maximum(length, least) / length)[:, None]


@dataclass(frozen=True, eq=False)
class _Curve:
    """A margin seen from the ball's centre: polynomials of the azimuth for height and distance, and its two ends."""

    height: np.ndarray
    length: np.ndarray
    ends: tuple[float, float]

    @classmethod
    def through(cls, arms: np.ndarray) -> _Curve:
        azimuth, height, length = _polar(arms)
        return cls(np.polyfit(azimuth, height, CURVE_DEGREE), np.polyfit(azimuth, length, CURVE_DEGREE),
                   (azimuth.min(), azimuth.max()))

    def at(self, azimuth: np.ndarray, curves: list[_Curve]) -> tuple[np.ndarray, np.ndarray]:
        """Height [n] in radians and distance [n] mm; beyond the ends of any of the curves as at that end."""
        inside = np.clip(azimuth, max(curve.ends[0] for curve in curves), min(curve.ends[1] for curve in curves))
        return np.polyval(self.height, inside), np.polyval(self.length, inside)


def _polar(arms: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arms [n, 3] mm -> azimuth [n] towards +x, height [n] above the plane of x and z, in radians, and length [n]."""
    x, y, z = arms.T
    return np.arctan2(x, np.hypot(y, z)), np.arctan2(y, z), np.linalg.norm(arms, axis=1)


def _cartesian(azimuth: np.ndarray, height: np.ndarray, length: np.ndarray) -> np.ndarray:
    """The inverse of _polar."""
    level = length * np.cos(azimuth)
    return np.stack([length * np.sin(azimuth), level * np.sin(height), level * np.cos(height)], axis=1)


def _gap(arms: np.ndarray, fronts: tuple[tuple[np.ndarray, np.ndarray], ...]) -> float:
    """Radians between the middles of both margins; below 0 where they have passed each other."""
    shares, heights = np.linspace(*MIDDLE, 9), []
    for own, share in fronts:
        order = np.argsort(share)
        heights.append(np.interp(shares, share[order], _polar(arms[own[order]])[1]))
    lower, upper = heights
    return float(np.median(upper - lower))


def _shutting(gap) -> float:
    """The share at which a falling gap(share) is 0: 0 where it is so from the start."""
    if gap(0.0) <= 0.0:
        return 0.0
    return MOST_BLINK if gap(MOST_BLINK) >= 0.0 else float(brentq(gap, 0.0, MOST_BLINK, xtol=1e-4))
