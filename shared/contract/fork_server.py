"""Starts stages as forks of processes that have loaded what the stage loads: imports are off the path of a run then.

    python -m shared.contract.fork_server FOLDER ROOT PACKAGE STAGE:THREADS:JOBS...

For each of the stages, in order, a process executes the imports at the top of the stage's file and of its `run`, which
every run of the stage begins with, and nothing else; so a fork of it holds what a stage that starts alone would hold.
Then it listens at FOLDER/STAGE and forks a child for each job that shared/contract/fork_client.py brings. The child
takes over the job's environment, folder and output and goes on as shared/contract/launch.py. It has one thread and
memory of its own: a stage that dies takes nothing with it.

They load at low priority, one after another, but at once where a job waits. They end with their JOBS, and the kernel
ends them, and their stages, with the process that started them.
"""

from __future__ import annotations

import ast
import contextlib
import gc
import json
import os
import select
import selectors
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import NoReturn

from shared.contract import launch
from shared.contract.interpreter import leave, prepare
from shared.contract.provenance import installed_packages
from shared.contract.source import loaded_code

_LOW_PRIORITY = 5
_CHUNK = 1 << 16
_LOOKS, _LOOK_S = 200, 0.005


@dataclass(frozen=True)
class Served:
    """A stage, the threads that it is given, and how many jobs of it there will be."""

    name: str
    threads: int
    jobs: int

    @classmethod
    def of(cls, text: str) -> Served:
        """From STAGE:THREADS:JOBS."""
        name, threads, jobs = text.split(":")
        return cls(name, int(threads), int(jobs))

    def __str__(self) -> str:
        return f"{self.name}:{self.threads}:{self.jobs}"


def main() -> int:
    """Serves until all jobs are done; 0."""
    folder, root, package, *texts = sys.argv[1:]
    waiting = [(stage, _listener(Path(folder), stage.name)) for stage in map(Served.of, texts)]
    loading: list[int] = []  # one that loads ahead: it closes its end of a pipe when it has
    while waiting:
        asked, _, _ = select.select([*loading, *(listener for _, listener in waiting)], [], [], None if loading else 0)
        urgent = next((pair for pair in waiting if pair[1] in asked), None)
        if urgent is None and loading:
            os.close(loading.pop())
        stage, listener = urgent or waiting[0]
        waiting.remove((stage, listener))
        ready, tell = os.pipe()
        if os.fork() == 0:
            for descriptor in (ready, *loading):
                os.close(descriptor)
            for _, other in waiting:
                other.close()
            _serve_and_end(stage, listener, tell, root, package)
        os.close(tell)
        listener.close()
        if urgent is None:
            loading.append(ready)
        else:
            os.close(ready)
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()
    return 0


def _serve_and_end(stage: Served, listener: socket.socket, tell: int, root: str, package: str) -> NoReturn:
    """Never comes back: the stack of a forked process is its parent's."""
    code = 1
    try:
        _serve_stage(stage, listener, tell, root, package)
        code = 0
    except Exception as error:
        sys.stderr.write(f"{stage.name}: not loaded ahead: {type(error).__name__}: {error}\n")
    finally:
        sys.stderr.flush()
        os._exit(code)


def _listener(folder: Path, name: str) -> socket.socket:
    """Listens at folder/name, for this user alone. The path is taken from within: a socket's has a hundred bytes."""
    os.chdir(folder)
    before = os.umask(0o177)
    try:
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(name)
        listener.listen(128)
    finally:
        os.umask(before)
    return listener


def _serve_stage(stage: Served, listener: socket.socket, tell: int, root: str, package: str) -> None:
    """Loads, says that it has, serves the jobs."""
    launch.tie_to_parent()
    os.close(os.pidfd_open(os.getpid()))  # no stage is taken where its end could not be watched
    with contextlib.suppress(OSError):
        Path("/proc/self/comm").write_text(stage.name)  # what ps and top call it, and its forks; cut to 15 letters
    prepare(stage.threads)
    sys.path[:0] = launch.search_path(root)
    steps = steps_to_load(Path(root).joinpath(*package.split("."), f"{stage.name}.py"), Path(root))
    do_at_low_priority(steps, listener)
    for step in steps:  # those that are left
        step()
    if not _is_alone():
        raise RuntimeError("its imports started threads, which a fork would lack")
    gc.collect()
    gc.freeze()  # what the collector does not touch stays shared
    os.close(tell)
    _Children(stage, listener).serve()


def do_at_low_priority(steps: Iterator[Callable[[], object]], listener: socket.socket) -> None:
    """Does one step after another, until all are done or somebody waits at the listener.

    In a thread, since a process cannot take its priority back.
    """
    if select.select([listener], [], [], 0)[0]:
        return
    wanted, errors = threading.Event(), []
    done, tell = os.pipe()

    def work() -> None:
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LOW_PRIORITY)
            while not wanted.is_set() and (step := next(steps, None)) is not None:
                step()
        except Exception as error:
            errors.append(error)
        finally:
            os.close(tell)

    worker = threading.Thread(target=work)
    worker.start()
    select.select([listener, done], [], [])
    wanted.set()
    worker.join()
    os.close(done)
    if errors:
        raise errors[0]


def _is_alone() -> bool:
    """Whether this process has one thread. One that was joined may take the kernel a moment to end."""
    for _ in range(_LOOKS):
        if len(os.listdir("/proc/self/task")) == 1:
            return True
        time.sleep(_LOOK_S)
    return False


def steps_to_load(path: Path, root: Path) -> Iterator[Callable[[], object]]:
    """Executes the imports that every run of a stage file begins with, and looks up what its record will say of them,
    step by step."""
    for node in first_imports(path):
        yield partial(exec, compile(ast.Module([node], type_ignores=[]), str(path), "exec"), {})
    yield partial(import_module, "psutil")  # for what measures and limits each stage
    yield partial(loaded_code, (root,))
    yield installed_packages


def first_imports(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """The import statements at a stage file's top level, and those with which its function `run` begins."""
    body = ast.parse(path.read_bytes(), filename=str(path)).body
    found = [node for node in body if isinstance(node, (ast.Import, ast.ImportFrom))]
    for function in body:
        if isinstance(function, ast.FunctionDef) and function.name == "run":
            statements = function.body[ast.get_docstring(function) is not None:]
            count = next((i for i, node in enumerate(statements) if not isinstance(node, (ast.Import, ast.ImportFrom))),
                         len(statements))
            found += statements[:count]
    return [node for node in found if isinstance(node, ast.Import) or node.level == 0 and node.module != "__future__"]


class _Children:
    """The children of one server: forked for a job, killed where whoever brought it goes away, waited for."""

    def __init__(self, stage: Served, listener: socket.socket) -> None:
        self._stage, self._listener, self._left = stage, listener, stage.jobs
        self._waiting = selectors.DefaultSelector()
        self._waiting.register(listener, selectors.EVENT_READ)
        self._clients: dict[int, socket.socket] = {}  # by the child's handle

    def serve(self) -> None:
        """Until the last job is done."""
        while self._left > 0 or self._clients:
            for key, _ in self._waiting.select():
                if key.fileobj is self._listener:
                    self._accept()
                elif key.data is None:
                    self._end(key.fileobj)
                elif self._clients.get(key.data) is key.fileobj:  # whoever brought the job is gone
                    self._waiting.unregister(key.fileobj)
                    signal.pidfd_send_signal(key.data, signal.SIGKILL)

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        self._left -= 1
        if self._left == 0:
            self._waiting.unregister(self._listener)
            self._listener.close()
        if (job := _receive(client)) is None:
            client.close()
            return
        content, descriptors = job
        pid = os.fork()
        if pid == 0:
            for shared in (self._listener, self._waiting, client, *self._clients.values()):
                shared.close()
            for handle in self._clients:
                os.close(handle)
            _become(self._stage, content, descriptors)
        for descriptor in descriptors:
            os.close(descriptor)
        handle = os.pidfd_open(pid)
        self._clients[handle] = client
        self._waiting.register(handle, selectors.EVENT_READ)
        self._waiting.register(client, selectors.EVENT_READ, handle)
        _send(client, pid)

    def _end(self, handle: int) -> None:
        client = self._clients.pop(handle)
        self._waiting.unregister(handle)
        with contextlib.suppress(KeyError):
            self._waiting.unregister(client)
        ended = os.waitid(os.P_PIDFD, handle, os.WEXITED)
        os.close(handle)
        _send(client, ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status)
        client.close()


def _send(connection: socket.socket, number: int) -> None:
    with contextlib.suppress(OSError):  # nobody is there any more
        connection.sendall(f"{number}\n".encode())


def _receive(connection: socket.socket) -> tuple[dict, list[int]] | None:
    """A job, and the descriptors of its input, output and errors; None where the client went away."""
    content, descriptors, _, _ = socket.recv_fds(connection, _CHUNK, 3)
    while content and not content.endswith(b"\n"):
        more = connection.recv(_CHUNK)
        content = content + more if more else b""
    if not content or len(descriptors) != 3:
        for descriptor in descriptors:
            os.close(descriptor)
        return None
    return json.loads(content), descriptors


def _become(stage: Served, job: dict, descriptors: Sequence[int]) -> NoReturn:
    """This process becomes the stage's: as if it had been started with the job's command line."""
    try:
        parent = os.getppid()
        for wanted, descriptor in enumerate(descriptors):
            os.dup2(descriptor, wanted)
            os.close(descriptor)
        os.chdir(job["folder"])
        os.environ.clear()
        os.environ.update(job["environment"] | {"LIMN_PARENT": str(parent)})
        prepare(stage.threads)
        sys.orig_argv = [sys.executable, "-m", launch.__name__, *job["arguments"]]
        sys.argv = [launch.__file__, *job["arguments"]]
        code = launch.main()
    except SystemExit as end:
        code = 0 if end.code is None else end.code
        if not isinstance(code, int):
            sys.stderr.write(f"{code}\n")
            code = 1
    except BaseException:
        traceback.print_exc()
        code = 1
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join()
    leave(code)


if __name__ == "__main__":
    leave(main())
