"""Installs what the optional tests need, says by name what it could not install, and runs all tests in full.

    python -m tools.setup.test_all [--only-install] [PYTEST'S ARGUMENTS]

From Debian (root and apt-get): Chromium, LLVM and TBB for Mitsuba, the libraries that Blender loads, OpenEXR's tools,
Slurm and munge. From the package index: Playwright, Mitsuba and Slurm's executor beside Limn, none of Limn's own
packages changed, and Blender's bpy in .venv-blender, since it wants an older numpy. What is there is left alone. Exit
code: pytest's, or 1 where a part could not be installed and the tests passed without it.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tools.bench.peers.blender import VARIABLE as BLENDER_VARIABLE
from tools.bench.peers.mitsuba import VARIABLE as MITSUBA_VARIABLE

REPOSITORY = Path(__file__).resolve().parents[2]
BLENDER = REPOSITORY / ".venv-blender"
PIP = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps")
LOCKED = (*PIP, "--require-hashes", "--requirement")
LLVM = "libLLVM-19.so"
PEERS = ("mitsuba==3.9.1", "drjit==1.5.0")
BPY = "bpy==5.0.1"
SIDE_BY_SIDE = ("--numprocesses", "2", "--dist", "loadfile")


@dataclass(frozen=True)
class OptionalPart:
    """commands: run in turn while `is_there` is false."""

    name: str
    is_there: Callable[[], bool]
    commands: tuple[tuple[str | Path, ...], ...]


def has_program(*names: str) -> Callable[[], bool]:
    """Whether all are on the path."""
    return lambda: all(map(shutil.which, names))


def has_module(*names: str) -> Callable[[], bool]:
    """Whether all can be found by this Python, also just after they were installed."""
    def found() -> bool:
        importlib.invalidate_caches()
        return all(map(importlib.util.find_spec, names))

    return found


def llvm() -> Path | None:
    """The LLVM that Mitsuba is to load; None where Debian's is not installed."""
    return next(iter(sorted(Path("/usr/lib").glob(f"*/{LLVM}"))), None)


def blender_imports() -> bool:
    """Whether bpy is installed and finds its libraries."""
    python = BLENDER / "bin" / "python"
    return python.is_file() and not subprocess.run([python, "-c", "import bpy"], capture_output=True).returncode


def debian(*packages: str) -> tuple[str, ...]:
    """The command that installs them."""
    return ("apt-get", "install", "--yes", "--quiet", "--no-install-recommends", *packages)


PARTS = (
    OptionalPart("Chromium", has_program("chromium"), (debian("chromium"),)),
    OptionalPart("Playwright", has_module("playwright"), ((*LOCKED, REPOSITORY / "requirements-browser.lock"),)),
    OptionalPart("OpenEXR's tools", has_program("exrheader"), (debian("openexr"),)),
    OptionalPart("LLVM 19 and TBB", lambda: llvm() is not None and any(Path("/usr/lib").glob("*/libtbb.so.12")),
                 (debian("libllvm19", "libtbb12"),)),
    OptionalPart("Mitsuba", has_module("mitsuba", "drjit"), ((*PIP, *PEERS),)),
    OptionalPart("Blender", blender_imports, (
        debian("libgl1", "libx11-6", "libxi6", "libxrender1", "libxfixes3", "libsm6", "libxkbcommon0"),
        (sys.executable, "-m", "venv", BLENDER),
        (BLENDER / "bin" / "python", "-m", "pip", "install", "--quiet", BPY))),
    OptionalPart("Slurm and munge", has_program("slurmctld", "slurmd", "munged"), (debian("slurm-wlm", "munge"),)),
    OptionalPart("Slurm's executor", has_module("snakemake_executor_plugin_slurm"),
                 ((*LOCKED, REPOSITORY / "requirements-cluster.lock"),)),
)


def install(part: OptionalPart) -> str:
    """Why the part is not there after its commands; '' where it is."""
    for command in part.commands if not part.is_there() else ():
        try:
            done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL,
                                  env=os.environ | {"DEBIAN_FRONTEND": "noninteractive"})
        except OSError as error:
            return str(error)
        if done.returncode:
            lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
            return lines[-1] if lines else f"{command[0]} ended with {done.returncode}"
    return "" if part.is_there() else "installed, but it does not load"


def failures() -> Iterator[str]:
    """Installs all parts; a line for each that could not be."""
    if shutil.which("apt-get") and any(not part.is_there() for part in PARTS):
        subprocess.run(["apt-get", "update", "--quiet"], capture_output=True)  # what it lacks, the install says
    for part in PARTS:
        if reason := install(part):
            yield f"could not install: {part.name} ({reason})"


def environment() -> dict[str, str]:
    """What makes the tests find the parts and run in full; what the caller names goes first."""
    found = {"LIMN_SLOW_TESTS": "1"}
    if library := llvm():
        found |= {"DRJIT_LIBLLVM_PATH": str(library), MITSUBA_VARIABLE: "llvm_ad_rgb"}
    if blender_imports():
        found[BLENDER_VARIABLE] = str(BLENDER / "bin" / "python")
    return found | os.environ | {"LIMN_SLOW_TESTS": "1"}


def main(words: list[str]) -> int:
    """Exit code as above."""
    missing = list(failures())
    print("\n".join(missing) or "all optional parts are installed", flush=True)
    if words[:1] == ["--only-install"]:
        return bool(missing)
    command = [sys.executable, "-m", "pytest", "-rs", *SIDE_BY_SIDE, *words]
    code = subprocess.run(command, cwd=REPOSITORY, env=environment()).returncode
    print("\n".join(missing))
    return code or bool(missing)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
