"""Arrays and JSON on disk: no pickle, and the same bytes for the same content."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np

from shared.errors import InputError

_EPOCH = (1980, 1, 1, 0, 0, 0)


def save_arrays(path: Path | str, **arrays: np.ndarray) -> None:
    """Writes an .npz whose bytes depend on the arrays alone (numpy.savez stamps the time into each member)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in sorted(arrays):
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.asarray(arrays[name]), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _EPOCH), buffer.getvalue(), zipfile.ZIP_DEFLATED)


def load_arrays(path: Path | str) -> dict[str, np.ndarray]:
    """Reads an .npz of plain arrays. InputError when it is missing, damaged or needs pickle."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise InputError("file is missing", where=str(path)) from error
    except (ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile) as error:  # TypeError: a lone .npy
        raise InputError("not a readable .npz of plain arrays", where=str(path), got=error) from error


def write_json(path: Path | str, content: object) -> None:
    """Sorted keys, two spaces, a closing newline; NaN and infinity are refused (ValueError)."""
    Path(path).write_text(json.dumps(content, indent=2, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path | str) -> dict:
    """InputError when the file is missing or not JSON."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError("file is missing", where=str(path)) from error
    except ValueError as error:
        raise InputError("not valid JSON", where=str(path), got=error) from error
