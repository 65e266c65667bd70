"""Runs the corpus of bad inputs to the end and measures it.

    python tests/robustness/bad_inputs/measure.py [--json FILE] [NAME ...]

Each must end with exit code 2 and one clear line, or with a good result; no traceback, 60 s and 2 GB at most, and its
files as they were. Exit code 1 where one does not.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parents[2] / "helpers")]
from quick import QUICK  # noqa: E402

from bad_inputs import CASES, Case  # noqa: E402
from bad_inputs.settings import CANARY  # noqa: E402

LONGEST_S, LARGEST_MB = 60.0, 2000.0


def main() -> int:
    """Prints one line for each case and a sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the measurements")
    options = parser.parse_args()
    records = []
    for name in options.names or CASES:
        with tempfile.TemporaryDirectory() as scratch:
            record = measure(CASES[name], Path(scratch))
        records.append(record)
        state = "; ".join(record["faults"]) or "ok"
        print(f"{name:42} exit {record['code']}  {record['seconds']:5.1f} s  cpu {record['cpu_s']:5.1f} s  "
              f"{record['peak_mb']:5.0f} MB  {state}  {record['line'][:160]}", flush=True)
    wrong = [record["name"] for record in records if record["faults"]]
    print(f"{len(records)} cases, {sum(r['code'] == 0 for r in records)} with a result, {len(wrong)} wrong: {wrong}; "
          f"longest {max(r['seconds'] for r in records):.1f} s ({max(r['cpu_s'] for r in records):.1f} s of processor "
          f"time), largest {max(r['peak_mb'] for r in records):.0f} MB")
    if options.json:
        options.json.write_text(json.dumps(records, indent=1) + "\n")
    return 1 if wrong else 0


def measure(case: Case, scratch: Path) -> dict:
    """Builds and runs one case."""
    folder = scratch / "subject"
    arguments = case.build(folder)
    if "--subject" in arguments:
        at = arguments.index("--subject")
        folder = Path(arguments[at + 1])
        del arguments[at:at + 2]
    target = [] if "--in-place" in arguments else ["--out", str(scratch / "out")]
    arguments = [argument for argument in arguments if argument != "--in-place"]
    before = contents(scratch)
    quick = () if "--pipeline" in arguments else QUICK
    command = [sys.executable, "-m", "tools.limn", "run", str(folder), *target, *quick, *arguments, "--cores", "1"]
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    code, output, seconds, peak_mb = run(command)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = used.ru_utime + used.ru_stime - spent.ru_utime - spent.ru_stime
    after = {name: digest for name, digest in contents(scratch).items() if not name.startswith("out/")}
    line = next((text for text in output.splitlines() if re.search(case.words, text)), "") if case.words else ""
    faults = [fault for fault, is_so in {
        f"exit code {code}": code != (2 if case.words else 0) and not (code == 3 and not case.words),
        "no clear line": bool(case.words) and not line,
        "a traceback": "Traceback" in output,
        "too slow": seconds > LONGEST_S,
        "too large": peak_mb > LARGEST_MB,
        "files of the subject changed": after != before,
        "something was executed": (scratch / CANARY).exists() or Path(CANARY).exists(),
        "markup in the report": any("<img src=x" in page.read_text(encoding="utf-8", errors="replace")
                                    for page in (scratch / "out").rglob("report.html")),
        "leftovers": bool(case.words) and any((scratch / "out").rglob("*.tmp-*")),
    }.items() if is_so]
    if faults:
        print(output, file=sys.stderr)
    return {"name": case.name, "code": code, "seconds": round(seconds, 2), "cpu_s": round(cpu_s, 2),
            "peak_mb": round(peak_mb), "line": line, "faults": faults}


def contents(folder: Path) -> dict[str, str]:
    """{file: digest of its first megabyte, or where the link leads}."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = os.fsencode(path.relative_to(folder)).decode(errors="replace")
        if path.is_symlink():
            found[name] = os.readlink(path)
        elif path.is_file():
            with open(path, "rb") as file:
                found[name] = hashlib.sha256(file.read(1 << 20)).hexdigest()
    return found


def run(command: list[str]) -> tuple[int, str, float, float]:
    """-> exit code, output, wall seconds, peak memory in MB of all its processes together."""
    start, peak = time.monotonic(), 0.0
    with tempfile.TemporaryFile("w+", errors="replace") as output:
        process = psutil.Popen(command, stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        while process.poll() is None:
            peak = max(peak, resident_mb(process))
            time.sleep(0.03)
            if time.monotonic() - start > 5 * LONGEST_S:
                process.kill()
        output.seek(0)
        return process.returncode, output.read(), time.monotonic() - start, peak


def resident_mb(process: psutil.Process) -> float:
    """Resident memory of a process and all below it."""
    total = 0
    try:
        family = [process, *process.children(recursive=True)]
    except psutil.Error:
        return 0.0
    for member in family:
        try:
            total += member.memory_info().rss
        except psutil.Error:
            continue
    return total / 2**20


if __name__ == "__main__":
    raise SystemExit(main())
