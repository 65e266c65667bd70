"""Content hashes of files, remembered by size and time of change so that unchanged files are not read again."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path

_BLOCK = 1 << 22


def canonical_json(value: object) -> str:
    """JSON of one spelling: sorted keys, no spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def hash_value(value: object) -> str:
    """SHA-256 of a JSON value."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes; memory does not grow with the file."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


class HashMemory:
    """SHA-256 of files under one folder and of the source, kept in `path` between calls.

    It only saves time: an entry counts while the file's size and times of change are the recorded ones (the inode's
    too, which nobody can set back), and a memory that is lost or damaged is built again.
    """

    def __init__(self, path: Path, verify: bool = False) -> None:
        """verify: read every file again, whatever is remembered."""
        self.path, self.verify, self._changed = path, verify, False
        self._known: dict[str, list] = {}
        with contextlib.suppress(OSError, ValueError, RecursionError):
            known = json.loads(path.read_text(encoding="utf-8"))
            self._known = {key: entry for key, entry in known.items() if _is_entry(entry)} if isinstance(
                known, dict) else {}

    def hash(self, path: Path) -> str:
        """SHA-256 of the file's content."""
        key, state = self._key(path), _state(path)
        known = self._known.get(key)
        if not self.verify and known is not None and known[:-1] == state:
            return known[-1]
        digest = hash_file(path)
        self._known[key], self._changed = [*state, digest], True
        return digest

    def learn(self, path: Path, digest: str) -> None:
        """Remembers a hash that was computed elsewhere."""
        self._known[self._key(path)], self._changed = [*_state(path), digest], True

    def save(self) -> None:
        """Writes what was learnt, where the folder exists and can be written."""
        if not self._changed or not self.path.parent.is_dir():
            return
        temporary = self.path.with_name(f"{self.path.name}.{os.getpid()}")
        with contextlib.suppress(OSError):
            temporary.write_text(canonical_json(self._known), encoding="utf-8")
            temporary.replace(self.path)

    def _key(self, path: Path) -> str:
        return os.path.relpath(path, self.path.parent)


def _is_entry(entry: object) -> bool:
    """Whether it is what save() writes: the file's state and its hash."""
    return isinstance(entry, list) and len(entry) == 4 and isinstance(entry[3], str) and all(
        type(value) is int for value in entry[:3])


def _state(path: Path) -> list[int]:
    stat = path.stat()
    return [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]
