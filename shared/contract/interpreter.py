"""The state of the process on which a stage's last digits depend: threads of the libraries, the order of sets.

Both are settled here, and only here, whether the workflow starts a stage or somebody does so by hand; and so is where
compiled loops are kept from one stage to the next, which changes no result.
"""

from __future__ import annotations

import atexit
import logging
import os
import sys
import threading
from typing import NoReturn

from shared.contract.cache_folder import VARIABLE, cache_folder

_READ_WHEN_LOADED = ("numpy", "scipy", "torch", "cv2", "numba")


def settled_environment(threads: int) -> dict[str, str]:
    """{variable: value} that every stage runs under.

    MKL's matrix products depend on where the arrays lie in memory unless it is told to be reproducible. OpenBLAS, which
    numpy and scipy use, has one thread whatever the count: on matrices as small as theirs here, two take twice the
    processor time and end no sooner; and the tracking's sums no longer depend on the number of cores. Sets of text have
    one order. Idle OpenMP threads sleep (where nobody says otherwise: it costs time only): spinning ones stall each
    other for minutes when anything else wants the cores.
    """
    return {"OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1",
            "MKL_CBWR": "COMPATIBLE", "PYTHONHASHSEED": "0",
            "OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "PASSIVE")}


def prepare(threads: int) -> None:
    """Brings a process into that state before it has loaded any library, with loops kept where the operator says."""
    os.environ.update({VARIABLE: cache_folder(), **settled_environment(threads)})


def settle(threads: int) -> None:
    """Brings the process into that state. To be called before the stage works.

    The libraries read it when they are loaded and Python when it starts. Where that has happened already (a stage file
    by hand imports numpy first), the interpreter starts anew with the same command line; else this returns.
    """
    os.environ[VARIABLE] = cache_folder()
    wanted = settled_environment(threads)
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        late = sys.flags.hash_randomization or any(name in sys.modules for name in _READ_WHEN_LOADED)
        os.environ.update(wanted)
        if late:
            sys.stdout.flush()
            sys.stderr.flush()
            os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    set_threads(threads)


def set_threads(count: int) -> None:
    """Limits the libraries to so many threads, as far as that is possible without starting anew."""
    os.environ.update({name: value for name, value in settled_environment(count).items() if name != "PYTHONHASHSEED"})
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(count)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(count)


def leave(code: int, *, wait: bool = True) -> NoReturn:
    """Ends the process with that exit code, but does not let the libraries take their memory apart first: with torch
    that takes half a second. What has to be done at the end is done.

    wait: for threads that have to end, as Python does; False where those that are left have no more work.
    """
    others = [thread for thread in threading.enumerate() if thread is not threading.current_thread()]
    if wait and any(not thread.daemon for thread in others):
        raise SystemExit(code)
    atexit._run_exitfuncs()
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
