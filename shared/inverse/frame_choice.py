"""Few frames of many: those that together show as much of the face as they can, for methods that fit single pictures,
and those to re-render."""

from __future__ import annotations

import numpy as np

from shared.imaging.frame_index import spread_frames
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.views import Views

CANDIDATES = 60


def covering_frames(viewer: SurfaceViewer, wanted: np.ndarray, views: Views, count: int) -> np.ndarray:
    """[count] indices into the views: greedily those that add most to the best view of each vertex.

    wanted [V] bool: vertices that count, each by the square of its view cosine where it is seen.
    """
    candidates = spread_frames(len(views), CANDIDATES)
    seen = [viewer.view(views.camera_from_head[f], views.intrinsics[f], views.size).weight[wanted] for f in candidates]
    weight, best, chosen = np.stack(seen), np.zeros(int(wanted.sum()), np.float32), []
    for _ in range(min(count, len(candidates))):
        gain = np.maximum(weight, best).sum(1)
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
        best = np.maximum(best, weight[chosen[-1]])
    return np.sort(candidates[chosen])


def shown_frames(count: int, wanted: int, gaze: np.ndarray | None) -> np.ndarray:
    """At most wanted indices, evenly over range(count), for re-renders whose lids are at rest: where gaze [count, 2, 2]
    tells, NaN of a shut eye, of frames in which both eyes are open, if there are as many."""
    awake = np.arange(count) if gaze is None else np.nonzero(np.isfinite(gaze).all((1, 2)))[0]
    return awake[spread_frames(len(awake), wanted)] if len(awake) >= wanted else spread_frames(count, wanted)
