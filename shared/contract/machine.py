"""What of the processor decides last digits: its model, its features, and which of their kernels the libraries chose.

The same code on the same clip differs in its last digits between processors, since each library picks its loops by what
the processor can. These facts are for provenance.json alone. Nothing is imported here: a library that the stage did not
load computed nothing.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import sys
from collections.abc import Iterator
from pathlib import Path

STEERING = ("ATEN_CPU_CAPABILITY", "MKL_CBWR", "MKL_ENABLE_INSTRUCTIONS", "NPY_DISABLE_CPU_FEATURES",
            "NPY_ENABLE_CPU_FEATURES", "NUMBA_CPU_FEATURES", "NUMBA_CPU_NAME", "NUMBA_DISABLE_JIT",
            "ONEDNN_MAX_CPU_ISA", "OPENBLAS_CORETYPE", "OPENCV_CPU_DISABLE")
"""Variables by which an operator makes the libraries choose."""
_UNKNOWN = "unknown"
_CORE_NAME = ("scipy_openblas_get_corename64_", "scipy_openblas_get_corename", "openblas_get_corename64_",
              "openblas_get_corename")


def processor() -> dict[str, object]:
    """{"machine", "model", "flags"}: as the kernel names them; flags is '' where it names none."""
    facts: dict[str, str] = {}
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        for line in file:
            if not line.strip() and facts:
                break  # the first core stands for all
            name, _, value = line.partition(":")
            facts[name.strip()] = value.strip()
    flags = facts.get("flags") or facts.get("Features", "")
    return {"machine": platform.machine(), "model": facts.get("model name") or platform.processor() or _UNKNOWN,
            "flags": " ".join(sorted(flags.split()))}


def kernels() -> dict[str, object]:
    """{library: what it chose} of the libraries that are loaded, and the variables that steered them."""
    asked = {"numpy": _numpy, "torch": _torch, "cv2": _opencv, "llvmlite": _llvm}
    chosen: dict[str, object] = {name: ask() for name, ask in asked.items() if name in sys.modules}
    steered = {name: os.environ[name] for name in STEERING if name in os.environ}
    return chosen | {"openblas": dict(_openblas_cores()), "steered": steered}


def _numpy() -> object:
    """Instruction sets for which numpy has loops of its own and found the processor able."""
    config = sys.modules["numpy"].show_config(mode="dicts")
    return config.get("SIMD Extensions", {}).get("found", _UNKNOWN)


def _torch() -> object:
    return sys.modules["torch"].backends.cpu.get_cpu_capability()


def _opencv() -> object:
    """Its compiled features; * marks those that are chosen at run time, ? those that the processor lacks."""
    return sys.modules["cv2"].getCPUFeaturesLine()


def _llvm() -> object:
    """The processor for which numba compiles."""
    binding = sys.modules.get("llvmlite.binding")
    return os.environ.get("NUMBA_CPU_NAME") or (binding.get_host_cpu_name() if binding else _UNKNOWN)


def _openblas_cores() -> Iterator[tuple[str, str]]:
    """(library, core) of each OpenBLAS in this process: numpy, scipy and OpenCV bring one each."""
    with contextlib.suppress(OSError), open("/proc/self/maps", encoding="utf-8", errors="replace") as file:
        mapped = {line[line.find("/"):].rstrip() for line in file if "openblas" in line}
        for path in sorted(path for path in mapped if ".so" in Path(path).name):
            library = ctypes.CDLL(path)
            ask = next((getattr(library, name) for name in _CORE_NAME if hasattr(library, name)), None)
            if ask is not None:
                ask.restype = ctypes.c_char_p
                yield f"{Path(path).parent.name}/{Path(path).name}", (ask() or b"").decode(errors="replace") or _UNKNOWN
