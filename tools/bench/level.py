"""How far off the level and tint of the skin's albedo are, and whether the interval stated for them holds the truth.

    python -m tools.bench level SUBJECT [SUBJECT ...] --runs DIR --out DIR

DIR/<name of SUBJECT> is a whole run of a subject with gt/. A row per subject: logarithms of found over true albedo of
the face's skin, each channel and luminance, by the median of its pixels; the stated deviation of luminance and how much
of what is known of it the priors knew; how many channels lie inside the stated 90 % interval; the same of each channel
by least-squares gains, which a few bright pixels decide where skin is dark; raw dE2000. A run that was solved anew is
scored anew.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median

import numpy as np

from shared.contract.declare import folder_of
from shared.contract.hashing import hash_file
from shared.contract.manifest import MANIFEST
from shared.errors import InputError
from shared.imaging.color import LUMINANCE
from shared.io.arrays import read_json
from tools.bench.runner import Bench, Entry, Table
from tools.scoring.score import score

CHANNELS = ("red", "green", "blue")


def level_of(scale: dict, albedo: dict) -> dict[str, object]:
    """A row's numbers from albedo_scale of solve.json and the albedo's scores. InputError where no deviation is
    stated."""
    if "skin_albedo_90" not in scale:
        raise InputError("states no interval of the skin's albedo", where="albedo_scale of solve.json",
                         hint="the scale did not come to rest, or the solver is the published one")
    found = np.array(scale["skin_albedo"])
    true = found * albedo["median_gain"]
    low, high = np.array(scale["skin_albedo_90"])
    return {
        **dict(zip(CHANNELS, np.log(found / true), strict=True)),
        "luminance": np.log((found @ LUMINANCE) / (true @ LUMINANCE)),
        "sigma": scale["log_sigma"]["luminance"],
        "prior_share": scale["prior_share"],
        "inside_90": int(((low <= true) & (true <= high)).sum()),
        **{f"{name}_by_squares": -np.log(gain) for name, gain in zip(CHANNELS, albedo["gain"], strict=True)},
        "raw_de": albedo["raw"]["delta_e2000_median"],
    }


class LevelBench(Bench):
    """Level and tint of whole runs beside the truth."""

    name = "level"
    columns = ("case", *CHANNELS, "luminance", "sigma", "prior_share", "inside_90",
               *(f"{name}_by_squares" for name in CHANNELS), "raw_de")

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("subjects", nargs="*", type=Path, help="folders with gt/")
        parser.add_argument("--runs", type=Path, required=True, help="folder of the subjects' runs")

    def cases(self) -> dict[str, Path]:
        return {subject.resolve().name: subject.resolve() for subject in self.options.subjects}

    def _solved(self, name: str) -> Path:
        return self.options.runs / name / folder_of("inverse_render")

    def refresh(self, table: Table) -> None:
        for row in list(table.rows):
            manifest = self._solved(row["case"]) / MANIFEST
            if manifest.is_file() and hash_file(manifest) != row["manifest"]:
                table.drop(row["case"], row["repeat"])

    def measure(self, case: Path, entry: Entry) -> None:
        solved = self._solved(case.name)
        if not (solved / MANIFEST).is_file():
            raise InputError("a stage has not run", where=str(solved), expected="the run of a subject")
        albedo = score(case, self.options.runs / case.name / folder_of("export_usd"))["albedo"]
        entry.add({**level_of(read_json(solved / "solve.json")["albedo_scale"], albedo),
                   "manifest": hash_file(solved / MANIFEST)})

    def conclude(self, table: Table) -> int:
        errors = [abs(row[name]) for row in table.rows for name in CHANNELS]
        if errors:
            inside = sum(row["inside_90"] for row in table.rows)
            print(f"{len(table.rows)} subjects: the median channel is off by {100 * np.expm1(median(errors)):.0f} %; "
                  f"{inside} of {len(errors)} inside the stated 90 % interval")
        return 0
