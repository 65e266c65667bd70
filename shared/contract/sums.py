"""SHA256SUMS: the hash of every file of a published result, in the form that `sha256sum --check` reads.

Unlike manifest.json it covers the records and the files that differ from run to run, too, so that a copy can be
compared with what was published, wherever it went and without anything but itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from shared.contract.hashing import hash_file
from shared.errors import InputError, shown

SUMS = "SHA256SUMS"
LARGEST_BYTES = 1 << 24
_LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")


def write_sums(folder: Path) -> None:
    """Writes the list of all files that lie in the folder, by name."""
    names = sorted(name for name in files_below(folder) if name != SUMS)
    lines = [f"{hash_file(folder / name)}  {name}\n" for name in names]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")


def read_sums(folder: Path) -> dict[str, str]:
    """{file: SHA-256} as the folder's list says; InputError where there is none, or it names files elsewhere."""
    path = folder / SUMS
    if path.is_symlink() or not path.is_file():
        raise InputError(f"no {SUMS} here", where=str(folder), expected="the export folder of a finished run",
                         hint="results of earlier versions have none: limn run writes them anew")
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read(LARGEST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise InputError("cannot be read as a list of hashes", where=str(path), got=error) from error
    if len(text) > LARGEST_BYTES or not text:
        raise InputError("no list of hashes", where=str(path), got=f"{len(text)} letters or more",
                         expected=f"1 .. {LARGEST_BYTES}")
    lines = text.removesuffix("\n").split("\n")
    return dict(_entry(line, f"{path}: line {number}") for number, line in enumerate(lines, 1))


def _entry(line: str, where: str) -> tuple[str, str]:
    match = _LINE.fullmatch(line)
    if match is None:
        raise InputError("not a hash and a file", where=where, got=shown(line))
    digest, name = match.groups()
    path = PurePosixPath(name)
    if path.is_absolute() or str(path) != name or ".." in path.parts or not name.isprintable():
        raise InputError("not a file of this folder", where=where, got=shown(name))
    return name, digest


def faults_of(folder: Path, sums: Mapping[str, str]) -> Iterator[InputError]:
    """One for each listed file that is missing, a link, cannot be read, or is another one than was published."""
    for name, digest in sums.items():
        path = folder / name
        try:
            if any(part.is_symlink() for part in (path, *list(path.parents)[:name.count("/")])):
                yield InputError("a link in place of the file", where=str(path))
            elif not path.is_file():
                yield InputError("the file is missing", where=str(path))
            elif (found := hash_file(path)) != digest:
                yield InputError("the file is not as it was published", where=str(path), got=f"SHA-256 {found}",
                                 expected=digest)
        except OSError as error:
            yield InputError("cannot be read", where=str(path), got=error.strerror)


def files_below(folder: Path) -> list[str]:
    """Names of all files, relative to the folder; links are not followed."""
    return [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_symlink() or path.is_file()]
