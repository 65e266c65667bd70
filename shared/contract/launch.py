"""Starts a stage for the workflow: `python -m shared.contract.launch FOLDER PACKAGE NAME [stage arguments]`.

Ties the process to its parent, so that a stage never outlives a killed workflow, and holds it to its limits; answers
at once where the stage's result is current, without loading what the stage needs; else goes on as
`python -m PACKAGE.NAME`, with the threads set before anything numeric is loaded.
"""

from __future__ import annotations

import ctypes
import json
import os
import runpy
import signal
import sys
from pathlib import Path

from shared.contract.cli import answer_current, parse_request, report_input_error
from shared.contract.interpreter import leave, settle
from shared.contract.limits import hold_to_limits
from shared.contract.pipeline import REPOSITORY
from shared.contract.source import read_declaration
from shared.errors import InputError

_SET_PARENT_DEATH_SIGNAL = 1


def tie_to_parent() -> None:
    """The kernel kills this process when its parent dies (Linux; kept across exec).

    LIMN_PARENT, the parent's process id, tells whether it died before this call.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.environ.get("LIMN_PARENT", str(os.getppid())) != str(os.getppid()):
        raise SystemExit(1)


def earlier_verdict(events: Path | None) -> int | None:
    """The exit code of an earlier attempt that ended by itself: the same work would end the same way again.

    None on the first attempt, and where the earlier one was killed (out of memory, out of time, its node lost).
    """
    if events is None or int(os.environ.get("LIMN_ATTEMPT", "1")) < 2 or not events.is_file():
        return None
    last = events.read_text(encoding="utf-8").splitlines()[-1:]
    try:
        kind = json.loads(last[0])["kind"] if last else None
    except (ValueError, KeyError, TypeError):  # cut while it was written
        return None
    return {"input_error": 2, "failed": 1}.get(kind)


def search_path(root: str) -> list[str]:
    """Where the stages of a pipeline in that folder look for modules first."""
    return [root, str(REPOSITORY)]


def main() -> int:
    """0 where the stage is current, 2 where the input is at fault; otherwise what the stage says."""
    tie_to_parent()
    folder, package, name, *arguments = sys.argv[1:]
    stage = read_declaration(Path(folder).joinpath(*package.split("."), f"{name}.py"))
    try:
        request = parse_request(stage, arguments)
    except InputError as error:
        report_input_error(name, error, None)
        return 2
    if (code := earlier_verdict(request.events)) is not None:
        return code
    try:
        if answer_current(request):
            return 0
        settle(request.threads)  # which may start the interpreter anew: the limits' watcher comes after it
        hold_to_limits(name, request.run, request.events)
    except InputError as error:
        report_input_error(name, error, request.events)
        return 2
    search = search_path(folder)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [*search, os.environ.get("PYTHONPATH", "")]))
    sys.path[:0] = search
    sys.argv[1:] = arguments
    try:
        runpy.run_module(f"{package}.{name}", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if not isinstance(end.code, int):
            raise
        return end.code
    return 0


if __name__ == "__main__":
    leave(main())
