"""The toy pipeline and its subjects: real processes, no video."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from shared.contract import Output, Parameter, Stage
from shared.contract.confine import trust

REPOSITORY = Path(__file__).resolve().parents[2]
TOY = Path(__file__).with_name("toy_pipeline")
TEXT = "A rose is a rose\nis a rose\n"
CURRENT_STAGES = ("read_text", "count_words", "draw_bars", "export_page")
READ_TEXT = Stage(
    name="read_text",
    version=1,
    help="Reads.",
    inputs=(),
    outputs=(Output("text.txt", "the text", unit="mm", space="uv"), Output("lines/%03d.txt", "lines", optional=True),
             Output("when.json", "times", volatile=True, optional=True)),
    parameters=(
        Parameter("size", int, 10, "Size.", "texels", 1, 100),
        Parameter("letters", str, "lower", "Letters.", choices=("lower", "upper")),
        Parameter("limit", float, None, "Limit.", "mm", 0.0),
        Parameter("fast", bool, False, "Speed."),
    ),
)


def copy_pipeline(folder):
    """The toy pipeline in a folder of its own, so that a test may change its code. Returns pipeline.yaml."""
    trust([folder])
    shutil.copytree(TOY, folder, ignore=shutil.ignore_patterns("__pycache__"))
    return folder / "pipeline.yaml"


def make_subject(folder, text=TEXT, settings="video: clip.txt\n"):
    """A subject whose clip is a text."""
    folder.mkdir(parents=True)
    (folder / "clip.txt").write_text(text)
    (folder / "subject.yaml").write_text(settings)
    return folder


def limn_process(*arguments, **environment):
    """`limn` as a process of its own, its output in one pipe."""
    inherited = {**os.environ, "PYTHONPATH": str(REPOSITORY), **environment}
    return subprocess.Popen([sys.executable, "-m", "tools.limn", *map(str, arguments)], env=inherited, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)


def limn(*arguments, **environment):
    """Runs limn; returns (exit code, what it printed)."""
    process = limn_process(*arguments, **environment)
    output, _ = process.communicate(timeout=300)
    return process.returncode, output


def wait_for(condition, seconds=120.0):
    """What the condition gives once it is true; fails after so long."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
    return found


def outputs_of(folder):
    """{file: bytes} of a run's published results, without the records of when and how long."""
    timed = ("provenance.json", "log.txt", "report.html", "when.json", "SHA256SUMS")
    found = {}
    for published in (*(folder / "work" / name for name in CURRENT_STAGES), folder / "export"):
        for path in published.rglob("*"):
            if path.is_file() and path.name not in timed:
                found[path.relative_to(folder).as_posix()] = path.read_bytes()
    return found


def tree(folder):
    """All files below a folder."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
