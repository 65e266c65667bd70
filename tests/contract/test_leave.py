"""A process that leaves: its exit code, what it still does, and what it does not wait for."""

import subprocess
import sys

import pytest
from toy_runs import REPOSITORY

from shared.contract.interpreter import leave

PROGRAM = '''
import atexit
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

from shared.contract.interpreter import leave


class Slow:
    """What a library takes apart at the end."""

    def __del__(self):
        print("taken apart")


slow = Slow()
atexit.register(print, "at exit")
pool = ThreadPoolExecutor(1)
pool.submit(int).result()
print("before", end=" ")
%s
'''


def run(ending):
    done = subprocess.run([sys.executable, "-c", PROGRAM % ending], env={"PYTHONPATH": str(REPOSITORY)}, text=True,
                          stdout=subprocess.PIPE, check=False)
    return done.returncode, done.stdout


def test_what_was_printed_and_registered_is_done_and_nothing_is_taken_apart():
    assert run("pool.shutdown(); leave(3)") == (3, "before at exit\n")


def test_a_thread_that_works_is_waited_for():
    program = "threading.Thread(target=lambda: (time.sleep(0.3), print('worked', end=' '))).start(); leave(0%s)"
    code, output = run(program % "")
    assert code == 0 and output.startswith("before worked at exit\n")
    assert run(program % ", wait=False") == (0, "before at exit\n")


def test_idle_threads_of_a_pool_hold_nothing_up():
    code, output = run("leave(4)")
    assert code == 4 and output.startswith("before at exit\n")


def test_where_threads_work_python_ends_the_process_itself():
    import threading

    working = threading.Event()
    thread = threading.Thread(target=working.wait)
    thread.start()
    try:
        with pytest.raises(SystemExit) as end:
            leave(5)
        assert end.value.code == 5
    finally:
        working.set()
        thread.join()
