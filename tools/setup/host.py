"""Checks the libraries of the operating system that our wheels load but do not bring.

    python -m tools.setup.host

pymeshlab, which only tests use, does not import without libGL, libX11 and libxcb, and without libOpenGL it imports but
silently lacks its meshing filters; where it was taken away (docs/licences.md), nothing of it is asked for. What is
missing is installed through apt where that is possible (root and apt-get); else the one command to run is printed and
the exit code is 2.
"""

import ctypes
import importlib.util
import os
import shutil
import subprocess
import sys

from tools.setup.packages import TESTS_ONLY

APT_PACKAGES = {
    "libGL.so.1": "libgl1",
    "libOpenGL.so.0": "libopengl0",
    "libX11.so.6": "libx11-6",
    "libxcb.so.1": "libxcb1",
}
"""Libraries that pymeshlab alone loads, and Debian's packages of them."""
WHEELS = {
    "cv2": "cv2.dnn.readNetFromTFLite",
    "embreex": "__import__('embreex.rtcore_scene')",
    "pymeshlab": "pymeshlab.MeshSet().meshing_surface_subdivision_loop",
    "OpenEXR": "OpenEXR.File",
    "pycolmap": "pycolmap.Reconstruction",
    "numba": "numba.njit(lambda x: x + 1)(1)",
    "pxr": "__import__('pxr.UsdGeom')",
}
"""Modules and an expression that fails where a wheel is only half there."""


def main() -> int:
    """Exit code 0 when everything loads, 2 when something is missing and could not be installed."""
    missing = missing_libraries()
    if missing:
        packages = sorted({APT_PACKAGES[library] for library in missing})
        if can_install() and install(packages):
            missing = missing_libraries()
        if missing:
            print(f"error: host libraries are missing: {', '.join(missing)}; run: {command_line(packages)}")
            return 2
    broken = broken_wheels()
    for module, reason in broken.items():
        print(f"error: the package {module} does not load: {reason}; reinstall it with make setup")
    return 2 if broken else 0


def wheels_asked_for() -> dict[str, str]:
    """WHEELS without those that only tests use and that are not installed."""
    return {name: expression for name, expression in WHEELS.items()
            if name not in TESTS_ONLY or importlib.util.find_spec(name) is not None}


def missing_libraries() -> list[str]:
    """Names of the shared libraries that the loader does not find, of those that an installed wheel loads."""
    missing = []
    for library in APT_PACKAGES if TESTS_ONLY <= wheels_asked_for().keys() else ():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(library)
    return missing


def can_install() -> bool:
    """May this process install packages through apt?"""
    return os.geteuid() == 0 and shutil.which("apt-get") is not None


def command_line(packages: list[str]) -> str:
    """The command that installs the packages."""
    prefix = "" if os.geteuid() == 0 else "sudo "
    return f"{prefix}apt-get install -y --no-install-recommends {' '.join(packages)}"


def install(packages: list[str]) -> bool:
    """Install the packages through apt; False where apt fails (the caller prints the command)."""
    print(f"host: installing {' '.join(packages)}")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (["apt-get", "update", "-qq"], command_line(packages).split()):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return done.returncode == 0


def broken_wheels() -> dict[str, str]:
    """Modules that do not load, each with the last line of its error; one process loads them all."""
    script = (
        "import importlib, sys\n"
        f"for name, expression in {wheels_asked_for()!r}.items():\n"
        "    try:\n"
        "        module = importlib.import_module(name)\n"
        "        eval(expression, {name: module})\n"
        "    except Exception as error:\n"
        "        print(name, (str(error).strip() or repr(error)).splitlines()[-1], sep='\\t')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    broken = dict(line.split("\t", 1) for line in done.stdout.splitlines() if "\t" in line)
    if done.returncode != 0:
        broken["python"] = f"exit code {done.returncode} while loading the packages"
    return broken


if __name__ == "__main__":
    raise SystemExit(main())
