"""Eyeballs of anatomical size behind the lids of a fitted head.

The head model's are a third too large and stick through its lids, so that gaze by them turns too little and shut lids
would not cover them. An eye is 24 mm wide in nearly all adults [Bekerman2014]: the radius is known, the place across
the view is the model's, and the depth is where the lids rest on the ball.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from shared.geometry.eyeballs import EYE_RADIUS_MM, eyeballs_of
from shared.geometry.mesh import normalised
from shared.tracking.head_model import HeadModel

CLEARANCE_MM, RESTING_SHARE = 0.3, 0.2
"""How far from the ball lids are, and the share of their vertices before it that may be nearer: the model's rims, which
are deeper than real ones, reach into it."""
BEFORE_MM = 9.0
"""From the line of view through the ball's centre: lids that lie before it."""
SEARCH_MM = 12.0


def eye_centres(model: HeadModel, vertices: np.ndarray) -> np.ndarray:
    """[2, 3] mm: of the right and the left eyeball of vertices [V, 3]."""
    return np.stack([ball.centre for ball in eyeballs_of(model.surface(vertices))])


def set_eyeballs(model: HeadModel, vertices: np.ndarray) -> np.ndarray:
    """Vertices [V, 3] mm with both eyeballs as spheres of EYE_RADIUS_MM that the lids rest on."""
    placed, lids = vertices.copy(), vertices[np.unique(model.faces[model.segment("lids")])]
    for ball in eyeballs_of(model.surface(vertices)):
        outward = normalised(vertices[ball.vertices] - ball.centre)
        placed[ball.vertices] = _behind_lids(lids, ball.centre) + EYE_RADIUS_MM * outward
    return placed


def _behind_lids(lids: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The centre [3] moved along the view until the lids [n, 3] clear the ball; as it is where no lid is before it."""
    away = lids - centre
    before = lids[(np.hypot(away[:, 0], away[:, 1]) < BEFORE_MM) & (away[:, 2] > 0.0)]
    if not len(before):
        return centre

    def clearance(forward: float) -> float:
        away = np.linalg.norm(before - centre - [0.0, 0.0, forward], axis=1) - EYE_RADIUS_MM
        return float(np.quantile(away, RESTING_SHARE)) - CLEARANCE_MM

    if clearance(-SEARCH_MM) * clearance(SEARCH_MM) > 0.0:
        return centre
    return centre + [0.0, 0.0, brentq(clearance, -SEARCH_MM, SEARCH_MM)]
