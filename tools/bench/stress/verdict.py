"""The verdict on a stress case: right, degraded and said so, or wrong and silent.

Wrong: a score is worse than its limit (relative to the truth) and also worse than its growth times the score of the
same perturbation at 0. Said, by any of
- refusal: a stage ends with exit code 2;
- gate: a quality gate of pipeline.yaml is missed that the perturbation at 0 keeps;
- warning: one that the perturbation at 0 does not give and that mentions what the perturbation is about (its `says`);
- confidence: all that is wrong is the albedo, and where the confidence is above 0.5 it is right.
Whatever is wrong and not said is wrong and silent; a stage that ends with exit code 1 has failed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """most: worst value that still is right; growth: over the value at 0 that still is right; what and unit."""

    most: float
    growth: float
    what: str
    unit: str


LIMITS = {
    "albedo": Limit(3.0, 1.5, "albedo, median dE2000 after one gain per channel", "dE"),
    "albedo_p90": Limit(9.0, 1.5, "albedo, 90th percentile of the same", "dE"),
    "normals": Limit(10.0, 1.5, "normals, median", "deg"),
    "geometry": Limit(1.0, 1.5, "distance of the surface, median", "mm"),
    "rotation": Limit(0.75, 1.5, "head rotation, mean, without the mesh", "deg"),
    "light": Limit(0.30, 1.5, "light from the front through a lobe of 25 degrees, relative error", ""),
}
CONFIDENT = {"albedo": "confident_albedo", "albedo_p90": "confident_albedo_p90"}
"""Scores that are also taken where the confidence is above 0.5 only."""
RIGHT, WARNED, SAID, SILENT, FAILED = "right", "right, warned", "degraded, said so", "WRONG AND SILENT", "FAILED"


@dataclass(frozen=True)
class Verdict:
    """word: one of the above; wrong: names of the scores that are; said: how it was said, in words."""

    word: str
    wrong: tuple[str, ...]
    said: tuple[str, ...]


def is_wrong(name: str, value: float | None, at_zero: float | None) -> bool:
    """Whether a score's value (None: it is not finite) is worse than its limit and than what the perturbation at 0
    allows."""
    return value is None or not value <= allowed(name, at_zero)


def allowed(name: str, at_zero: float | None) -> float:
    """The worst value of a score that still is right."""
    return max(LIMITS[name].most, LIMITS[name].growth * (at_zero or 0.0))


def judge(says: str, row: Mapping, zero: Mapping) -> Verdict:
    """row, zero: {"exit": code, "message", "scores": {}, "warnings": [], "missed_gates": []} of a case and of 0."""
    if row["exit"] == 1:
        return Verdict(FAILED, (), ())
    if row["exit"] == 2:
        return Verdict(SAID, (), (f"refused: {row['message']}",))
    scores, base = row["scores"], zero["scores"]
    wrong = tuple(name for name in LIMITS if is_wrong(name, scores[name], base[name]))
    before = {gate_name(gate) for gate in zero["missed_gates"]}
    said = [f"gate: {gate}" for gate in row["missed_gates"] if gate_name(gate) not in before]
    known = {kind_of(text) for text in zero["warnings"]}
    said += [f"warning: {text}" for text in row["warnings"]
             if kind_of(text) not in known and re.search(says, text, re.IGNORECASE)]
    if not wrong:
        return Verdict(WARNED if said else RIGHT, (), tuple(said))
    unsure = all(name in CONFIDENT and not is_wrong(name, scores[CONFIDENT[name]], base[name])
                 for name in wrong)
    said += ["confidence: right where it is above 0.5"] * unsure
    return Verdict(SAID if said else SILENT, wrong, tuple(said))


def kind_of(warning: str) -> str:
    """A warning without its numbers: what makes two of them the same."""
    return re.sub(r"[-+]?\d[\d.,]*", "#", warning)


def gate_name(flag: str) -> str:
    """The gate that a flag is about."""
    return flag.split()[0]
