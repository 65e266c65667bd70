"""Many small subjects in one call, on one core and on two: throughput, memory over time, leftovers.

    python tests/robustness/batch_throughput.py [--subjects 20] [--json FILE]

Needs two cores with nothing else on them. The subjects are synthetic heads of different seeds, the settings those of
tests/helpers/quick.py. Exit code 1 where two cores give less than 1.7 times the throughput, memory grows, or files are
left.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
from bad_inputs.measure import resident_mb  # noqa: E402
from quick import QUICK  # noqa: E402

LEAST_GAIN, MOST_GROWTH_MB = 1.7, 30.0
SIZE, FRAMES = 144, 12


def main() -> int:
    """Prints both runs and the gain."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=20)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    if len(os.sched_getaffinity(0)) < 2:
        raise SystemExit("needs two cores")
    with tempfile.TemporaryDirectory(prefix="limn-batch-") as folder:
        batch = Path(folder) / "batch"
        for seed in range(options.subjects):
            subprocess.run([sys.executable, "-m", "tools.synthesize", str(batch / f"s{seed:02d}"), "--preset", "tiny",
                            "--size", str(SIZE), "--frames", str(FRAMES), "--seed", str(seed)],
                           check=True, stdout=subprocess.DEVNULL)
        runs = [measure(batch, Path(folder) / f"out{cores}", cores) for cores in (1, 2)]
    gain = runs[0]["seconds"] / runs[1]["seconds"]
    faults = [f"gain {gain:.2f}"] * (gain < LEAST_GAIN) + [fault for run in runs for fault in run["faults"]]
    print(f"gain {gain:.2f}; {'; '.join(faults) or 'ok'}")
    if options.json:
        options.json.write_text(json.dumps({"runs": runs, "gain": gain}, indent=1) + "\n")
    return 1 if faults else 0


def measure(batch: Path, out: Path, cores: int) -> dict:
    """One call of limn on so many cores; its own memory (not its stages') is sampled each second."""
    temporary = out.with_name(f"{out.name}_temporary")
    temporary.mkdir()
    command = [sys.executable, "-m", "tools.limn", "run", str(batch), "--out", str(out), "--cores", str(cores), *QUICK]
    allowed = sorted(os.sched_getaffinity(0))[:cores]
    start, engine, whole = time.monotonic(), [], []
    with tempfile.TemporaryFile("w+") as output:
        process = psutil.Popen(["taskset", "-c", ",".join(map(str, allowed)), *command], stdout=output,
                               stderr=subprocess.STDOUT, env={**os.environ, "TMPDIR": str(temporary)})
        while process.poll() is None:
            time.sleep(1.0)
            engine.append(sum(own_mb(process)))
            whole.append(resident_mb(process))
        seconds = time.monotonic() - start
        output.seek(0)
        text = output.read()
    growth = growth_mb(np.array(engine))
    left = [path.name for path in out.rglob(".*") if path.name != ".hashes.json"]
    left += sorted(path.name for path in temporary.iterdir())
    done = sum(1 for path in out.iterdir() if (path / "export" / "report.html").is_file())
    faults = [f"{cores} cores: exit code {process.returncode}"] * (process.returncode not in (0, 3))
    faults += [f"{cores} cores: memory grows by {growth:.0f} MB"] * (growth > MOST_GROWTH_MB)
    faults += [f"{cores} cores: left behind {left}"] * bool(left)
    print(f"{cores} cores: {seconds:.1f} s, {done} subjects, engine {max(engine):.0f} MB at most, growing by "
          f"{growth:.1f} MB, all together {max(whole):.0f} MB, {len(left)} files left", flush=True)
    if process.returncode not in (0, 3):
        print(text)
    return {"cores": cores, "seconds": seconds, "done": done, "growth_mb": growth, "peak_mb": max(whole),
            "faults": faults}


def own_mb(process: psutil.Process) -> list[float]:
    """Resident memory of limn and of the engine, without the stages."""
    found = []
    try:
        for member in [process, *process.children(recursive=True)]:
            words = member.cmdline()
            if "tools.limn" in words or "tools.cli.snakemake_process" in words:
                found.append(member.memory_info().rss / 2**20)
    except psutil.Error:
        pass
    return found


def growth_mb(samples: np.ndarray) -> float:
    """Median of the last quarter less the median of the second: what a leak would add."""
    quarter = max(1, len(samples) // 4)
    return float(np.median(samples[-quarter:]) - np.median(samples[quarter:2 * quarter])) if len(samples) > 8 else 0.0


if __name__ == "__main__":
    raise SystemExit(main())
