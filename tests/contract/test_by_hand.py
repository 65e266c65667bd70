"""A stage by hand and the same stage under the workflow: one state of the process, so one result under one key."""

import json
import os
import subprocess
import sys

import pytest
from toy_runs import REPOSITORY, limn, make_subject

from shared.contract.confine import trust
from shared.contract.interpreter import settled_environment

STAGE = '''
import json
import os

import numpy as np  # as stage files do; from here on it is too late to set its threads

AT_IMPORT = {name: os.environ.get(name) for name in %r}

from shared.contract import Job, Output, Stage, main

STAGE = Stage(name="look_around", version=1, help="Writes what results could depend on.", inputs=(),
              outputs=(Output("found.json", "the state of the process"),))


def run(job: Job) -> None:
    """Threads that numpy was loaded with, the order of a set, a product in its last digits."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 400, 400))
    found = {"at_import": AT_IMPORT, "set": list({"rose", "nose", "pose", "hose"}), "product": float((a @ b).sum())}
    (job.out / "found.json").write_text(json.dumps(found, sort_keys=True))


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run))
'''


@pytest.fixture
def pipeline(tmp_path):
    folder = tmp_path / "hand"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "look_around.py").write_text(STAGE % sorted(settled_environment(1)))
    (tmp_path / "pipeline.yaml").write_text("package: hand\nstages:\n  look_around: {needs: []}\n")
    trust([tmp_path])
    return tmp_path / "pipeline.yaml"


@pytest.mark.parametrize("given", [{}, {"OPENBLAS_NUM_THREADS": "7", "PYTHONHASHSEED": "5", "MKL_CBWR": "AVX2"}],
                         ids=["bare", "other settings of the user's"])
def test_by_hand_as_under_the_workflow(pipeline, tmp_path, monkeypatch, given):
    for name in settled_environment(1):
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    subject = make_subject(tmp_path / "anna")
    code, output = limn("run", subject, "--pipeline", pipeline, "--cores", "1")
    assert code == 0, output
    search = os.pathsep.join([str(pipeline.parent), str(REPOSITORY)])
    command = [sys.executable, "-m", "hand.look_around", "--subject", subject, "--pipeline", pipeline, "--threads", "1",
               "--out", tmp_path / "by hand"]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": search}, stderr=subprocess.PIPE, text=True,
                          check=False)
    assert done.returncode == 0 and done.stderr.count("look_around: done") == 1, done.stderr
    folders = [root / "work" / "look_around" for root in (subject, tmp_path / "by hand" / "anna")]
    found = json.loads((folders[1] / "found.json").read_text())
    assert found["at_import"] == settled_environment(1)
    for name in ("found.json", "manifest.json"):
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()
