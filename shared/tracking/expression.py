"""Which frames show the clip's most common expression: brows, mouth and chin as landmarks have them.

One rigid head is solved from all frames. Those in which the brows are up or the mouth is open show another surface:
they blur the textures where the face has moved, and wrinkles that come and go pass for light. How far landmarks lie
from where the rigid head has them tells the expression, but for what the network's own bias does, which follows the
head's turn and is taken out by regression on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shared.compute.robust import ROBUST_SCALE
from shared.geometry.transforms import rotation_range_deg, turns_from_mean
from shared.tracking.head_model import HeadModel

LIMIT_MM, JITTERS = 3.0, 7.0
"""Another expression: so far from the common one, and by so many times what the nose's landmarks jitter by from frame
to frame, of brows what their own do: shadows that a lamp casts from the side take them along. Brows that are raised lie
4 to 6 mm higher, corners of a smiling mouth 5 to 10."""
NOSE_OFF_MM = 6.0
"""A nose does not move: where its landmarks lie so far off, up to 4 mm being their bias, the network has missed the
face, and the others tell nothing of the expression either."""
LEAST_FRAMES, LEAST_SHARE, LEAST_TURN = 12, 0.3, 0.7
"""A common expression is shown by so many frames, such a share of them, and over such a share of the clip's turn."""
ROUNDS = 8
BIAS_PRIOR = 0.1
"""Ridge on what is taken for the network's bias, a share of the evidence: without one it would follow an expression
that goes with a turn, as raised brows go with looking up."""
CORNER, MIDDLE = 0.7, 0.4
"""Of the mouth's half width: landmarks of the lips beyond the one are its corners', within the other its middle's."""


@dataclass(frozen=True)
class Feature:
    """A group of landmarks and an axis of head space along which it moves. name: of the group; more, less: what a
    larger and a smaller value mean; of(segments, places): [468] weights, from names [468] and places [468, 3] mm."""

    name: str
    axis: int
    more: str
    less: str
    of: Callable[[np.ndarray, np.ndarray], np.ndarray]


def _mean_of(chosen: np.ndarray) -> np.ndarray:
    return chosen / max(chosen.sum(), 1)


def _brow(side: float) -> Callable:
    return lambda segments, places: _mean_of((segments == "brows") & (side * places[:, 0] > 0))


def _across(segments: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Of the lips' landmarks: place across, -1 to 1 at the mouth's corners; NaN for others."""
    lips = segments == "lips"
    return np.where(lips, places[:, 0] / np.abs(places[lips, 0]).max(), np.nan)


def _corner(side: float) -> Callable:
    return lambda segments, places: _mean_of(side * _across(segments, places) > CORNER)


def _mouth_width(segments: np.ndarray, places: np.ndarray) -> np.ndarray:
    return _corner(1.0)(segments, places) - _corner(-1.0)(segments, places)


def _gap(segments: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Upper minus lower lip, in the middle."""
    middle = np.abs(_across(segments, places)) < MIDDLE
    upper = middle & (places[:, 1] > np.median(places[middle, 1]))
    return _mean_of(upper) - _mean_of(middle & ~upper)


FEATURES = (
    Feature("left brow", 1, "higher", "lower", _brow(1.0)),
    Feature("right brow", 1, "higher", "lower", _brow(-1.0)),
    Feature("left mouth corner", 1, "higher", "lower", _corner(1.0)),
    Feature("right mouth corner", 1, "higher", "lower", _corner(-1.0)),
    Feature("mouth", 0, "wider", "narrower", _mouth_width),
    Feature("lips", 1, "farther apart", "closer together", _gap),
    Feature("chin", 1, "higher", "lower", lambda segments, places: _mean_of(segments == "chin")),
)


@dataclass(frozen=True)
class CommonExpression:
    """shown [F] bool: frames that show the most common expression; away_mm [F, len(FEATURES)]: each frame's distance
    from it; alike: how many frames are like it, of so many that were compared. Where too few are, all are shown."""

    shown: np.ndarray
    away_mm: np.ndarray
    alike: int = 0
    compared: int = 0

    def reason(self, frame: int) -> str:
        """Why a frame does not show it, "" where it does."""
        return "" if self.shown[frame] else f"another expression than most frames: {self._say(self.away_mm[frame])}"

    def warning(self) -> str:
        """What a person should know of it, "" where nothing."""
        if self.alike == self.compared:
            return ""
        farthest = self._say(self.away_mm[np.abs(self.away_mm).max(1).argmax()])
        if self.shown.all():
            return (f"only {self.alike} of {self.compared} frames show one expression (up to {farthest}): all were "
                    "solved as one rigid face; film a neutral face, lips closed, brows at rest")
        others = int((~self.shown).sum())
        return (f"{others} of {self.compared} frames show another expression than the rest (up to {farthest}) and were "
                "left out; film a neutral face, lips closed, brows at rest")

    @staticmethod
    def _say(away_mm: np.ndarray) -> str:
        k = int(np.abs(away_mm).argmax())
        feature, away = FEATURES[k], away_mm[k]
        return f"{feature.name} {abs(away):.1f} mm {feature.more if away > 0 else feature.less}"


def common_expression(
    model: HeadModel,
    vertices: np.ndarray,
    camera_from_head: np.ndarray,
    intrinsics: np.ndarray,
    landmarks_px: np.ndarray,
    counts: np.ndarray,
) -> CommonExpression:
    """Of the frames that count; the others are out for another reason and are not compared. vertices [V, 3] mm of the
    fitted head, camera_from_head [F, 4, 4], intrinsics [3, 3], landmarks_px [F, 468, 2], counts [F] bool."""
    frames = np.nonzero(counts)[0]
    shown, away_mm = np.ones(len(counts), bool), np.zeros((len(counts), len(FEATURES)))
    if len(frames) < LEAST_FRAMES:
        return CommonExpression(shown, away_mm)
    offsets = landmark_offsets(model, vertices, camera_from_head[frames], intrinsics, landmarks_px[frames])
    nose = offsets @ _mean_of(model.landmark_segments == "nose")
    told = np.abs(nose - np.median(nose, axis=0)).max(1) < NOSE_OFF_MM
    frames, offsets = frames[told], offsets[told]
    if len(frames) < LEAST_FRAMES:
        return CommonExpression(shown, away_mm)
    poses = camera_from_head[frames]
    values = feature_values(model, offsets)
    limits_mm = feature_limits(values, nose[told])
    inside, away_mm[frames] = largest_cluster(values, turn_basis(poses), limits_mm)
    enough = inside.sum() >= max(LEAST_FRAMES, LEAST_SHARE * len(frames))
    if enough and rotation_range_deg(poses[inside]) >= LEAST_TURN * rotation_range_deg(poses):
        shown[frames] = inside
    return CommonExpression(shown, away_mm, int(inside.sum()), len(frames))


def landmark_offsets(
    model: HeadModel, vertices: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray, landmarks_px: np.ndarray
) -> np.ndarray:
    """[F, 2, 468] mm along the head's x and y: by how much landmarks [F, 468, 2] px lie beside the fitted head's under
    the poses [F, 4, 4], at their depth; 0 where the model has none. vertices [V, 3] mm; intrinsics [3, 3]."""
    places = model.landmarks(vertices)
    known = np.isfinite(places[:, :1])
    seen = poses[:, None, :3, 3] + np.einsum("fij,nj->fni", poses[:, :3, :3], np.where(known, places, 0.0))
    ray = (landmarks_px - intrinsics[:2, 2]) / np.diag(intrinsics)[:2]
    beside = np.where(known, ray * seen[..., 2:] - seen[..., :2], 0.0)
    return np.einsum("fji,fnj->fin", poses[:, :2, :2], beside)


def feature_values(model: HeadModel, offsets: np.ndarray) -> np.ndarray:
    """[F, len(FEATURES)] mm from offsets [F, 2, 468] mm."""
    segments, places = model.landmark_segments, model.landmarks(model.template)
    return np.stack([offsets[:, feature.axis] @ feature.of(segments, places) for feature in FEATURES], axis=1)


def feature_limits(values: np.ndarray, nose: np.ndarray) -> np.ndarray:
    """[len(FEATURES)] mm by which values [F, len(FEATURES)] mm of one expression differ; nose [F, 2] mm: its offsets.
    Lips of someone who speaks jitter, too, so that only brows are asked for their own."""
    limit = max(LIMIT_MM, JITTERS * float(_jitter(nose).max()))
    brows = np.array(["brow" in feature.name for feature in FEATURES])
    return np.where(brows, max(limit, JITTERS * float(_jitter(values)[brows].max())), limit)


def _jitter(values: np.ndarray) -> np.ndarray:
    """[K]: standard deviation of values [F, K] about their course, from their steps."""
    return ROBUST_SCALE * np.median(np.abs(np.diff(values, axis=0)), axis=0) / np.sqrt(2.0)


def turn_basis(poses: np.ndarray) -> np.ndarray:
    """[F, 7]: what a landmark's bias may follow: one, then the turn [F, 3] from the mean pose and its squares, each of
    mean 0 and deviation 1."""
    turn = turns_from_mean(poses[:, :3, :3])
    varying = np.concatenate([turn, turn**2], axis=1)
    varying = (varying - varying.mean(0)) / np.maximum(varying.std(0), 1e-9)
    return np.concatenate([np.ones((len(turn), 1)), varying], axis=1)


def largest_cluster(values: np.ndarray, basis: np.ndarray, limits_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of the frames [F] bool are the most that are alike in all values [F, K] mm, within limits_mm [K] of their
    middle, and how far each is from it, [F, K] mm; what follows the basis [F, B] does not count."""
    ridge = BIAS_PRIOR * len(values) * np.eye(basis.shape[1])
    ridge[0, 0] = 0.0
    weight = np.ones((len(values), 1))
    for _ in range(ROUNDS):
        bias = np.linalg.solve(basis.T @ (weight * basis) + ridge, basis.T @ (weight * values))
        away = values - basis @ bias
        alike = (np.abs(away[:, None] - away[None]) < limits_mm).all(-1)
        centre = int(alike.sum(1).argmax())
        away = away - np.median(away[alike[centre]], axis=0)
        inside = (np.abs(away) < limits_mm).all(1)
        # Frames near the limit pull less: half of them may be on their way to another expression.
        weight = 1e-3 + inside * (1.0 - np.square(np.clip(np.abs(away) / limits_mm, 0.0, 1.0).max(1)))
        weight = weight[:, None]
    return inside, away
