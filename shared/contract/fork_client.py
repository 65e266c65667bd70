"""Has a job done by a child of the fork server: `python -I -S fork_client.py SOCKET ROOT PACKAGE STAGE [arguments]`.

Loads nothing but the standard library's basics. It hands over its command line, environment, folder and descriptors,
passes on the signals that ask to end, and ends as the child does. Where nobody listens it says so and becomes the
stage's process itself, by shared/contract/launch.py.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from typing import NoReturn


def main(place: str, arguments: list[str]) -> NoReturn:
    """Ends with the child's exit code, or by the signal that ended the child."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.connect(place)
        job = {"arguments": arguments, "folder": os.getcwd(), "environment": dict(os.environ)}
        content = f"{json.dumps(job)}\n".encode()
        sent = socket.send_fds(connection, [content], [0, 1, 2])
        connection.sendall(content[sent:])
        answers = connection.makefile("rb")
        first, reason = answers.readline(), "the fork server does not take it"
    except OSError as error:
        first, reason = b"", f"no fork server: {error.strerror}"
    if not first:
        sys.stderr.write(f"{arguments[2]}: starts alone, nothing is loaded ahead: {reason}\n")
        sys.stderr.flush()
        os.execv(sys.executable, [sys.executable, "-m", "shared.contract.launch", *arguments])
    child = int(first)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _frame: os.kill(child, number))
    last = answers.readline()
    code = int(last or -signal.SIGKILL)  # without a word: the server was killed, and the child with it
    if code < 0:
        if -code != signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
