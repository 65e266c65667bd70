"""What a stage needs of a machine: memory, minutes and disk, as functions of frames and resolution.

pipeline.yaml states them as coefficients, fitted to measured runs (provenance.json holds the measurements):

    sizes: {frames: sample_frames.frame_count, crop_px: sample_frames.max_size, map_px: inverse_render.map_size}
    stages:
      track_landmarks: {resources: {mem_mb: {base: 400, frame: 0.5, frame_megapixel: 11}}}

A plain number is a constant. Where a term counts: `frame` each frame, `megapixel` each million pixels of the crop,
`frame_megapixel` their product, `map_megapixel` each million texels of a map.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from shared.contract.declare import Parameter, Stage
from shared.contract.wording import check_keys, unknown_name
from shared.errors import InputError, shown

KINDS = ("mem_mb", "runtime", "disk_mb")
"""Megabytes of memory, minutes, megabytes on disk: Snakemake's names."""
TERMS = ("base", "frame", "megapixel", "frame_megapixel", "map_megapixel")
SIZES = ("frames", "crop_px", "map_px")
LARGEST_EDGE_PX = 1 << 16
"""A frame with a longer edge is no frame of ours: its record is damaged."""
_AMOUNT = Parameter("amount", float, 0.0, "What one unit needs.", "", 0.0, 1e9)


@dataclass(frozen=True)
class WorkSize:
    """How large the work is: number of frames, edges of the crop and of the maps in px; 0 where unknown."""

    frames: float = 0.0
    crop_px: float = 0.0
    map_px: float = 0.0

    def terms(self) -> dict[str, float]:
        """What each coefficient is multiplied by."""
        megapixel = self.crop_px**2 / 1e6
        return {"base": 1.0, "frame": self.frames, "megapixel": megapixel, "frame_megapixel": self.frames * megapixel,
                "map_megapixel": self.map_px**2 / 1e6}


def parse_needs(value: object, where: str) -> dict[str, dict[str, float]]:
    """`resources` of a stage -> {kind: {term: coefficient}}; InputError for unknown names and negative numbers."""
    given = check_keys(value, KINDS, where)
    return {kind: _coefficients(amount, f"{where}.{kind}") for kind, amount in given.items()}


def _coefficients(amount: object, where: str) -> dict[str, float]:
    given = check_keys(amount, TERMS, where) if isinstance(amount, dict) else {"base": amount}
    return {term: _AMOUNT.parse(number, f"{where}.{term}") for term, number in given.items()}


def parse_sizes(value: object, where: str) -> dict[str, str]:
    """`sizes` of pipeline.yaml -> {size: "stage.parameter"}."""
    given = check_keys(value, SIZES, where)
    for name, source in given.items():
        if not isinstance(source, str) or source.count(".") != 1:
            raise InputError("not a parameter", where=f"{where}.{name}", got=shown(source), expected="stage.parameter")
    return given


def scale_of(sizes: Mapping[str, str], stages: Mapping[str, Stage], parameters: Mapping[str, Mapping[str, object]],
             where: str) -> WorkSize:
    """The largest scale that the parameters allow; InputError where `sizes` names what does not exist."""
    found = {}
    for size, source in sizes.items():
        stage, name = source.split(".")
        if stage not in stages or name not in parameters[stage]:
            known = [f"{s.name}.{p.name}" for s in stages.values() for p in s.parameters]
            raise unknown_name("parameter", source, known, f"{where}: sizes.{size}")
        value = parameters[stage][name]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError("not a number", where=f"{where}: sizes.{size}", got=source, expected="a size")
        found[size] = float(value)
    return WorkSize(**found)


def amount(needs: Mapping[str, Mapping[str, float]], kind: str, scale: WorkSize) -> int | None:
    """Megabytes or minutes, rounded up; None where pipeline.yaml does not say."""
    if kind not in needs:
        return None
    terms = scale.terms()
    return max(1, math.ceil(sum(value * terms[term] for term, value in needs[kind].items())))


def measured_scale(run: Path, expected: WorkSize) -> WorkSize:
    """The scale of the clip as sample_frames found it, or the expected one as long as it has not run.

    run: the folder that holds work/. Of several clips all frames, and the largest crop.
    """
    record = Path("sample_frames") / "frames.json"
    paths = sorted((run / "work" / "clips").glob(f"*/work/{record}")) or [run / "work" / record]
    try:
        contents = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
        edges = [[float(edge) for edge in content["size"]] for content in contents]
        if not all(0 < edge <= LARGEST_EDGE_PX for pair in edges for edge in pair):
            return expected
        areas = [width * height for width, height in edges]
        return WorkSize(sum(len(content["frames"]) for content in contents), max(areas) ** 0.5, expected.map_px)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return expected
