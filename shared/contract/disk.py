"""The disk: its space, checked before a stage starts and named as the fault where it ran out; files replaced whole."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from shared.errors import InputError

FULL_BELOW_BYTES = 1 << 20
_HINT = "free some (limn clean), or write elsewhere with --out DIR"
_FULL = (errno.ENOSPC, errno.EDQUOT)
_CLOSED = (errno.EROFS, errno.EACCES, errno.EPERM)
_BROKEN = (errno.EIO, errno.ESTALE)


def free_bytes(path: Path) -> int:
    """What is left for files at the path, or above it where it does not exist yet."""
    there = next(folder for folder in (path, *path.parents) if folder.exists())
    return shutil.disk_usage(there).free


def check_space(path: Path, needed_mb: float | None) -> None:
    """InputError where less is free than a stage is expected to write; nothing is checked for None."""
    if needed_mb is not None and free_bytes(path) < needed_mb * 1e6:
        raise InputError("not enough space on the disk", where=str(path), got=f"{free_bytes(path) / 1e6:.0f} MB",
                         expected=f"about {needed_mb:.0f} MB", hint=_HINT)


def disk_fault(error: BaseException, path: Path) -> InputError | None:
    """The fault as the operator's, where a stage failed because it could not write; None for all other failures.

    Libraries hide the reason: some name it in words only, and an almost full disk counts as the reason of any failure.
    """
    causes, cause = [], error
    while cause is not None and cause not in causes:
        causes.append(cause)
        cause = cause.__cause__ or cause.__context__
    numbers = {cause.errno for cause in causes if isinstance(cause, OSError)}
    numbers |= {number for number in (*_FULL, *_BROKEN) if any(os.strerror(number) in str(cause) for cause in causes)}
    if numbers.intersection(_FULL) or free_bytes(path) < FULL_BELOW_BYTES:
        return InputError("no space left on the disk", where=str(path), hint=_HINT)
    if numbers.intersection(_CLOSED):
        return InputError("cannot write here", where=str(path), got=str(error), hint="write elsewhere with --out DIR")
    if numbers.intersection(_BROKEN):
        return InputError("the disk fails", where=str(path), got=str(error),
                          hint="check the disk (dmesg), or write elsewhere with --out DIR")
    return None


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A place beside a file, to write what then takes the file's own. Where that fails (OSError) nothing is left of it,
    and the file is as it was."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
