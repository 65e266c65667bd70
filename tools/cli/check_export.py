"""`limn check`: whether results are, file by file, what was published; needs nothing but the export folders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from shared.contract.hashing import hash_file
from shared.contract.sums import SUMS, faults_of, files_below, read_sums
from shared.errors import InputError, shown
from tools.cli.cases import InputErrors

_SHOWN = 5


def check_exports(folders: Sequence[Path]) -> Iterator[str]:
    """A line for each export that is whole; in the end InputErrors for all that is wrong with the others."""
    errors: list[InputError] = []
    for folder in folders:
        try:
            for export in find_exports(folder):
                lines, found = _check(export)
                errors += found
                yield from lines
        except InputError as error:
            errors.append(error)
    if errors:
        raise InputErrors(errors)


def find_exports(folder: Path) -> list[Path]:
    """The folder itself where it holds a list of hashes, its export/, or those of the subjects in it."""
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder))
    try:
        near = [path for path in (folder, folder / "export") if (path / SUMS).is_file()]
        return near[:1] or [path.parent for path in sorted(folder.glob(f"*/export/{SUMS}"))] or [folder]
    except OSError as error:
        raise InputError("cannot be read", where=str(error.filename or folder), got=error.strerror) from error


def _check(export: Path) -> tuple[list[str], list[InputError]]:
    """What to say of an export, and what is wrong with it."""
    try:
        sums = read_sums(export)
        errors = list(faults_of(export, sums))
    except InputError as error:
        return [], [error]
    except OSError as error:
        return [], [InputError("cannot be read", where=str(error.filename or export), got=error.strerror)]
    more = sorted(set(files_below(export)) - {*sums, SUMS})
    named = ", ".join(name if name.isprintable() else shown(name) for name in more[:_SHOWN])
    named += f" and {len(more) - _SHOWN} more" if len(more) > _SHOWN else ""
    lines = [f"{export}: not published with it, not checked: {named}"] if more else []
    if not errors:
        lines.append(f"{export}: {len(sums)} files are as published; SHA-256 of {SUMS}: {hash_file(export / SUMS)}")
    return lines, errors
