"""`limn check`: whether results are, file by file, what was published, and whether other programs can read them as
they are meant; needs nothing but the export folders."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from shared.contract.hashing import hash_file
from shared.contract.sums import SUMS, faults_of, files_below, read_sums
from shared.errors import InputError, shown
from tools.cli.cases import InputErrors

_SHOWN = 5
_STAGE, _FIRST_WITH_SUMS = "export_usd", 4
_OF_A_HEAD = ("head.usda", "mesh.obj")
"""One of these is in every export of a head; what other pipelines export is compared with its hashes alone."""


def check_exports(folders: Sequence[Path], hashes_only: bool = False) -> Iterator[str]:
    """A line for each export that is whole; in the end InputErrors for all that is wrong with the others. hashes_only:
    files are compared with what was published and not looked into."""
    errors: list[InputError] = []
    for folder in folders:
        try:
            for export in find_exports(folder):
                lines, found = _check(export, hashes_only)
                errors += found
                yield from lines
        except InputError as error:
            errors.append(error)
    if errors:
        raise InputErrors(errors)


def find_exports(folder: Path) -> list[Path]:
    """The folder itself where it holds an export, its export/, or those of the subjects in it."""
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder))
    marks = (SUMS, *_OF_A_HEAD)
    try:
        near = [path for path in (folder, folder / "export") if any((path / mark).is_file() for mark in marks)]
        found = {path.parent for mark in marks for path in folder.glob(f"*/export/{mark}")}
        return near[:1] or sorted(found) or [folder]
    except OSError as error:
        raise InputError("cannot be read", where=str(error.filename or folder), got=error.strerror) from error


def _check(export: Path, hashes_only: bool) -> tuple[list[str], list[InputError]]:
    """What to say of an export, and what is wrong with it."""
    version = _written_by(export)
    try:
        sums = _published(export, version)
        errors = list(faults_of(export, sums))
        names = files_below(export)
    except InputError as error:
        return [], [error]
    except OSError as error:
        return [], [InputError("cannot be read", where=str(error.filename or export), got=error.strerror)]
    more = sorted(set(names) - {*sums, SUMS}) if sums else []
    lines = _unlisted(export, more)
    facts = [f"{len(sums)} files are as published"] if sums else [
        f"no {SUMS} (export_usd {version} wrote none): nobody can tell whether files are as published"]
    if not hashes_only and {*sums, *names} & {*_OF_A_HEAD}:
        damaged = [Path(error.where).relative_to(export).as_posix() for error in errors]
        found, unchecked, faults = _content(export, version, [*damaged, *more])
        errors += faults
        facts += found
        lines += [f"{export}: not checked: {', '.join(unchecked)}"] if unchecked else []
    if not errors:
        own = [f"SHA-256 of {SUMS}: {hash_file(export / SUMS)}"] if sums else []
        lines.append(f"{export}: {'; '.join([*facts, *own])}")
    return lines, errors


def _written_by(export: Path) -> int | None:
    """The version of export_usd that its manifest states; None where it states none."""
    try:
        manifest = json.loads((export / "manifest.json").read_text(encoding="utf-8"))
        version = manifest["version"] if manifest["stage"] == _STAGE else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return version if isinstance(version, int) else None


def _published(export: Path, version: int | None) -> Mapping[str, str]:
    """{file: SHA-256}; empty for exports of versions that wrote no list. InputError where the list is missing."""
    if version is not None and version < _FIRST_WITH_SUMS and not (export / SUMS).exists():
        return {}
    return read_sums(export)


def _unlisted(export: Path, more: Sequence[str]) -> list[str]:
    named = ", ".join(name if name.isprintable() else shown(name) for name in more[:_SHOWN])
    named += f" and {len(more) - _SHOWN} more" if len(more) > _SHOWN else ""
    return [f"{export}: not published with it, not checked: {named}"] if more else []


def _content(
    export: Path, version: int | None, closed: Sequence[str]
) -> tuple[list[str], list[str], list[InputError]]:
    """What is in the files: facts, what could not be checked, faults. closed: files that are not opened, since they
    are damaged or nobody published them."""
    from shared.io.export_checks import check_export
    from stages.export_usd import STAGE

    older = version is None or version < STAGE.version
    found = check_export(export, closed, older)
    faults = [InputError(fault.what, where=str(export / fault.file), hint=fault.hint) for fault in found.faults]
    by = f"export_usd {version} wrote it, this is {STAGE.version}"
    return found.facts, found.unchecked + [by] * bool(older and found.unchecked), faults
