"""Golden files: the measures of each stage's result, and how far a result may lie from them.

tests/golden/<stage>/golden.json holds for each measure its values, the scale by which differences count, the spread
over the ways to run (tools/goldens/kernels.py) and the tolerance that follows from it. tests/golden/<stage>/output/
holds what the stages after it read. Both change only on purpose, with the version of the stage or of an earlier one.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shared.contract.manifest import LOG
from shared.io.arrays import read_json, write_json
from tools.goldens.inputs import keep_outputs, lay_out, stage_of
from tools.goldens.kernels import OWN, REPOSITORY, WAYS, Kernel, run_stage
from tools.goldens.measures import Measure, Measures, measure
from tools.goldens.tiny import GOLDEN_FOLDER, SETTINGS, STAGES, TINY_SUBJECT, stage_folder

SPREADS = 5.0
"""A tolerance is so many times the largest spread over kernels and threads that was measured."""

LEAST_TOLERANCE = 1e-3
"""Of a measure's scale (a thousandth of a value, of a standard deviation, of a pixel): what is stored is rounded, and
other processors may spread a little where these did not at all."""

_DIGITS = 7


@dataclass(frozen=True)
class Run:
    """One stage's result: its measures, the names of its files and the folder that they lie in."""

    measures: Measures
    files: tuple[str, ...]
    folder: Path


def golden_file(stage: str) -> Path:
    """Where a stage's golden file lies."""
    return GOLDEN_FOLDER / stage / "golden.json"


def run_from_inputs(stage: str, out: Path, way: Kernel = OWN, repository: Path = REPOSITORY) -> Run:
    """The stage from its kept inputs, one way, in the empty folder out. RuntimeError where it fails."""
    run_folder = lay_out(out, stage)
    done = run_stage(stage, TINY_SUBJECT, out, SETTINGS.get(stage, ()), way, repository)
    if done.returncode != 0:
        raise RuntimeError(f"{stage} ({way.name}) ended with exit code {done.returncode}:\n{done.stderr[-3000:]}")
    folder = stage_folder(run_folder, stage)
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return Run(measure(stage, folder), tuple(name for name in files if name != LOG), folder)


def run_all(pairs: Sequence[tuple[str, Kernel]], out: Path, at_once: int) -> dict[tuple[str, str], Run]:
    """{(stage, way's name): its run} of pairs of a stage and a way; at_once run side by side. RuntimeError where one
    fails."""
    with ThreadPoolExecutor(at_once) as pool:
        folders = [out / way.name.replace(" ", "_") / stage for stage, way in pairs]
        runs = pool.map(run_from_inputs, (stage for stage, _ in pairs), folders, (way for _, way in pairs))
        return {(stage, way.name): run for (stage, way), run in zip(pairs, runs, strict=True)}


def distance(found: Measure, reference: Measure) -> float:
    """Largest difference in units of the reference's scale; infinite where shapes differ, or what must not."""
    if found.values.shape != reference.values.shape:
        return float("inf")
    if reference.exact:
        return 0.0 if (found.values == reference.values).all() else float("inf")
    with np.errstate(invalid="ignore"):
        apart = np.abs(found.values - reference.values) / reference.scale
    apart = np.where(np.isnan(found.values) & np.isnan(reference.values), 0.0, apart)
    return float(np.max(np.nan_to_num(apart, nan=np.inf), initial=0.0))


def tolerance_of(spread: float) -> float:
    """How far a result may lie from its golden one, where ways to run lie so far apart."""
    return max(SPREADS * spread, LEAST_TOLERANCE)


def write_golden(stage: str, runs: Mapping[str, Run]) -> None:
    """The golden file of a stage, from {way's name: its run}; the golden values lie midway between those that are
    farthest apart."""
    own = runs[OWN.name]
    content = {}
    for name in own.measures:
        of_ways = [run.measures[name] for run in runs.values()]
        reference = midway(own.measures[name], of_ways)
        spread = max(distance(found, reference) for found in of_ways)
        if not np.isfinite(spread):
            raise RuntimeError(f"{stage}: {name} is not the same in all ways to run")
        content[name] = _entry(reference, spread)
    before = {name: stage_of(name).version for name in STAGES[: STAGES.index(stage)]}
    record = {"version": stage_of(stage).version, "before": before, "files": list(own.files), "measures": content}
    golden_file(stage).parent.mkdir(parents=True, exist_ok=True)
    write_json(golden_file(stage), record)


def midway(own: Measure, of_ways: Sequence[Measure]) -> Measure:
    """The own way's measure with values midway between the least and the largest, where all have as many."""
    if own.exact or any(found.values.shape != own.values.shape for found in of_ways):
        return own
    values = np.stack([found.values for found in of_ways])
    return replace(own, values=0.5 * (values.min(0) + values.max(0)))


def _entry(reference: Measure, spread: float) -> dict:
    if reference.exact:
        return {"exact": True, "values": reference.values.tolist()}
    scale = np.broadcast_to(np.asarray(reference.scale, float), reference.values.shape)
    same = len(np.unique(scale)) == 1
    return {
        "shape": list(reference.values.shape),
        "values": _rounded(reference.values.ravel()),
        "scale": _rounded(scale.ravel()[:1] if same else scale.ravel()),
        "spread": float(f"{spread:.3g}"),
        "tolerance": float(f"{tolerance_of(spread):.3g}"),
    }


def _rounded(values: np.ndarray) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values]


def read_golden(stage: str) -> dict:
    """A stage's golden file."""
    return read_json(golden_file(stage))


def differences(stage: str, found: Measures, golden: Mapping) -> Iterator[str]:
    """What of a result lies farther from its golden file than it may, one line each."""
    for name in sorted({*found, *golden["measures"]}):
        if name not in found or name not in golden["measures"]:
            yield f"{stage}: {name}: {'not measured' if name not in found else 'not in the golden file'}"
            continue
        entry = golden["measures"][name]
        if entry.get("exact"):
            reference, tolerance = Measure(np.array(entry["values"]), exact=True), 0.0
        else:
            shape = tuple(entry["shape"])
            scale = np.array(entry["scale"])
            reference = Measure(np.array(entry["values"]).reshape(shape),
                                scale.reshape(shape) if len(scale) > 1 else scale)
            tolerance = entry["tolerance"]
        if (apart := distance(found[name], reference)) > tolerance:
            yield f"{stage}: {name}: {apart:.3g} from the golden value, {tolerance:.3g} allowed (in its scale)"


def write(stages: Sequence[str], at_once: int) -> None:
    """Runs the stages in turn from what is kept of those before them, all ways, and rewrites their golden files."""
    for stage in stages:
        with tempfile.TemporaryDirectory() as scratch:
            runs = run_all([(stage, way) for way in WAYS], Path(scratch), at_once)
            of_stage = {way: run for (_, way), run in runs.items()}
            _warn_of_version(stage, of_stage[OWN.name].measures)
            write_golden(stage, of_stage)
            if stage != STAGES[-1]:
                keep_outputs(Path(scratch) / OWN.name / stage / TINY_SUBJECT.name, stage)
        print(f"{golden_file(stage).relative_to(REPOSITORY)}: {len(of_stage[OWN.name].measures)} measures")


def _warn_of_version(stage: str, found: Measures) -> None:
    """A golden file that changes although no version did is most likely a mistake."""
    if not golden_file(stage).is_file():
        return
    old = read_golden(stage)
    before = {name: stage_of(name).version for name in old["before"]}
    if (old["version"], old["before"]) == (stage_of(stage).version, before) and any(differences(stage, found, old)):
        sys.stderr.write(f"{stage}: the result changed but the stage's version is still {old['version']}: raise it\n")
