"""Compiled loops that processes keep for each other: the same bits, and only what is sound and ours is executed."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

from shared.compute.kept_code import VARIABLE, constants, forget_oldest, hash_of_sources, read_own_file, write_whole
from shared.contract import cache_folder

REPOSITORY = Path(__file__).resolve().parents[2]
LOOPS = '''
import sys

import numba.core.event as events
import numpy as np

from shared.compute.compiled import compiled, compiled_part

FACTOR = np.float32(%s)


@compiled_part
def weigh(x, scale):
    return np.sqrt(x * scale + FACTOR) / (x * x + scale)


@compiled
def total(values, scale):
    result = np.float32(0.0)
    for i in range(len(values)):
        result += weigh(values[i], scale)
    return result


@compiled
def weights(values, scale, result):
    for i in range(len(values)):
        result[i] = weigh(values[i], scale) + weigh(scale, values[i])


@compiled
def of_its_own(values, first):
    """Too long to be taken in where it is called."""
    result = np.float32(0.0)
    for i in range(first, len(values)):
        for j in range(i):
            result += np.sqrt(values[i]) / (values[j] + result) + np.sin(values[i])
        for j in range(i):
            result *= np.exp(values[j] - np.sqrt(values[i]))
    return result


@compiled
def caller(values):
    return of_its_own(values, 1) + of_its_own(values, 2) * of_its_own(values, 3)


def make_closed(shift):
    @compiled
    def closed(values):
        return values[0] + shift
    return closed


closed = make_closed(np.float32(len(sys.argv)))


class Count(events.Listener):
    loops = 0

    def on_start(self, event):
        self.loops += event.data["dispatcher"].py_func.__name__ in ("total", "weights", "caller", "closed")

    def on_end(self, event):
        pass


count = Count()
events.register("numba:compile", count)
values, result = np.random.default_rng(0).random(10007, np.float32), np.empty(10007, np.float32)
for name in sys.argv[1:]:
    if name == "total":
        bits = np.float32(total(values, np.float32(0.7)))
    elif name == "caller":
        bits = np.float32(caller(values[:9]))
    elif name == "closed":
        bits = np.float32(closed(values))
    else:
        weights(values, np.float32(0.7), result)
        bits = result
    print(bits.tobytes()[-400:].hex(), end=" ")
print(count.loops)
'''
BOTH = ("total", "weights")


class Loops:
    """A program with loops that share a part, and the folder in which it keeps them."""

    def __init__(self, folder: Path) -> None:
        self.script, self.cache = folder / "loops.py", folder / "cache"
        self.script.write_text(LOOPS % "0.3")

    def start(self, *names: str, **settings: str) -> subprocess.Popen:
        """A process of its own that runs the named loops."""
        environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
        environment |= {VARIABLE: str(self.cache), "PYTHONPATH": str(REPOSITORY)} | settings
        return subprocess.Popen([sys.executable, str(self.script), *names], env=environment, text=True,
                                stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def run(self, *names: str, **settings: str) -> tuple[list[str], int]:
        """The bits that the named loops give, in a process of its own, and how many loops it had to compile."""
        return ended(self.start(*names, **settings))

    def files(self) -> list[Path]:
        """What is kept."""
        return sorted((self.cache / "loops").iterdir())


def ended(process: subprocess.Popen) -> tuple[list[str], int]:
    """What the process printed: bits, and how many loops it had to compile."""
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    *bits, compiled = out.split()
    return bits, int(compiled)


@pytest.fixture
def loops(tmp_path):
    return Loops(tmp_path)


def test_both_rooms_mean_the_same_variable():
    assert cache_folder.VARIABLE == VARIABLE


def test_kept_loops_give_the_bits_of_compiled_ones_in_any_order(loops):
    bits, compiled = loops.run(*BOTH, LIMN_CACHE="")
    assert compiled == 2 and not loops.cache.exists()
    assert loops.run("total") == (bits[:1], 1)
    assert loops.run(*BOTH) == (bits, 1)
    assert loops.run(*BOTH) == (bits, 0)
    assert loops.run(*BOTH[::-1]) == (bits[::-1], 0)
    assert {path.name.partition("-")[0] for path in loops.files()} == set(BOTH)


def test_a_loop_with_calls_to_functions_of_their_own_is_not_kept(loops):
    for _ in range(2):
        assert loops.run("caller")[1] == 1
    assert {path.name.partition("-")[0] for path in loops.files()} <= {"of_its_own"}


def test_a_loop_that_closes_over_variables_is_not_kept(loops):
    (one,), _ = loops.run("closed")
    (other, _), compiled = loops.run("closed", "closed")
    assert one != other and compiled == 1


def test_what_loops_of_the_library_call_becomes_a_part_of_them():
    """Else they would not be kept."""
    count = 0
    for path in sorted(REPOSITORY.joinpath("shared").rglob("*.py")):
        if "from shared.compute.compiled import" not in path.read_text():
            continue
        module = import_module(".".join(path.relative_to(REPOSITORY).with_suffix("").parts))
        for loop in [value for value in vars(module).values() if isinstance(value, Dispatcher)]:
            called = [loop.py_func.__globals__.get(name) for name in loop.py_func.__code__.co_names]
            parts = [part for part in called if isinstance(part, Dispatcher)]
            assert all(part.targetoptions.get("forceinline") for part in parts), loop
            count += 1
    assert count > 10


def _flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def _exchange(path):
    """The sound file of another loop under this one's name."""
    path.write_bytes(next(other for other in path.parent.iterdir() if other != path).read_bytes())


DAMAGES = {
    "one bit": _flip,
    "cut": lambda path: os.truncate(path, path.stat().st_size // 2),
    "cut within the hash": lambda path: os.truncate(path, 7),
    "empty": lambda path: os.truncate(path, 0),
    "another loop's": _exchange,
}


def test_a_damaged_file_is_compiled_again_and_replaced(loops):
    bits, _ = loops.run(*BOTH)
    sound = {path: path.read_bytes() for path in loops.files()}
    for damage in DAMAGES.values():
        damage(loops.files()[0])
        assert loops.run(*BOTH) == (bits, 1)
        assert {path.name for path in loops.files()} == {path.name for path in sound}
    assert loops.run(*BOTH) == (bits, 0)


def test_two_processes_at_once(loops):
    bits, _ = loops.run(*BOTH, LIMN_CACHE="")
    for process in [loops.start(*BOTH) for _ in range(3)]:
        assert ended(process)[0] == bits
    assert loops.run(*BOTH) == (bits, 0) and len(loops.files()) == 2


def test_other_sources_settings_and_processors_are_other_files(loops):
    before, _ = loops.run(*BOTH)
    assert loops.run(*BOTH, NUMBA_OPT="1")[1] == 2
    assert loops.run(*BOTH, NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="")[1] == 2
    loops.script.write_text(LOOPS % "0.4")
    after, compiled = loops.run(*BOTH)
    assert compiled == 2 and all(one != other for one, other in zip(before, after, strict=True))
    loops.script.write_text(LOOPS % "0.3")
    assert loops.run(*BOTH) == (before, 0)


def test_constants_of_the_modules_count():
    lobes = import_module("shared.rendering.lobes")
    found = dict(constants(lobes._sum_lobes.py_func))
    assert found["MINIMUM_COSINE"] == repr(lobes.MINIMUM_COSINE)  # which a part of the loop uses


def test_without_a_folder_that_can_be_written_nothing_is_kept(loops):
    loops.cache.write_text("a file where the folder should be")
    for _ in range(2):
        assert loops.run("total")[1] == 1


def test_a_folder_that_others_may_write_is_not_believed(loops):
    bits, _ = loops.run("total")
    for mode in (0o720, 0o702):
        (loops.cache / "loops").chmod(mode)
        assert loops.run("total") == (bits, 1)
    (loops.cache / "loops").chmod(0o755)
    assert loops.run("total") == (bits, 0)


def test_only_what_this_user_alone_can_write_is_read(tmp_path):
    path = tmp_path / "kept" / "code"
    write_whole(path, b"code")
    assert read_own_file(path) == b"code" and not path.stat().st_mode & 0o077
    (path.parent / "link").symlink_to(path)
    os.mkfifo(path.parent / "pipe")
    for name in ("link", "pipe", "none", "."):
        assert read_own_file(path.parent / name) == b""
    (tmp_path / "linked").symlink_to(path.parent)
    assert read_own_file(tmp_path / "linked" / "code") == b""
    for mode in (0o620, 0o602):
        path.chmod(mode)
        assert read_own_file(path) == b""
    path.chmod(0o600)
    if os.geteuid() == 0:
        os.chown(path, 12345, -1)
        assert read_own_file(path) == b""
        os.chown(path, 0, -1)
        os.chown(path.parent, 12345, -1)
        assert read_own_file(path) == b""


def test_a_failed_write_leaves_nothing(tmp_path):
    (tmp_path / "code" / "within").mkdir(parents=True)
    with pytest.raises(OSError):
        write_whole(tmp_path / "code", b"code")
    assert [path.name for path in tmp_path.iterdir()] == ["code"]


def test_the_oldest_go(tmp_path):
    for age, name in enumerate("cabd"):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (age, age))
    forget_oldest(tmp_path, 2)
    assert {path.name for path in tmp_path.iterdir()} == set("bd")


def test_every_source_counts(tmp_path):
    (tmp_path / "a").mkdir()
    seen = {hash_of_sources(tmp_path)}
    for name, content in (("a/b.py", "1"), ("a/b.py", "2"), ("b.py", "2")):
        (tmp_path / name).write_text(content)
        seen.add(hash_of_sources(tmp_path))
    assert len(seen) == 4
