"""Where a run lies on disk, and how a stage's folder appears there: complete or not at all."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from shared.contract.confine import check_results
from shared.contract.declare import Stage, folder_of
from shared.contract.manifest import LOG, outputs_digest, read_manifest
from shared.errors import InputError

CLIPS = "clips"
_HERE, _EXCHANGE = -100, 2
"""AT_FDCWD and RENAME_EXCHANGE of renameat2(2)."""
_MOST_TRIES = 1000


class RunFolder:
    """The folder that holds one subject's `work/` and `export/`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.work = root / "work"

    @classmethod
    def of(cls, folder: Path, name: str, out: Path | None) -> RunFolder:
        """The subject's own folder, or out/<name of the subject>; InputError for links in place of results."""
        run = cls(Path(os.path.abspath(out)) / name if out else folder)
        check_results(run.root, run.work)
        run.clips()
        return run

    def of_clip(self, name: str) -> RunFolder:
        """The folder of one clip's own stages, where a subject has several clips; laid out as that of a subject."""
        clip = RunFolder(self.work / CLIPS / name)
        check_results(self.work / CLIPS, self.work / CLIPS)
        check_results(clip.root, clip.work)
        return clip

    def clips(self) -> list[RunFolder]:
        """The folders of all clips that ever ran; InputError for links in place of them or of their results."""
        return [self.of_clip(path.name) for path in sorted((self.work / CLIPS).glob("*"))]

    def published(self, name: str) -> Path:
        """The stage's folder."""
        return self.root / folder_of(name)

    def stamp(self, name: str) -> Path:
        """The file that Snakemake watches; it holds the digest of the stage's outputs."""
        return self.work / f"{name}.stamp"

    def failed(self, name: str) -> Path:
        """Where the log of a failed stage stays."""
        return self.work / f"{name}.failed"

    @property
    def memory(self) -> Path:
        """Remembered file hashes."""
        return self.work / ".hashes.json"

    def temporary(self, name: str) -> Path:
        """A fresh folder beside the stage's, for the process to write into."""
        path = self.temporary_of(name, os.getpid())
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise InputError("cannot write here", where=str(self.work), got=error.strerror,
                             hint="write elsewhere with --out DIR") from error
        return path

    def temporary_of(self, name: str, process: int) -> Path:
        """Where the process of that number writes."""
        return self.work / f".{name}.tmp-{process}"

    def publish(self, temporary: Path, name: str) -> None:
        """Renames the finished folder into place, in one step with the folder of an earlier run, which is removed then.

        Where the file system cannot exchange two folders, the earlier one is moved aside first: a process that is
        killed between the two steps leaves it for remove_leftovers to put back.
        """
        target = self.published(name)
        old = self.work / f".{name}.old-{os.getpid()}"
        target.parent.mkdir(parents=True, exist_ok=True)
        if not target.exists():
            temporary.rename(target)
        elif exchange(temporary, target):
            with contextlib.suppress(OSError):
                temporary.rename(old)
        else:
            target.rename(old)
            try:
                temporary.rename(target)
            except OSError:
                old.rename(target)
                raise
        for path in (old, temporary, self.failed(name)):
            shutil.rmtree(path, ignore_errors=True)

    def inputs(self, stage: Stage, clips: Sequence[str]) -> dict[str, Path]:
        """{name: folder} of a stage's inputs; of those that it joins one of each clip, as clip/name."""
        folders = {}
        for name in stage.inputs:
            if clips and name in stage.joins:
                folders |= {f"{clip}/{name}": self.of_clip(clip).published(name) for clip in clips}
            else:
                folders[name] = self.published(name)
        return folders

    def write_stamp(self, name: str) -> None:
        """Writes the stamp of the published folder."""
        manifest = read_manifest(self.published(name))
        if manifest is None:
            raise FileNotFoundError(self.published(name) / "manifest.json")
        stamp = self.stamp(name)
        temporary = stamp.with_name(f".{stamp.name}.{os.getpid()}")
        temporary.write_text(outputs_digest(manifest) + "\n", encoding="utf-8")
        temporary.replace(stamp)

    def keep_failed(self, temporary: Path, name: str) -> Path:
        """Keeps the log of a failed stage and drops the rest; returns the log's path."""
        failed = self.failed(name)
        shutil.rmtree(failed, ignore_errors=True)
        failed.mkdir(parents=True)
        log = failed / LOG
        with contextlib.suppress(FileNotFoundError):
            (temporary / LOG).rename(log)
        shutil.rmtree(temporary, ignore_errors=True)
        return log

    def leftovers(self, name: str) -> list[Path]:
        """What killed processes left of the stage. Only the holder of the stage's lock may remove it."""
        return [path for kind in ("tmp", "old") for path in self.work.glob(f".{name}.{kind}-*")]

    def remove_leftovers(self, name: str) -> None:
        """Removes what killed processes left of the stage; a result that was moved aside for a new one comes back."""
        for path in self.leftovers(name):
            if ".old-" in path.name and not self.published(name).exists() and read_manifest(path) is not None:
                path.rename(self.published(name))
            shutil.rmtree(path, ignore_errors=True)
        for path in (*self.work.glob(f".{name}.stamp.*"), *self.work.glob(f"{self.memory.name}.*")):
            path.unlink(missing_ok=True)

    def is_locked(self, name: str) -> bool:
        """Whether another living process holds the lock now."""
        return _is_held(self.work / f".{name}.lock")

    @contextlib.contextmanager
    def locked(self, name: str, wait_s: float = 0.0) -> Iterator[None]:
        """Holds `work/.<name>.lock`. InputError where another living process holds it for longer than wait_s.

        The kernel releases the lock with its process, so a killed run never leaves a stale one. Folders in which
        nothing lies in the end are removed.
        """
        path = self.work / f".{name}.lock"
        added = [folder for folder in self.root.parents if not folder.exists()]
        file = _acquire(path, time.monotonic() + wait_s)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
            os.close(file)
            with contextlib.suppress(OSError):
                for folder in (self.work, self.root, *added):
                    folder.rmdir()


def exchange(one: Path, other: Path) -> bool:
    """Lets two folders change places in one step; False where the system or the file system cannot."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if sys.platform == "linux" else None
    if rename is None:
        return False
    if rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP):
        return False
    raise OSError(number, os.strerror(number), str(other))


def _is_held(path: Path) -> bool:
    """Whether a living process holds the lock file."""
    try:
        file = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(file)
    return False


def _acquire(path: Path, deadline: float) -> int:
    """File descriptor of the lock, held; its file holds the process id.

    A process that releases its lock removes the empty folder, too, between our making it and our opening the lock:
    that is tried again. Where no folder can be made at all (/proc), it is as absent after many tries.
    """
    tries = 0
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        except OSError as error:
            tries += 1
            if isinstance(error, FileNotFoundError) and tries < _MOST_TRIES:
                continue
            raise InputError("cannot write here", where=str(path.parent), got=error.strerror,
                             hint="write elsewhere with --out DIR") from error
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = os.read(file, 32).decode(errors="replace").strip()
            os.close(file)
            if error.errno not in (errno.EACCES, errno.EAGAIN):
                raise
            if time.monotonic() > deadline:
                raise InputError("another process works here", where=str(path.parent), got=f"process {owner or '?'}",
                                 hint="wait for it or end it") from error
            time.sleep(0.05)
            continue
        if _is_same_file(path, file):
            with contextlib.suppress(OSError):  # a full disk; who holds the lock is for people only
                os.ftruncate(file, 0)
                os.write(file, f"{os.getpid()}\n".encode())
            return file
        os.close(file)


def _is_same_file(path: Path, file: int) -> bool:
    """Whether the path still leads to the opened file (a releasing process removes it)."""
    try:
        return os.stat(path).st_ino == os.fstat(file).st_ino
    except FileNotFoundError:
        return False
