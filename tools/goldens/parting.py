"""Where two runs of a stage part: what its functions return, call by call, under two ways to run.

The recorder writes down a few numbers of everything that a function of `shared` or `stages` returns to the main thread.
Two recordings are laid side by side; the report names the functions in the order in which they first returned, with
how far their results lie apart: a jump from one line to the next is where roundings are amplified.
"""

from __future__ import annotations

import argparse
import json
import runpy
import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FrameType

import numpy as np

from tools.goldens.kernels import REPOSITORY

_SAMPLES = 32
_DEPTH = 3
_MOST_CALLS = 200
"""Of a function that is called more often, the first calls stand for all."""
_OWN = (str(REPOSITORY / "shared"), str(REPOSITORY / "stages"))


def numbers_of(value: object, depth: int = _DEPTH) -> Iterator[np.ndarray]:
    """Numeric arrays within a returned value: arrays, tensors, floats, and those in dataclasses, tuples and lists."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().double().numpy()
    if isinstance(value, bool | str) or value is None:
        return
    if isinstance(value, int | float | np.ndarray | np.generic):
        array = np.asarray(value)
        if array.dtype.kind in "biuf" and array.size:
            yield array.astype(np.float64).ravel()
    elif depth and is_dataclass(value) and not isinstance(value, type):
        for entry in fields(value):
            yield from numbers_of(getattr(value, entry.name, None), depth - 1)
    elif depth and isinstance(value, tuple | list):
        for entry in value[:8]:
            yield from numbers_of(entry, depth - 1)


def digest(array: np.ndarray) -> dict[str, object]:
    """{"size", "rms", "samples"} of a flat array; NaN counts as 0."""
    finite = np.nan_to_num(array, posinf=0.0, neginf=0.0)
    places = np.linspace(0, len(finite) - 1, min(_SAMPLES, len(finite))).astype(int)
    return {"size": len(finite), "rms": float(np.sqrt(np.mean(finite**2))), "samples": finite[places].tolist()}


class Recorder:
    """Keeps what functions return, as (function, number of the call, digests), in the order of the returns."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int, list[dict]]] = []
        self._counts: dict[str, int] = {}

    def __call__(self, frame: FrameType, event: str, value: object) -> None:
        if event != "return" or not frame.f_code.co_filename.startswith(_OWN) or frame.f_code.co_flags & 0x20:
            return  # 0x20: a generator, which returns nothing of its own
        module = Path(frame.f_code.co_filename).relative_to(REPOSITORY).with_suffix("")
        name = ".".join((*module.parts, frame.f_code.co_qualname))
        number = self._counts[name] = self._counts.get(name, -1) + 1
        if number < _MOST_CALLS:
            digests = [digest(array) for array in numbers_of(value)]
            if digests:
                self.calls.append((name, number, digests))


def record(out: Path, module: str, arguments: Sequence[str]) -> int:
    """Runs a module as `python -m` would, and writes what its functions returned; the run's exit code."""
    recorder, code = Recorder(), 0
    sys.argv[:] = [module, *arguments]
    sys.setprofile(recorder)
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        sys.setprofile(None)
    out.write_text(json.dumps(recorder.calls), encoding="utf-8")
    return code


def distance(first: dict, second: dict) -> float:
    """How far two digests lie apart, relative to their size; infinite where the arrays differ in length."""
    if first["size"] != second["size"]:
        return float("inf")
    scale = max(first["rms"], second["rms"], 1e-30)
    return float(np.max(np.abs(np.subtract(first["samples"], second["samples"])))) / scale


def compare(first: Path, second: Path) -> list[tuple[str, int, int, float]]:
    """(function, its calls in both, the call that lies furthest apart, how far), in the order of first returns."""
    calls = {(name, number): digests for name, number, digests in json.loads(second.read_text(encoding="utf-8"))}
    worst: dict[str, tuple[int, int, float]] = {}
    for name, number, digests in json.loads(first.read_text(encoding="utf-8")):
        if (other := calls.get((name, number))) is None:
            continue
        pairs = zip(digests, other, strict=False)
        apart = max((distance(*pair) for pair in pairs), default=0.0) if len(digests) == len(other) else float("inf")
        count, at, most = worst.get(name, (0, 0, -1.0))
        worst[name] = (count + 1, number, apart) if apart > most else (count + 1, at, most)
    return [(name, *values) for name, values in worst.items()]


def main() -> int:
    """`python -m tools.goldens.parting record OUT MODULE ...` or `... compare FIRST SECOND`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("record", "compare"))
    parser.add_argument("words", nargs=argparse.REMAINDER)
    args = parser.parse_args()
    if args.action == "record":
        return record(Path(args.words[0]), args.words[1], args.words[2:])
    for name, count, at, apart in compare(*map(Path, args.words)):
        if apart > 0:
            print(f"{apart:10.2e}  {name}  (call {at} of {count})")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
