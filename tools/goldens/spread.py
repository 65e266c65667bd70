"""How far results lie apart over kernels and threads: of each stage from its own inputs, and of the whole chain."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from tools.goldens.chain import run_chain
from tools.goldens.golden import distance, run_all, tolerance_of
from tools.goldens.kernels import OWN, Kernel
from tools.goldens.measures import Measures, measure
from tools.goldens.tiny import STAGES, stage_folder


def spread_table(stages: Sequence[str], ways: Sequence[Kernel], at_once: int) -> str:
    """A line of every measure: its spread over the ways and the tolerance that follows."""
    with tempfile.TemporaryDirectory() as scratch:
        runs = run_all([(stage, way) for way in ways for stage in stages], Path(scratch), at_once)
    return _table({(stage, way): run.measures for (stage, way), run in runs.items()}, stages, ways)


def chain_table(ways: Sequence[Kernel]) -> str:
    """The same where each stage reads what the stages before it made the same way."""
    measured = {}
    with tempfile.TemporaryDirectory() as scratch:
        for way in ways:
            out = Path(scratch) / way.name.replace(" ", "_")
            run_folder = run_chain(out, way)
            for stage in STAGES:
                measured[stage, way.name] = measure(stage, stage_folder(run_folder, stage))
    return _table(measured, STAGES, ways)


def _table(measured: Mapping[tuple[str, str], Measures], stages: Sequence[str], ways: Sequence[Kernel]) -> str:
    lines = [f"{'stage':16}{'measure':34}" + "".join(f"{way.name:>12}" for way in ways if way is not OWN)
             + f"{'tolerance':>12}"]
    for stage in stages:
        for name, reference in measured[stage, OWN.name].items():
            apart = [distance(measured[stage, way.name][name], reference) for way in ways if way is not OWN]
            most = 0.0 if reference.exact else tolerance_of(max(apart, default=0.0))
            lines.append(f"{stage:16}{name:34}" + "".join(f"{value:12.2g}" for value in apart) + f"{most:12.2g}")
    return "\n".join(lines)


