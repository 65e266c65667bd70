"""Where what is worth keeping between runs lies, such as the machine code of compiled loops: LIMN_CACHE.

It speeds runs up and never changes a result; it may be removed at any time.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

VARIABLE = "LIMN_CACHE"


def cache_folder() -> str:
    """What the operator set; else a folder of this user's that can be written, made if need be; '' where there is none:
    nothing is kept then."""
    given = os.environ.get(VARIABLE)
    if given is not None:
        return os.path.abspath(given) if given else ""
    return next((str(folder) for folder in _candidates() if _is_ours(folder)), "")


def _candidates() -> Iterator[Path]:
    """The user's folder for caches, and one for temporary files for users without a home."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(home):
        yield Path(home) / "limn"
    yield Path(tempfile.gettempdir()) / f"limn-{os.geteuid()}"


def _is_ours(folder: Path) -> bool:
    """Whether the folder is this user's and can be written; in the folder for temporary files anybody could have been
    there before."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return (folder.stat().st_uid == os.geteuid() and not folder.is_symlink()
                and os.access(folder, os.W_OK | os.X_OK))
    except OSError:
        return False
