"""How well heads come out under a hard lamp at the side that burns out a share of the face, from clip to export.

    python -m tools.bench hard_light --out DIR [--scan SUBJECT ...] [--given CASE=FOLDER ...] [--only scan_25 apart]

SUBJECT  a folder whose ground truth is a scanned head; without one the cases of scans say so and are left out.
Does     makes each case's subject by tools.synthesize, once, in DIR/subjects; runs `limn run` on it at standard, in
         DIR/runs; scores it (python -m tools.bench.whole_run explains every column). FOLDER holds a case's subject that
         was made before by the same arguments.
Cases    synthetic_25: a random head, a quarter of whose face burns out, 640 px; scan_25: the same of the first scan, of
         a second one scan2_25, and so on; ..._10, ..._40: other shares; ..._25_1024: larger pictures. ..._25_apart:
         other seeds, measured only where a word of --only holds `apart`, so that nothing is fitted to them.
Takes    at 640 px some four minutes to make a subject and five to run it, on two cores.
Resumes  rows of the same code are kept, and finished stages too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from shared.contract.pipeline import load_pipeline
from shared.contract.subject import load_subject
from shared.errors import InputError
from shared.io.arrays import read_json
from tools.bench.chart.runs import current_code
from tools.bench.chart.scores import CODE
from tools.bench.runner import Bench, Entry, Table, measured
from tools.bench.whole_run import COLUMNS, code_of, row_of
from tools.synthesis.subject import SynthesisSettings, parse

FRAMES = 100
APART = "apart"
NEEDS_A_LOOK = 3
"""Exit code of a run that misses a quality gate; it is a result."""
SCORED_BY = (*CODE, "tools/scoring/shadows.py", "tools/bench/whole_run.py")


@dataclass(frozen=True)
class HardLightClip:
    """clipped: share of the face's skin that burns out; size px; seeds of a random head and of a scan; apart: looked at
    only at the end."""

    clipped: float
    size: int = 640
    seeds: tuple[int, int] = (11, 12)
    apart: bool = False


CLIPS = {
    "25": HardLightClip(0.25),
    "25_1024": HardLightClip(0.25, size=1024),
    "10": HardLightClip(0.10),
    "40": HardLightClip(0.40),
    f"25_{APART}": HardLightClip(0.25, seeds=(21, 22), apart=True),
}
"""By the end of the case's name."""


@dataclass(frozen=True)
class HardLightCase:
    """clip: what is filmed; scan: folder of the head, None: a random one; left_out: no folder is given for it."""

    clip: HardLightClip
    scan: Path | None = None
    left_out: bool = False

    def arguments(self, frames: int) -> list[str]:
        """Of tools.synthesize, but for the folder."""
        words = ["--light", "lamp", "--clipped", f"{self.clip.clipped:.2f}", "--size", str(self.clip.size)]
        words += ["--frames", str(frames), "--seed", str(self.clip.seeds[self.scan is not None])]
        return words + (["--scan", str(self.scan)] if self.scan else [])


def all_cases(scans: list[Path]) -> dict[str, HardLightCase]:
    """{name: case}, those of scans left out where no folder is given; clips that lie apart come last."""
    heads: dict[str, HardLightCase] = {"synthetic": HardLightCase(CLIPS["25"])}
    heads |= {f"scan{k + 1 if k else ''}": HardLightCase(CLIPS["25"], scan) for k, scan in enumerate(scans)}
    heads = heads if scans else heads | {"scan": HardLightCase(CLIPS["25"], left_out=True)}
    return {f"{head}_{name}": HardLightCase(clip, own.scan, own.left_out)
            for name, clip in CLIPS.items() for head, own in heads.items()}


def has_made(folder: Path, settings: SynthesisSettings) -> bool:
    """Whether the folder holds the subject of these settings; a scan counts as the same where its folder's name is.
    InputError where it holds another."""
    if not (folder / "subject.yaml").exists():
        return False
    # What was not asked for yet when a subject was made, it has as by default.
    made = asdict(SynthesisSettings()) | read_json(folder / "synthesis.json")
    wanted, there = _comparable(asdict(settings)), _comparable(made)
    for name, value in wanted.items():
        if there.get(name) != value:
            raise InputError("was made by other arguments", where=str(folder), got=f"{name} {there.get(name)}",
                             expected=value, hint="remove it, or choose another --out")
    return True


def _comparable(settings: Mapping[str, Any]) -> dict[str, Any]:
    """As JSON gives them back, a scan by its folder's name."""
    plain = {name: list(value) if isinstance(value, tuple) else value for name, value in settings.items()}
    return plain | {"scan": Path(plain["scan"]).resolve().name if plain["scan"] else None}


class HardLightBench(Bench):
    """Every case. Beside its rows the table holds `code`, {case: {file: fingerprint}} of what made them."""

    name, columns = "hard_light", ("case", "scan", *COLUMNS)

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--scan", type=Path, nargs="+", default=[], metavar="SUBJECT", help="scanned heads")
        parser.add_argument("--given", nargs="+", default=[], metavar="CASE=FOLDER", help="subjects made before")
        parser.add_argument("--frames", type=int, default=FRAMES, help=f"length of the clips ({FRAMES})")

    def __init__(self, options: argparse.Namespace):
        super().__init__(options)
        scans = [scan.resolve() for scan in options.scan]
        for scan in scans:
            if not (scan / "gt").is_dir():
                raise InputError("no ground truth", where=f"--scan {scan}", expected="a gt/ folder",
                                 hint="leave it out: the cases of scans are then left out, too")
        self._cases, self.out = all_cases(scans), options.out.resolve()
        self.given = {name: Path(folder).resolve() for name, _, folder in (word.partition("=") for word in
                                                                          options.given)}  # fmt: skip
        for name in self.given.keys() - self._cases.keys():
            raise InputError("no such case", where="--given", got=name, expected=", ".join(self._cases))

    def facts(self) -> dict[str, Any]:
        versions = {name: stage.version for name, stage in load_pipeline(None).stages.items()}
        return {"frames": self.options.frames, "versions": versions}

    def refresh(self, table: Table) -> None:
        """Drops rows of other code, and of other scans than are given."""
        code = table.beside.setdefault("code", {})

        def holds(row: Mapping) -> bool:
            case = self._cases.get(row["case"])
            same = case is None or case.left_out or row["scan"] == _head(case)
            return same and current_code(code.get(row["case"], {}))

        kept = [row for row in table.rows if holds(row)]
        table.dropped += len(table.rows) - len(kept)
        table.rows = kept

    def cases(self) -> dict[str, HardLightCase]:
        return self._cases

    @property
    def default(self) -> list[str]:
        """All but those that lie apart."""
        return [name for name, case in self._cases.items() if not case.clip.apart]

    def chosen(self, words: Sequence[str]) -> dict[str, HardLightCase]:
        """As of any bench, but a part of a name finds no case that lies apart unless it says so."""
        found = super().chosen(words)
        if not any(APART in word for word in words):
            found = {name: case for name, case in found.items() if not case.clip.apart}
        return found

    def measure(self, case: HardLightCase, entry: Entry) -> None:
        if case.left_out:
            print(f"{entry.name}: left out, no scan is given (--scan)")
            return
        subject = self.subject_of(entry.name, case)
        run = self.out / "runs" / load_subject(subject).name
        command = [sys.executable, "-m", "tools.limn", "run", str(subject), "--out", str(run.parent), "--renew"]
        measured(command, run.with_name(f"{run.name}.log"), well=(0, NEEDS_A_LOOK))
        row = {"scan": _head(case), **row_of(subject, run)}
        entry.table.beside["code"][entry.name] = code_of(run, SCORED_BY)
        entry.add(row)

    def subject_of(self, name: str, case: HardLightCase) -> Path:
        """The folder of the case's subject, made now unless it is there."""
        folder, words = self.given.get(name, self.out / "subjects" / name), case.arguments(self.options.frames)
        _, settings, _ = parse([str(folder), *words])
        if not has_made(folder, settings):
            if name in self.given:
                raise InputError("no subject in this folder", where=f"--given {name}={folder}")
            print(f"{name}: making its subject", flush=True)
            measured([sys.executable, "-m", "tools.synthesize", str(folder), *words], folder.with_name(f"{name}.log"))
        return folder

    def say(self, row: Mapping) -> list[str]:
        shown = ("rotation_mean_deg", "covered", "albedo_db", "confident_de_p99", "rerender_db", "relit_db", "wall_s")
        return [str(row["case"]), *(f"{name} {row[name]:.4g}" for name in shown if row[name] is not None)]


def _head(case: HardLightCase) -> str:
    """The scan's name, nothing for a random head."""
    return case.scan.name if case.scan else ""
