"""Keeps what a subject or a pipeline names where it belongs: in its own folder.

Both come from strangers. A path in them must stay inside the folder, and a symbolic link must not lead out of it,
unless it leads into a folder for which the operator vouches: `LIMN_TRUST=/archive:/lab`, or `--trust DIR`. Stages other
than the repository's are code, so they too are loaded only from such a folder.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath

from shared.errors import InputError

TRUST = "LIMN_TRUST"
_LONGEST_NAME = 255


def trusted_folders() -> list[Path]:
    """The folders for which the operator vouches, links resolved."""
    return [Path(os.path.realpath(name)) for name in os.environ.get(TRUST, "").split(os.pathsep) if name]


def trust(folders: list[Path]) -> None:
    """Adds folders for this process and all that it starts."""
    names = [os.environ.get(TRUST, ""), *(os.path.abspath(folder) for folder in folders)]
    os.environ[TRUST] = os.pathsep.join(filter(None, names))


def is_trusted(path: Path) -> bool:
    """Whether the path leads into a folder for which the operator vouches."""
    real = Path(os.path.realpath(path))
    return any(real.is_relative_to(folder) for folder in trusted_folders())


def inside(folder: Path, value: object, where: str) -> Path:
    """The absolute path of a file that is named by a path which stays inside the folder; InputError else.

    where: what names it, for the message. That links stay inside as well is for check_link to say.
    """
    if not isinstance(value, str) or not value.strip():
        raise InputError("no file named", where=where, expected="a file in the subject's folder")
    relative = PurePosixPath(value)
    if relative.is_absolute() or ".." in relative.parts or "\\" in value:
        raise InputError("the path leaves the subject's folder", where=where, got=value, expected="a path inside it")
    if not value.isprintable() or any(len(os.fsencode(part)) > _LONGEST_NAME for part in relative.parts):
        raise InputError("not a file's name", where=where, got=value, expected="printable, 255 bytes at most")
    return folder / relative


def check_link(path: Path, folder: Path) -> None:
    """InputError where symbolic links on the way to the path lead out of the folder."""
    real, home = Path(os.path.realpath(path)), Path(os.path.realpath(folder))
    if not real.is_relative_to(home) and not is_trusted(real):
        raise InputError("a symbolic link leads out of the subject's folder", where=str(path), got=f"-> {real}",
                         hint=f"copy the file, or vouch for its folder: --trust {real.parent}")


def check_results(root: Path, work: Path) -> None:
    """InputError for symbolic links in place of results: writing or cleaning would reach through them.

    So it is for results that this user may not look at.
    """
    try:
        _check_links(root, work)
    except OSError as error:
        raise InputError("cannot be read", where=str(error.filename or work), got=error.strerror,
                         hint="check its permissions, or write elsewhere with --out DIR") from error


def _check_links(root: Path, work: Path) -> None:
    for path in (work, root / "export"):
        if path.is_symlink() and not is_trusted(path):
            raise InputError("a symbolic link in place of results", where=str(path), got=f"-> {os.path.realpath(path)}",
                             hint=f"remove it, or vouch for where it leads: --trust {os.path.realpath(path)}")
    if work.is_dir():
        for entry in os.scandir(work):
            if entry.is_symlink():
                raise InputError("a symbolic link in place of results", where=entry.path, hint="remove it")
