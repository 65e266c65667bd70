"""The command: python -m tools.bench NAME ... ; without a name, the list of benches."""

from __future__ import annotations

import sys
from importlib import import_module

from tools.bench.runner import run

BENCHES = {
    "chart": "chart.bench:ChartBench",
    "stress": "stress.bench:StressBench",
    "shape": "shape:ShapeBench",
    "model_selection": "model_selection:ModelSelectionBench",
    "whole_choice": "whole_choice:WholeChoiceBench",
    "level": "level:LevelBench",
    "published": "published:PublishedBench",
    "compared": "published:ComparedBench",
    "tracking": "tracking:TrackingBench",
    "backwards": "tracking:BackwardsBench",
    "hard_light": "hard_light:HardLightBench",
    "real": "real:RealBench",
    "colour_chart": "colour_chart:ColourChartBench",
    "shading": "shading:ShadingBench",
    "profile": "profile:ProfileBench",
    "growth": "growth:GrowthBench",
    "throughput": "throughput:ThroughputBench",
}
"""{name: module of tools.bench and its bench}; imported when asked for, since some need a minute or a peer."""


def main(arguments: list[str]) -> int:
    """Exit code of the bench that the first argument names; 2 where it names none."""
    if not arguments or arguments[0] not in BENCHES:
        print(f"usage: python -m tools.bench NAME ...\nNAME: {', '.join(BENCHES)}; NAME --help says more")
        return 0 if arguments[:1] in (["-h"], ["--help"]) else 2
    module, _, bench = BENCHES[arguments[0]].partition(":")
    found = getattr(import_module(f"tools.bench.{module}"), bench)
    return run(found, f"tools.bench {arguments[0]}", arguments[1:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
