"""What made a result: the code that ran and the packages that computed, and what of it is another one today.

Neither is part of a key: a remark in a file or a package's new patch level would cost days of computing that change
nothing. A result is kept then, and whoever plans or runs is told; `--renew` makes it anew. What surely changes a result
raises the stage's version.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path, PurePosixPath

from shared.contract.hashing import hash_file
from shared.contract.manifest import PROVENANCE, read_record
from shared.contract.source import CODE_SUFFIXES, fingerprint

IDLE_PACKAGES = frozenset({"limn", "charset-normalizer", "Jinja2", "MarkupSafe", "packaging", "psutil", "PyYAML",
                           "setuptools", "tqdm", "typing_extensions"})
"""Loaded by stages without touching their numbers; every other package counts. Limn's own code has its fingerprints."""
_SHOWN = 3
_LONGEST = 200


def drift(folder: Path, roots: Sequence[Path]) -> list[str]:
    """Remarks on a published folder: code and packages that are others than those that made it; empty where all is the
    same. roots: where the code lies, see source.loaded_code."""
    record = read_record(folder / PROVENANCE) or {}
    code, packages = record.get("code"), record.get("packages")
    if not _is_text(code) or not _is_text(packages) or not _is_text({"python": record.get("python")}):
        return ["it is not on record which code and packages made it"]
    known, where = _sources(record), tuple(roots)
    files = [name for name, was in code.items()
             if known.get(name, "") != _source_of(name, where) and _fingerprint_of(name, where) != was]
    versions = {"Python": record["python"], **packages}
    others = [f"{name} {was} -> {_version(name)}" for name, was in sorted(versions.items())
              if name not in IDLE_PACKAGES and _version(name) != was]
    remarks = []
    if files:
        remarks.append(f"code has changed: {_shortened(files)}")
    if others:
        remarks.append(f"packages have changed: {_shortened(others)}")
    return remarks


def _sources(record: Mapping[str, object]) -> Mapping[str, str]:
    """Hashes of the files as they were; none under another Python, which gives the same text another fingerprint."""
    sources = record.get("sources")
    return sources if _is_text(sources) and record["python"] == platform.python_version() else {}


def _is_text(values: object) -> bool:
    """Whether this is a mapping of short texts that can be shown: a record may come from anybody."""
    return isinstance(values, Mapping) and all(isinstance(text, str) and text.isprintable() and len(text) <= _LONGEST
                                               for pair in values.items() for text in pair)


def _shortened(names: Sequence[str]) -> str:
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _file_of(name: str, roots: tuple[Path, ...]) -> Path | None:
    relative = PurePosixPath(name)
    if relative.is_absolute() or ".." in relative.parts or relative.suffix not in CODE_SUFFIXES:
        return None
    return next((root / relative for root in roots if (root / relative).is_file()), None)


@cache
def _source_of(name: str, roots: tuple[Path, ...]) -> str | None:
    """SHA-256 of the file as it is now, None where it is gone or no file of ours."""
    try:
        path = _file_of(name, roots)
        return hash_file(path) if path else None
    except (ValueError, OSError):
        return None


@cache
def _fingerprint_of(name: str, roots: tuple[Path, ...]) -> str:
    """Of the file as it is now, '' where it is gone, damaged or no file of ours."""
    path = _file_of(name, roots)
    try:
        return fingerprint(path) if path else ""
    except (SyntaxError, ValueError, OSError):
        return ""


@cache
def _version(package: str) -> str:
    if package == "Python":
        return platform.python_version()
    try:
        return metadata.version(package)
    except (metadata.PackageNotFoundError, ValueError):
        return "absent"
