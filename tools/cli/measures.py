"""What is measured of a finished result, for the quality gates of pipeline.yaml."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from shared.contract.folders import RunFolder
from shared.contract.manifest import read_record
from tools.cli.records import number_of

if TYPE_CHECKING:
    import numpy as np

DETERMINED = 0.5
"""Confidence from which a texel counts as determined by the clip."""


def reprojection_px(run: RunFolder) -> float | None:
    """Median distance of the tracked skin points from where the solved poses put them, px of the crop; of several
    clips the largest."""
    return max((error for error, _ in tracking_errors(run)), default=None)


def reprojection_p95_px(run: RunFolder) -> float | None:
    """The same distance that 95 % of the skin points keep; of several clips the largest."""
    return max((error for error, _ in tracking_errors(run, "p95")), default=None)


def rotation_range_deg(run: RunFolder) -> float | None:
    """Largest angle between two frames' views of the head; of several clips the smallest."""
    found = [_number(record, "rotation_range_deg") for record, _ in tracking_records(run)]
    return min((angle for angle in found if angle is not None), default=None)


def focal_off(run: RunFolder) -> float | None:
    """By how much the tracks ask for another focal length than the given one: logarithm, less three deviations of what
    they know of it; of several clips the largest. 0 where it was solved."""
    found = [_focal_off(record.get("focal")) for record, _ in tracking_records(run)]
    return max((off for off in found if off is not None), default=None)


def _focal_off(focal: object) -> float | None:
    gain, deviation = _number(focal, "gain"), _number(focal, "log_deviation")
    if gain is None or deviation is None or gain <= 0:
        return None
    return 0.0 if focal.get("solved") else max(abs(math.log(gain)) - 3.0 * deviation, 0.0)


def tracking_errors(run: RunFolder, which: str = "median") -> list[tuple[float, RunFolder]]:
    """reprojection_px of each clip, median or p95, with its folder, where it is known."""
    found = [(_number(record.get("reprojection_px"), which), clip) for record, clip in tracking_records(run)]
    return [(error, clip) for error, clip in found if error is not None]


def tracking_records(run: RunFolder) -> list[tuple[dict, RunFolder]]:
    """tracking.json of each clip, with its folder."""
    return [(read_record(clip.published("track_landmarks") / "tracking.json") or {}, clip) for clip in clips_of(run)]


def clips_of(run: RunFolder) -> list[RunFolder]:
    """The folders of the clips that the result was solved from, in order; the run itself where there is but one."""
    solved = read_record(run.published("inverse_render") / "solve.json") or {}
    clips = solved.get("clips")
    names = [clip.get("name") for clip in clips if isinstance(clip, dict)] if isinstance(clips, list) else []
    own = {clip.root.name: clip for clip in run.clips()}
    return [own[name] for name in names if isinstance(name, str) and name in own] or [run]


def held_out_residual(run: RunFolder) -> float | None:
    """Mean absolute difference of re-renders from frames that were not fitted; 1 is the clip's white."""
    record = read_record(run.published("inverse_render") / "solve.json") or {}
    return _number(record.get("residuals", {}), "held_out")


def coverage(run: RunFolder) -> float | None:
    """Share of the map's seen texels, hair aside, that the clip determines well (confidence above 0.5)."""
    seen = _seen(run)
    return None if seen is None or not seen.size else float((seen > DETERMINED).mean())


def confidence(run: RunFolder) -> float | None:
    """Median confidence of the texels, hair aside, that are seen at all."""
    import numpy as np

    seen = _seen(run)
    return None if seen is None or not seen.size else float(np.median(seen))


MEASURES: Mapping[str, Callable[[RunFolder], float | None]] = {
    measure.__name__: measure for measure in (
        reprojection_px, reprojection_p95_px, rotation_range_deg, focal_off, held_out_residual, coverage,
        confidence)}


def confidence_map(run: RunFolder) -> Path:
    """The exported map that coverage and confidence are measured on."""
    return run.root / "export" / "maps" / "confidence.exr"


def _seen(run: RunFolder) -> np.ndarray | None:
    """[n] confidence of texels that frames show and that are not hair: no clip tells much of that, however good it is.
    """
    path = confidence_map(run)
    if not path.is_file():
        return None
    from shared.imaging.material_labels import HAIR
    from shared.io.images import read_exr
    from shared.io.material_maps import read_material

    values, materials = read_exr(path), path.with_name("material.exr")
    seen = values > 0
    if materials.is_file():
        seen &= (read_material(materials).argmax(-1) != HAIR).reshape(seen.shape)
    return values[seen]


def _number(record: object, name: str) -> float | None:
    value = number_of(record, name)
    return None if value is None else float(value)
