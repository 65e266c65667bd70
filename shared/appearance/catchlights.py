"""Catchlights that a clip shows, beside those that the solved light gives: a check that the solve has no part in.

An iris is dark and lies under a mirror of known shape, the wet cornea: what is far brighter there than the iris is the
mirror image of a light. The direction that it comes from, and how much light it is, are compared with the brightest
image of the solved light on the same irises in the same frames. Lights are told from eyes that way since [Nishino2004];
here nothing but the check hangs on it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shared.compute.robust import ROBUST_SCALE
from shared.geometry.eyeballs import IRIS_MM, gaze_rotation
from shared.geometry.mesh import interpolate, normalised
from shared.geometry.raycast import RAY_START_MM
from shared.geometry.transforms import camera_centres, project
from shared.imaging.color import LUMINANCE
from shared.imaging.image_sampling import Picture, sample_colours
from shared.imaging.turning_eyes import TurningEyes, depth_in_polygon
from shared.imaging.views import Views
from shared.rendering.eye_shine import EYE_INTENSITY, EyeShine

FRAMES = 40
"""At most, evenly spread over those that show an open eye."""
WITHIN_IRIS, SPACING_MM = 0.8, 0.25
"""Share of the iris' radius within which the cornea is a ball, and the raster of places there."""
WITHIN_LIDS_MM = 0.7
"""Lashes and the lids' own shine are nearer to the margins."""
LEAST_PLACES = 100
"""Of an eye in a frame, of some 1100: fewer tell no catchlight from the rim of a lid."""
STANDS_OUT, OVER_IRIS = 6.0, 1.0
"""A catchlight is brighter than the iris' median by so many deviations of it, and by so many times that median."""
CORE = 0.5
"""Share of a catchlight's brightest place from which on a place belongs to its middle."""


def iris_places() -> np.ndarray:
    """[n, 2] mm across and up: an even raster on an iris, within which the cornea is a ball."""
    reach = WITHIN_IRIS * IRIS_MM
    half = int(reach / SPACING_MM)
    along = SPACING_MM * np.arange(-half, half + 1)
    raster = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return raster[np.linalg.norm(raster, axis=1) <= reach]


def catchlight(brightness: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Direction [3] and light of the brightest spot on an iris, None where none stands out.

    brightness [n] of places whose mirrored directions are [n, 3]; light: the sum of what all places have over the
    iris' median.
    """
    base = float(np.median(brightness))
    over = brightness - base
    peak, spread = float(over.max()), ROBUST_SCALE * float(np.median(np.abs(over)))
    if peak <= max(STANDS_OUT * spread, OVER_IRIS * base):
        return None
    middle = np.where(over > CORE * peak, over, 0.0)
    return normalised((middle @ directions)[None])[0], float(np.maximum(over, 0.0).sum())


def check_catchlights(views: Views, eyes: TurningEyes, shine: EyeShine) -> dict | None:
    """`catchlights` of solve.json; None where no frame shows an open eye. shine: of the solved light, in the frames of
    the views."""
    open_eyes = np.isfinite(views.gaze).all(2)
    if views.lids_px is not None:
        open_eyes &= np.isfinite(views.lids_px).all((2, 3))
    frames = np.nonzero(open_eyes.any(1))[0]
    if not len(frames):
        return None
    frames = np.unique(frames[np.linspace(0, len(frames) - 1, FRAMES).round().astype(int)])
    looked_at, shown, pairs = 0, 0, []
    for f in frames.tolist():
        picture = views.picture(f)
        for side in np.nonzero(open_eyes[f])[0].tolist():
            seen = _seen_iris(views, f, side, picture, eyes, shine)
            if seen is None:
                continue
            looked_at += 1
            brightness, solved, directions = seen
            in_clip, in_model = catchlight(brightness, directions), catchlight(solved, directions)
            shown += in_clip is not None
            if in_clip is not None and in_model is not None:
                pairs.append((in_clip, in_model))
    return describe_catchlights(looked_at, shown, pairs)


def describe_catchlights(
    looked_at: int, shown: int, pairs: Sequence[tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]]
) -> dict:
    """For solve.json: of the irises that were looked at and those that showed a catchlight, and of pairs of catchlights
    (direction [3], light) in the clip and by the solved light."""
    said: dict = {"irises": looked_at, "with_catchlight": shown, "compared": len(pairs)}
    if pairs:
        apart = [np.degrees(np.arccos(np.clip(own @ model, -1.0, 1.0))) for (own, _), (model, _) in pairs]
        ratio = [light / of_model for (_, light), (_, of_model) in pairs]
        median, p95 = np.percentile(apart, (50, 95))
        said |= {
            "apart_deg": {"median": round(float(median), 2), "p95": round(float(p95), 2)},
            "light_over_solved": round(float(np.median(ratio)), 3),
        }
    return said


def _seen_iris(
    views: Views, f: int, side: int, picture: Picture, eyes: TurningEyes, shine: EyeShine
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Luminance [n] of the places of an iris that a frame shows, that of the light that the solved one has mirrored
    there [n], and the directions [n, 3] it comes from; None where lids or the head hide too much."""
    ball, mesh, gaze, across = eyes.balls[side], eyes.mesh, views.gaze[f], iris_places()
    local = np.column_stack([across, np.sqrt(ball.radius**2 - (across**2).sum(1))]) / ball.radius
    face, bary = eyes.place(side, local @ gaze_rotation(gaze[side]).T)
    places = interpolate(mesh.vertices, mesh.faces, face, bary)
    pixels, depth = project(places, views.camera_from_head[f], views.intrinsics[f])
    camera = camera_centres(views.camera_from_head[f][None])[0]
    towards = normalised(camera - places)
    seen = ((pixels > 1.0) & (pixels < np.subtract(views.size, 1.0))).all(1)
    if views.lids_px is not None:
        margin_px = WITHIN_LIDS_MM * views.intrinsics[f][0, 0] / depth
        seen &= depth_in_polygon(pixels, views.lids_px[f, side]) > margin_px
    seen &= ~shine.viewer.scene.occluded(places + RAY_START_MM * normalised(places - ball.centre), towards)
    if seen.sum() < LEAST_PLACES:
        return None
    face, bary = face[seen], bary[seen]
    solved = EYE_INTENSITY * shine.reflection(f, gaze, camera, face, bary) @ LUMINANCE
    return sample_colours(picture, pixels[seen]) @ LUMINANCE, solved, shine.mirrored(gaze, camera, face, bary)
