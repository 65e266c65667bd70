"""What provenance.json says of the processor and of the kernels that the libraries chose for it."""

import json
import os
import platform
import subprocess
import sys

import pytest
from toy_runs import READ_TEXT, REPOSITORY, make_subject

from shared.contract import main
from shared.contract.machine import STEERING, kernels, processor

ASK = ("import json; {imports}; from shared.contract.machine import kernels; print(json.dumps(kernels()))")


def ask(imports, **steered):
    """kernels() of a process of its own."""
    kept = {name: value for name, value in os.environ.items() if name not in STEERING}
    done = subprocess.run([sys.executable, "-c", ASK.format(imports=imports)], check=True, text=True,
                          stdout=subprocess.PIPE, env={**kept, "PYTHONPATH": str(REPOSITORY), **steered})
    return json.loads(done.stdout)


def test_processor_is_named():
    found = processor()
    assert found["machine"] == platform.machine() and found["model"]
    if platform.machine() == "x86_64":
        assert "sse2" in found["flags"].split()


def test_only_what_is_loaded_is_asked():
    assert ask("import os") == {"openblas": {}, "steered": {}}


def test_every_library_says_what_it_chose():
    found = ask("import numpy, scipy.linalg, torch, cv2, numba", MKL_CBWR="COMPATIBLE")
    assert set(found) == {"numpy", "torch", "cv2", "llvmlite", "openblas", "steered"}
    assert found["steered"] == {"MKL_CBWR": "COMPATIBLE"}
    assert isinstance(found["numpy"], list) and "unknown" not in (found["torch"], found["cv2"], found["llvmlite"])
    assert len(found["openblas"]) >= 2 and "unknown" not in found["openblas"].values()


@pytest.mark.skipif(platform.machine() != "x86_64", reason="names kernels of x86-64")
def test_kernels_that_were_steered_are_those_on_record():
    """Kernels that run on every processor of today: so can a cluster be made to agree."""
    found = ask("import numpy, scipy.linalg, torch, numba", OPENBLAS_CORETYPE="Nehalem", ATEN_CPU_CAPABILITY="default",
                NUMBA_CPU_NAME="generic")
    ours = [core for name, core in found["openblas"].items() if name.startswith(("numpy", "scipy"))]
    assert ours == ["Nehalem", "Nehalem"] and found["torch"] == "DEFAULT" and found["llvmlite"] == "generic"
    assert found["steered"] == {"ATEN_CPU_CAPABILITY": "default", "NUMBA_CPU_NAME": "generic",
                                "OPENBLAS_CORETYPE": "Nehalem"}


def test_record_holds_them_and_the_manifest_does_not(tmp_path):
    subject, pipeline = make_subject(tmp_path / "anna"), tmp_path / "pipeline.yaml"
    pipeline.write_text("stages:\n  read_text: {}\n")

    def run(job):
        (job.out / "text.txt").write_text("text")

    assert main(READ_TEXT, run, None, ["--subject", str(subject), "--pipeline", str(pipeline)]) == 0
    folder = subject / "work" / "read_text"
    record = json.loads((folder / "provenance.json").read_text())
    assert record["cpu"] == processor() and record["kernels"] == json.loads(json.dumps(kernels()))
    manifest = (folder / "manifest.json").read_text()
    assert "kernels" not in manifest and "cpu" not in manifest and record["cpu"]["model"] not in manifest
