"""The whole chain on the tiny subject, by what a user would notice: scores against its truth."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from shared.io.arrays import read_json, write_json
from tools.goldens.golden import SPREADS
from tools.goldens.kernels import KERNELS, OWN, Kernel, run_stage
from tools.goldens.tiny import GOLDEN_FOLDER, SETTINGS, STAGES, TINY_SUBJECT
from tools.scoring.score import score

CHAIN_FILE = GOLDEN_FOLDER / "chain.json"

NOTICED = {
    "geometry_mm.median": 0.02,
    "normal_deg.median": 0.1,
    "pose_own_alignment.rotation_deg.median": 0.01,
    "albedo.aligned.delta_e2000_median": 0.05,
    "albedo.aligned.psnr_linear": 0.2,
    "specular.rmse": 0.01,
    "roughness.rmse": 0.01,
    "envmap.lobe25_front_rel_rmse": 0.01,
    "rerender.psnr_gain": 0.2,
}
"""Scores and the least difference of each that anybody would notice, in its own unit (mm, degrees, dE2000, dB)."""


def chain_scores(scores: Mapping) -> dict[str, float]:
    """Those of a result's scores (tools.scoring.score) that are looked at."""
    return {name: float(_entry(scores, name)) for name in NOTICED}


def _entry(scores: Mapping, name: str) -> float:
    value = scores
    for part in name.split("."):
        value = value[part]
    return value


def run_chain(out: Path, way: Kernel) -> Path:
    """All stages in turn, one way -> the folder with work/ and export/. RuntimeError where one fails."""
    for stage in STAGES:
        done = run_stage(stage, TINY_SUBJECT, out, SETTINGS.get(stage, ()), way)
        if done.returncode != 0:
            raise RuntimeError(f"{stage} ({way.name}) ended with exit code {done.returncode}:\n{done.stderr[-3000:]}")
    return out / TINY_SUBJECT.name


def write_chain() -> None:
    """Runs the chain under each kernel and rewrites its golden file."""
    found = {}
    for way in KERNELS:
        with tempfile.TemporaryDirectory() as scratch:
            found[way.name] = chain_scores(score(TINY_SUBJECT, run_chain(Path(scratch), way) / "export"))
    content = {}
    for name, least in NOTICED.items():
        spread = max(abs(scores[name] - found[OWN.name][name]) for scores in found.values())
        content[name] = {"value": round(found[OWN.name][name], 6), "spread": float(f"{spread:.3g}"),
                         "tolerance": float(f"{max(SPREADS * spread, least):.3g}")}
    write_json(CHAIN_FILE, content)


def chain_differences(scores: Mapping) -> Iterator[str]:
    """What of a result's scores lies farther from the golden ones than it may, one line each."""
    golden = read_json(CHAIN_FILE)
    for name, value in chain_scores(scores).items():
        entry = golden[name]
        if not abs(value - entry["value"]) <= entry["tolerance"]:
            yield f"{name}: {value:.4g} instead of {entry['value']:.4g} +- {entry['tolerance']:.2g}"
