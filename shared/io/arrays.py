"""Arrays and JSON on disk: no pickle, and the same bytes for the same content."""

from __future__ import annotations

import io
import json
import math
import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np

from shared.errors import InputError

LARGEST_BYTES = 1 << 33
_EPOCH = (1980, 1, 1, 0, 0, 0)
_MOST_ARRAYS = 1000
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def save_arrays(path: Path | str, **arrays: np.ndarray) -> None:
    """Writes an .npz whose bytes depend on the arrays alone (numpy.savez stamps the time into each member)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in sorted(arrays):
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.asarray(arrays[name]), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _EPOCH), buffer.getvalue(), zipfile.ZIP_DEFLATED)


def load_arrays(path: Path | str, largest_bytes: int = LARGEST_BYTES) -> dict[str, np.ndarray]:
    """Reads an .npz of plain arrays. InputError when it is missing, damaged, needs pickle, or would need more memory
    than largest_bytes: a few kilobytes of zip can hold gigabytes, and a header can claim any shape.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > largest_bytes or len(members) > _MOST_ARRAYS:
                raise InputError("too much in the file", where=str(path), expected=f"{largest_bytes >> 20} MiB at most")
            return {member.filename.removesuffix(".npy"): _read_array(archive, member) for member in members}
    except FileNotFoundError as error:
        raise InputError("file is missing", where=str(path)) from error
    except (ValueError, OSError, EOFError, RuntimeError, NotImplementedError, MemoryError, SyntaxError,
            zipfile.BadZipFile, zlib.error) as error:
        raise InputError("not a readable .npz of plain arrays", where=str(path), got=error) from error


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """One member; ValueError where it is no plain array, or not as long as its header says."""
    if member.compress_type not in _METHODS:
        raise ValueError(f"{member.filename}: compressed in a way that is not used for arrays")
    data = io.BytesIO(archive.read(member))
    shape, fortran, dtype = _read_header(data)
    if dtype.hasobject or dtype.kind not in "biufcSU" or dtype.itemsize == 0:
        raise ValueError(f"{member.filename}: holds {dtype}, not plain numbers or text")
    count = math.prod(shape)
    if any(edge < 0 for edge in shape) or count * dtype.itemsize != len(data.getbuffer()) - data.tell():
        raise ValueError(f"{member.filename}: another length than its header says")
    values = np.frombuffer(data.getbuffer(), dtype, count, data.tell()).copy()
    return values.reshape(shape, order="F" if fortran else "C")


def _read_header(data: io.BytesIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type as an .npy header states them; ValueError where it is none.

    The header is a Python literal, and what numpy raises for broken ones depends on where they break.
    """
    version = np.lib.format.read_magic(data)
    if version not in _HEADERS:
        raise ValueError(f"format {version}")
    try:
        return _HEADERS[version](data)
    except (TypeError, SyntaxError, tokenize.TokenError, LookupError, AttributeError, RecursionError, ArithmeticError,
            MemoryError) as error:
        raise ValueError(f"not an array's header: {error}") from error


def write_json(path: Path | str, content: object) -> None:
    """Sorted keys, two spaces, a closing newline; NaN and infinity are refused (ValueError)."""
    Path(path).write_text(json.dumps(content, indent=2, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path | str) -> dict:
    """InputError when the file is missing or not JSON."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError("file is missing", where=str(path)) from error
    except (ValueError, RecursionError) as error:
        raise InputError("not valid JSON", where=str(path), got=error) from error
