"""A disk that fails at one chosen write, for stages that write through Python. Natively: faulty_files.c.

A write is whatever changes the disk: opening for writing, writing to, resizing or renaming a file, making a folder.
"""

from __future__ import annotations

import errno
import io
import os
import signal
from pathlib import Path

ERRORS = {"full": errno.ENOSPC, "io": errno.EIO}
KINDS = (*ERRORS, "kill")


class FaultyDisk:
    """Counts the writes below a folder and disturbs that number `at` (0: none).

    kind: full: it and all later ones fail with ENOSPC. io: it fails with EIO. kill: the process ends there. Half of
    what was to be written is on the disk then.
    """

    def __init__(self, folder: Path, kind: str = "", at: int = 0) -> None:
        self.folder, self.kind, self.at, self.count = str(folder), kind, at, 0
        self._open = io.open

    def install(self) -> None:
        """Takes the place of the functions that write, in this process for good."""
        import builtins

        io.open = builtins.open = self._opened
        for name in ("mkdir", "open"):
            setattr(os, name, self._counted(getattr(os, name), 0))
        for name in ("rename", "replace"):
            setattr(os, name, self._counted(getattr(os, name), 1))

    def tick(self, path: object) -> None:
        """One write of this path: passes, raises or kills."""
        if not str(path).startswith(self.folder):
            return
        self.count += 1
        if not self.at or self.count < self.at or (self.kind != "full" and self.count > self.at):
            return
        if self.kind == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        number = ERRORS[self.kind]
        raise OSError(number, os.strerror(number), str(path))

    def _counted(self, real, argument: int):
        def call(*arguments, **options):
            reads = real.__name__ == "open" and not arguments[1] & (os.O_WRONLY | os.O_RDWR)
            if not reads:
                self.tick(arguments[argument])
            return real(*arguments, **options)

        call.__name__ = real.__name__
        return call

    def _opened(self, file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, **more):
        if not isinstance(file, str | os.PathLike) or not {*mode} & {*"wax+"}:
            return self._open(file, mode, buffering, encoding, errors, newline, **more)
        path = os.path.abspath(file)
        self.tick(path)
        raw = _FaultyFile(path, mode.replace("b", "").replace("t", ""))
        raw.disk = self
        buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return buffered
        return io.TextIOWrapper(buffered, encoding, errors, newline, line_buffering=buffering == 1)


class _FaultyFile(io.FileIO):
    disk: FaultyDisk

    def write(self, data) -> int:
        try:
            self.disk.tick(self.name)
        except OSError:
            super().write(bytes(data)[: len(data) // 2])
            raise
        return super().write(data)

    def truncate(self, size=None) -> int:
        self.disk.tick(self.name)
        return super().truncate(size)
