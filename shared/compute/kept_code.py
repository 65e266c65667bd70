"""Machine code of compiled loops, kept on disk from one process to the next: to compile them anew takes each stage
longer than many of them run.

LIMN_CACHE names the folder; without it nothing is kept. A file's name is the hash of all that its code follows from:
the sources, the constants, the types of the arguments, the processor, the versions and numba's settings. Where any of
these is another, the file is not found, and the loop is compiled as if nothing were kept. A file is believed only if
nobody else can have written it and its own hash fits; a damaged one is compiled again and replaced.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import platform
import stat
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import llvmlite
import numba
import numpy
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

VARIABLE = "LIMN_CACHE"
MOST_FILES = 300
"""Each half a hundred kilobytes. The loops of one version of the sources take a tenth of that."""
_LIBRARY = Path(__file__).resolve().parents[1]
_HASH_BYTES = hashlib.sha256().digest_size
_REFERENCE_COUNTS = {"NRT_incref", "NRT_decref"}
_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH


class KeptCode(_Cache):
    """What numba asks for a loop's machine code before it compiles, and hands it to afterwards (numba's interface for
    caches)."""

    def __init__(self, loop: Callable, folder: Path) -> None:
        self._loop, self._folder, self._enabled = loop, folder, True

    @property
    def cache_path(self) -> str:
        """The folder."""
        return str(self._folder)

    def enable(self) -> None:
        """Keeps code from now on."""
        self._enabled = True

    def disable(self) -> None:
        """Neither reads nor writes from now on."""
        self._enabled = False

    def flush(self) -> None:
        """Nothing waits in memory."""

    def load_overload(self, sig: object, target_context: object) -> CompileResult | None:
        """The loop for arguments of these types; None where no sound file of it is there."""
        target_context.refresh()
        key = self._key(sig, target_context.codegen())
        content = read_own_file(self._file(key)) if self._enabled else b""
        code = content[_HASH_BYTES:]
        if not content or content[:_HASH_BYTES] != _seal(key, code):
            return None
        return CompileResult._rebuild(target_context, *pickle.loads(code))

    def save_overload(self, sig: object, data: CompileResult) -> None:
        """Keeps a loop that was just compiled; a disk that is full or not ours costs time only."""
        if not self._enabled or not stands_alone(data):
            return
        key, code = self._key(sig, data.codegen), dumps(data._reduce())
        with contextlib.suppress(OSError):
            write_whole(self._file(key), _seal(key, code) + code)
            forget_oldest(self._folder, MOST_FILES)

    def _key(self, sig: object, codegen: object) -> str:
        settings = sorted((name, value) for name, value in os.environ.items() if name.startswith("NUMBA_"))
        return repr((self._loop.__module__, self._loop.__qualname__, str(sig), codegen.magic_tuple(), settings,
                     numba.config.USING_SVML, _own_sources(self._loop.__code__.co_filename),
                     sorted(set(constants(self._loop))), platform.python_implementation(), platform.python_version(),
                     numba.__version__, llvmlite.__version__, numpy.__version__))

    def _file(self, key: str) -> Path:
        return self._folder / f"{self._loop.__name__}-{_hash_of(key.encode())}"


def stands_alone(code: CompileResult) -> bool:
    """Whether the machine code holds the loop and nothing else: no addresses of this process, no copies of functions.

    Of several copies in memory the linker takes the one that came first. They may differ in last digits, so that the
    bits would hang on which loops were read and which compiled; and numba numbers them anew in each process.
    """
    described = code.fndesc
    own = {described.llvm_func_name, described.llvm_cpython_wrapper_name, described.llvm_cfunc_wrapper_name}
    held = {function.name for function in code.library.get_defined_functions()}
    return not code.lifted and not code.library.has_dynamic_globals and held <= own | _REFERENCE_COUNTS


def constants(loop: Callable) -> Iterator[tuple[str, str]]:
    """(name, value) of what a loop, and those that it calls, take from their modules: compiled in, and it need not
    follow from the sources alone."""
    for name in loop.__code__.co_names:
        value = loop.__globals__.get(name)
        if isinstance(value, Dispatcher):
            yield from constants(value.py_func)
        elif isinstance(value, numpy.ndarray):
            yield name, f"{value.dtype.str} {value.shape} {_hash_of(value.tobytes())}"
        elif isinstance(value, (bool, int, float, complex, str, tuple, numpy.generic)):
            yield name, repr(value)


def _seal(key: str, code: bytes) -> bytes:
    """What a file begins with: the hash of the rest and of its name's meaning."""
    return hashlib.sha256(key.encode() + b"\0" + code).digest()


def read_own_file(path: Path) -> bytes:
    """The content of a file that this user wrote and nobody else could change or put there; empty where it is not such
    a file.

    What is read here will be executed. So the folder has to be this user's as well: where others may write, they can
    link to any file of ours, such as a clip that they made.
    """
    try:
        with _opened(path.parent, os.O_DIRECTORY) as folder, _opened(path.name, 0, folder) as descriptor:
            whole = stat.S_ISDIR(os.fstat(folder).st_mode) and stat.S_ISREG(os.fstat(descriptor).st_mode)
            if not whole or not _is_ours_alone(folder) or not _is_ours_alone(descriptor):
                return b""
            with open(descriptor, "rb", closefd=False) as file:
                return file.read()
    except OSError:
        return b""


@contextlib.contextmanager
def _opened(path: Path | str, flags: int, folder: int | None = None) -> Iterator[int]:
    """The file's descriptor; never that of what a link leads to, and a pipe is not waited for."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC | flags, dir_fd=folder)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _is_ours_alone(descriptor: int) -> bool:
    facts = os.fstat(descriptor)
    return facts.st_uid == os.geteuid() and not facts.st_mode & _OTHERS_MAY_WRITE


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file in one step, so that another process never finds a part of it. OSError where that cannot be."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".")
    try:
        with open(descriptor, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def forget_oldest(folder: Path, most: int) -> None:
    """Removes the files that were written first where there are more than so many."""
    files = sorted((entry.stat().st_mtime, entry.path) for entry in os.scandir(folder) if entry.is_file())
    for _, path in files[:max(0, len(files) - most)]:
        Path(path).unlink(missing_ok=True)


def hash_of_sources(folder: Path) -> str:
    """Of all Python files below the folder: a loop takes in what it calls, and constants of other modules."""
    files = sorted(folder.rglob("*.py"))
    return _hash_of(repr([(str(path.relative_to(folder)), _hash_of(path.read_bytes())) for path in files]).encode())


def _hash_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@cache
def _own_sources(file: str) -> tuple[str, ...]:
    """Hashes of the library's sources, and of the file that the loop is in where that lies elsewhere."""
    source = Path(file)
    return (_hash_of_library(), "" if source.is_relative_to(_LIBRARY) else _hash_of(source.read_bytes()))


@cache
def _hash_of_library() -> str:
    return hash_of_sources(_LIBRARY)
