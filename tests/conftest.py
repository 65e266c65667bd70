"""The tests' own shapes can be imported; the tiny subject runs once for all tests that need it."""

import atexit
import fcntl
import os
import sys
import tempfile
from pathlib import Path

import pytest

# As in the stages (shared.contract.cli.set_threads), before numpy is there: its threads spin when others want cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent / "helpers"))
pytest_plugins = ["random_order"]


def pytest_configure(config):
    """What the processes of the tests keep for each other, compiled loops above all, goes with the tests and is not the
    user's. Loops ask for the folder as they are imported, so that it must be there before tests are collected; workers
    have the first process's."""
    if not hasattr(config, "workerinput"):
        folder = tempfile.TemporaryDirectory(prefix="limn-tests-")
        config.add_cleanup(folder.cleanup)
        os.environ["LIMN_CACHE"] = folder.name


def made_once(tmp_path_factory, worker_id, name, make):
    """A folder that make(folder) has filled, by whichever worker came first."""
    if worker_id == "master":
        folder = tmp_path_factory.mktemp(name)
        make(folder)
        return folder
    folder = tmp_path_factory.getbasetemp().parent / name
    with open(folder.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = folder / "done"
        if not done.exists():
            folder.mkdir(exist_ok=True)
            make(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory, worker_id):
    """The folder (work/ and export/) of the tiny subject, from clip to export; made once for all workers."""
    from tools.goldens.tiny import TINY_SUBJECT, run_tiny

    return made_once(tmp_path_factory, worker_id, "tiny_run", run_tiny) / TINY_SUBJECT.name


@pytest.fixture(scope="session")
def tiny_scores(tiny_run, tmp_path_factory, worker_id):
    """The scores of that run's export against the tiny subject's truth; made once for all workers."""
    from shared.io.arrays import read_json, write_json
    from tools.goldens.tiny import TINY_SUBJECT
    from tools.scoring.score import score

    def make(folder):
        write_json(folder / "scores.json", score(TINY_SUBJECT, tiny_run / "export"))

    return read_json(made_once(tmp_path_factory, worker_id, "tiny_scores", make) / "scores.json")


@pytest.fixture(scope="session")
def toy_run(tmp_path_factory):
    """A subject after one run of the untouched toy pipeline, limn's exit code and what it said. For copying only."""
    from toy_runs import copy_pipeline, limn, make_subject

    folder = tmp_path_factory.mktemp("toy_run")
    pipeline, subject = copy_pipeline(folder / "toy"), make_subject(folder / "anna")
    return subject, *limn("run", subject, "--pipeline", pipeline)


@atexit.register
def forget_leaks_of_openimageio():
    """Its binding lists its own leaks on stderr when Python ends, after the test runner's closing line."""
    if "OpenImageIO" in sys.modules:
        sys.stderr.flush()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


@pytest.fixture(scope="module")
def one_thread():
    """Matrices this small are slower on several threads, much so beside other work."""
    from shared.compute.threads import single_thread

    with single_thread():
        yield


@pytest.fixture(scope="module")
def truth(one_thread):
    """The toy capture, its albedo and its irradiance."""
    from toy_capture import make_truth

    return make_truth()


@pytest.fixture(scope="module")
def matte(one_thread):
    """The same without highlights."""
    from toy_capture import make_truth

    return make_truth(specular=0.0)
