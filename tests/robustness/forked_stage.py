"""A stage that writes several files, in a process of its own per case: python tests/robustness/forked_stage.py.

A case is a line of JSON on stdin, its exit code a line on stdout. The process is small, so that its forks take
hundredths of a second; those of the test runner, after the tests before, would take a quarter of one.
"""

import contextlib
import io
import json
import os
import sys
from pathlib import Path

from faulty_files import FaultyDisk
from toy_runs import READ_TEXT

from shared.contract import folders, main


def write_all(job):
    """A stage with several files, one in a folder, one volatile."""
    (job.out / "text.txt").write_text(f"{job.subject.video.read_text()} {job.params.as_dict()}")
    (job.out / "lines").mkdir()
    for number in range(2):
        with open(job.out / "lines" / f"{number:03d}.txt", "w") as file:
            file.write("one line\n")
    (job.out / "when.json").write_text("{}")


def run_case(subject, pipeline, size, kind, at, exchanges, said, counted):
    """Runs the stage and ends the process with its exit code; what it said and how often it wrote are in files."""
    if not exchanges:
        folders.exchange = lambda one, other: False
    with open(said, "w") as file, contextlib.redirect_stderr(file), contextlib.redirect_stdout(io.StringIO()):
        disk = FaultyDisk(Path(subject), kind, at)
        disk.install()
        code = 70
        try:
            code = main(READ_TEXT, write_all, None, ["--subject", subject, "--pipeline", pipeline,
                                                     "--set", f"size={size}"])
        except BaseException as error:  # nothing of the child may reach the loop below
            sys.stderr.write(f"Traceback: {error!r}\n")
        Path(counted).write_text(str(disk.count))
    os._exit(code)


def serve():
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            run_case(**json.loads(line))
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    serve()
