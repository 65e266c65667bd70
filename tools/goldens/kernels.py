"""Ways to run the same code: which instructions the numeric libraries may use, and how many threads.

Libraries choose their kernels by the processor they find (OpenBLAS, MKL and oneDNN in torch, numpy's loops, OpenCV,
numba's compiler). Kernels add in another order and round otherwise; a result that hangs on them is not determined by
the clip. Environment variables make one machine stand for others.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
_SWITCHES = ("OPENBLAS_CORETYPE", "ATEN_CPU_CAPABILITY", "ONEDNN_MAX_CPU_ISA", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES",
             "NPY_DISABLE_CPU_FEATURES", "OPENCV_CPU_DISABLE")


@dataclass(frozen=True)
class Kernel:
    """One way to run: what the environment says to the libraries, and the number of threads of a stage."""

    name: str
    environment: Mapping[str, str] = field(default_factory=dict)
    threads: int = 2

    def variables(self) -> dict[str, str]:
        """This process's environment with the kernel's switches in place of whatever it says about kernels."""
        kept = {name: value for name, value in os.environ.items() if name not in _SWITCHES}
        return kept | dict(self.environment) | {"PYTHONHASHSEED": "0"}


OWN = Kernel("own")
HASWELL = Kernel("haswell", {
    "OPENBLAS_CORETYPE": "Haswell", "ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2",
    "NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma,+bmi,+bmi2,+f16c,+popcnt,+sse4.1,+sse4.2",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR", "OPENCV_CPU_DISABLE": "AVX512-SKX"})
LEAST = Kernel("least", {
    "OPENBLAS_CORETYPE": "Nehalem", "ATEN_CPU_CAPABILITY": "default", "ONEDNN_MAX_CPU_ISA": "SSE41",
    "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "OPENCV_CPU_DISABLE": "SSE4.1,SSE4.2,AVX,FP16,AVX2,AVX512-SKX"})
KERNELS = (OWN, HASWELL, LEAST)
ONE_THREAD, FOUR_THREADS = Kernel("1 thread", threads=1), Kernel("4 threads", threads=4)
WAYS = (*KERNELS, ONE_THREAD, FOUR_THREADS)
"""All that results are compared over."""


def by_name(name: str) -> Kernel:
    """The way to run that has this name; KeyError where there is none."""
    return {way.name: way for way in WAYS}[name]


def run_stage(
    stage: str, subject: Path, out: Path, settings: Sequence[str], way: Kernel, repository: Path = REPOSITORY
) -> subprocess.CompletedProcess:
    """`python -m stages.<stage>` of a repository on the subject, results under out/<subject>; exit code not looked at.
    """
    words = [word for setting in settings for word in ("--set", setting)]
    command = [sys.executable, "-m", f"stages.{stage}", "--subject", str(subject), "--out", str(out),
               "--threads", str(way.threads), *words]
    environment = way.variables() | {"PYTHONPATH": str(repository)}
    return subprocess.run(command, env=environment, cwd=repository, capture_output=True, text=True, check=False)
