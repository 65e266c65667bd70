"""Quality gates: whether a finished subject is good enough to be handed on unseen, and the picture that shows why not.

pipeline.yaml sets the thresholds. A subject that misses one is finished all the same, and flagged `review`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from shared.contract.folders import RunFolder
from shared.contract.manifest import outputs_digest, read_manifest, read_record, write_record
from shared.contract.pipeline import Pipeline
from shared.contract.wording import unknown_name
from tools.records import is_line, number_of

if TYPE_CHECKING:
    import numpy as np

RECORD, PICTURE = "quality.json", "review.png"
DETERMINED = 0.5
"""Confidence from which a texel counts as determined by the clip."""


@dataclass(frozen=True)
class Flag:
    """A gate that was missed."""

    gate: str
    value: float
    limit: str

    def __str__(self) -> str:
        return f"{self.gate} {self.value:.3g} (expected {self.limit})"


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
    """Share of the map's seen texels that the clip determines well (confidence above 0.5)."""
    seen = _seen(run)
    return None if seen is None or not seen.size else float((seen > DETERMINED).mean())


def confidence(run: RunFolder) -> float | None:
    """Median confidence of the texels that are seen at all."""
    import numpy as np

    seen = _seen(run)
    return None if seen is None or not seen.size else float(np.median(seen))


MEASURES: Mapping[str, Callable[[RunFolder], float | None]] = {
    measure.__name__: measure for measure in (
        reprojection_px, reprojection_p95_px, rotation_range_deg, focal_off, held_out_residual, coverage,
        confidence)}


def check_gates(pipeline: Pipeline) -> None:
    """InputError for a gate that nobody can measure."""
    for name in pipeline.gates:
        if name not in MEASURES:
            raise unknown_name("gate", name, MEASURES, f"{pipeline.path}: gates")


def judge(run: RunFolder, pipeline: Pipeline) -> list[Flag]:
    """The gates that a finished result misses; the verdict is kept beside the result, a picture where it is bad."""
    if not pipeline.gates:
        return []
    asked = {name: asdict(gate) for name, gate in pipeline.gates.items()}
    results = {name: outputs_digest(manifest) for name in pipeline.steps
               if (manifest := read_manifest(run.published(name))) is not None}
    before = read_record(run.work / RECORD)
    if before and before.get("gates") == asked and before.get("results") == results:
        if (flags := _flags_of(before)) is not None:
            return flags
    values = {name: MEASURES[name](run) for name in pipeline.gates}
    flags = [Flag(name, value, pipeline.gates[name].limit) for name, value in values.items()
             if value is not None and not pipeline.gates[name].holds(value)]
    if flags:
        from tools.review_picture import write_review

        write_review(run, [flag.gate for flag in flags], [str(flag) for flag in flags])
    else:
        (run.work / PICTURE).unlink(missing_ok=True)
    write_record(run.work / RECORD, {"gates": asked, "results": results, "values": values,
                                     "flags": [asdict(flag) for flag in flags]})
    return flags


def read_flags(run: RunFolder) -> list[Flag]:
    """The gates that were missed when the result was last judged; none where the record is absent or damaged."""
    return _flags_of(read_record(run.work / RECORD)) or []


def _flags_of(record: object) -> list[Flag] | None:
    """The record's flags; None where it does not hold any that could have been written."""
    flags = record.get("flags") if isinstance(record, dict) else None
    if not isinstance(flags, list):
        return None
    for flag in flags:
        if not isinstance(flag, dict) or flag.keys() != {"gate", "value", "limit"}:
            return None
        if number_of(flag, "value") is None or not (is_line(flag["gate"]) and is_line(flag["limit"])):
            return None
    return [Flag(**flag) for flag in flags]


def confidence_map(run: RunFolder) -> Path:
    """The exported map that coverage and confidence are measured on."""
    return run.root / "export" / "maps" / "confidence.exr"


def _seen(run: RunFolder) -> np.ndarray | None:
    path = confidence_map(run)
    if not path.is_file():
        return None
    from shared.io.images import read_exr

    values = read_exr(path)
    return values[values > 0]


def _number(record: object, name: str) -> float | None:
    value = number_of(record, name)
    return None if value is None else float(value)
