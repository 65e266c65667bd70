"""How time and memory grow with frames and with texels.

    python -m tools.bench growth --out DIR [--subject SUBJECT] [--frames 60 120 250 500] [--texels 512 1024 2048 4096]
                                 [--preset NAME] [--document FILE]

SUBJECT  a folder of numbered pictures frames/%04d.png, of at least as many frames as the longest case (default: a
         synthetic head of 512 px, made once in DIR/subject).
Does     `limn run` for each number of frames (every k-th picture of SUBJECT, so that the head turns as far in each),
         with the preset's maps; then for each edge of the maps with the fewest frames.
Writes   OUT/growth.json and .csv: seconds, processor seconds and memory of each stage; OUT/growth.md: the same as
         tables, with the exponent b of cost = a size^b by least squares of logarithms; 1 is linear.
Nothing else should run meanwhile.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shared.contract.declare import folder_of
from shared.contract.manifest import PROVENANCE
from shared.contract.pipeline import load_pipeline
from shared.errors import InputError
from shared.io.arrays import read_json
from tools.bench.marked import add_document, write_marked
from tools.bench.profile import limn_run
from tools.bench.runner import Bench, Entry, Table, markdown_table
from tools.synthesis.subject import main as synthesize

SIZE = 512
PICTURES = "frames/%04d.png"
FRAMES, TEXELS = "frames", "texels"


class GrowthBench(Bench):
    """A case per number of frames and per edge of the maps."""

    name = "growth"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--subject", type=Path, metavar="SUBJECT")
        parser.add_argument("--frames", type=int, nargs="+", default=[60, 120, 250, 500])
        parser.add_argument("--texels", type=int, nargs="+", default=[512, 1024, 2048, 4096], help="edges of the maps")
        parser.add_argument("--preset", default="standard")
        add_document(parser)

    def __init__(self, options: argparse.Namespace):
        super().__init__(options)
        self.source = (options.subject or options.out / "subject").absolute()
        self.stages = tuple(load_pipeline(None).stages)

    def facts(self) -> dict[str, Any]:
        return {"subject": self.source.name, "preset": self.options.preset}

    def cases(self) -> dict[str, tuple[str, int]]:
        frames = {f"{count} frames": (FRAMES, count) for count in self.options.frames}
        return frames | {f"{edge} texels": (TEXELS, edge) for edge in self.options.texels}

    def measure(self, case: tuple[str, int], entry: Entry) -> None:
        kind, size = case
        count = size if kind == FRAMES else min(self.options.frames)
        if self.options.subject is None and not (self.source / "subject.yaml").is_file():
            most = max(self.options.frames)
            if synthesize([str(self.source), "--preset", "tiny", "--size", str(SIZE), "--frames", str(most)]):
                raise InputError("could not be rendered", where=str(self.source))
        work = self.options.out.absolute() / "work" / entry.name.replace(" ", "_")
        shutil.rmtree(work, ignore_errors=True)
        clip = thinned(self.source, work / f"clip{count}", count)
        settings = [f"--set=sample_frames.frame_count={count}"]
        if kind == TEXELS:
            settings += [f"--set=inverse_render.map_size={size}", "--set=inverse_render.fixed_parts=maps"]
        limn_run([str(clip), "--out", str(work), "--preset", self.options.preset, *settings])
        costs = {name: read_json(work / clip.name / folder_of(name) / PROVENANCE) for name in self.stages}
        entry.add(*({"kind": kind, "size": size, "stage": name, "wall_s": cost["wall_s"], "cpu_s": cost["cpu_s"],
                     "peak_mb": cost["peak_memory_mb"]} for name, cost in costs.items()))  # fmt: skip
        shutil.rmtree(work)

    def page(self, table: Table) -> str:
        return growth_page(table.rows)

    def conclude(self, table: Table) -> int:
        if table.rows and self.options.document:
            write_marked(self.options.document, "growth", self.page(table))
        return 0


def thinned(source: Path, folder: Path, count: int) -> Path:
    """A subject of so many of the source's numbered pictures, spread evenly. InputError where it has fewer."""
    pictures = sorted((source / "frames").glob("*.png"))
    if len(pictures) < count:
        raise InputError("too few numbered pictures", where=str(source / "frames"), got=len(pictures), expected=count)
    (folder / "frames").mkdir(parents=True)
    chosen = np.linspace(0, len(pictures) - 1, count).round().astype(int)
    for number, index in enumerate(chosen):
        shutil.copyfile(pictures[index], folder / (PICTURES % number))
    shutil.copyfile(source / "subject.yaml", folder / "subject.yaml")
    return folder


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """b of cost = a size^b, by least squares of logarithms; None where that needs more sizes or positive costs."""
    if len(set(sizes)) < 2 or min(costs) <= 0.0:
        return None
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def growth_page(rows: Sequence[Mapping]) -> str:
    """A table for frames and one for texels (by their number): cost of each stage and all, exponents."""
    parts = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        sizes = sorted({row["size"] for row in own})
        amount = [size if kind == FRAMES else size**2 for size in sizes]
        stages = dict.fromkeys(row["stage"] for row in own)
        lines = []
        for what, unit, merge in (("wall_s", "s", sum), ("cpu_s", "processor s", sum), ("peak_mb", "MB", max)):
            found = {name: [_of(own, name, size, what) for size in sizes] for name in stages}
            found["all"] = [merge(values) for values in zip(*found.values(), strict=True)]
            lines += [{kind: f"{name}, {unit}", **{str(size): value for size, value in zip(sizes, values, strict=True)},
                       "exponent": exponent(amount, values)} for name, values in found.items()]  # fmt: skip
        parts.append(markdown_table(lines, [kind, *map(str, sizes), "exponent"]))
    return "\n".join(parts)


def _of(rows: Sequence[Mapping], stage: str, size: int, what: str) -> float:
    """Median over the repeats."""
    return float(np.median([row[what] for row in rows if (row["stage"], row["size"]) == (stage, size)]))
