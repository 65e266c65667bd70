"""A fault at each write of a stage in turn: afterwards the old result or the new one, never a third.

The same at the real stages' writes, those of the native libraries, too: python tests/robustness/fault_matrix.py writes.
"""

import errno
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from faulty_files import KINDS
from slow import SLOW
from toy_runs import REPOSITORY, make_subject

from shared.contract.disk import disk_fault
from shared.contract.folders import RunFolder
from shared.contract.hashing import HashMemory
from shared.contract.manifest import damage, read_manifest

EVERY = 1 if SLOW else 4
"""Of the stage's writes one in so many is disturbed."""

OUTCOMES = {"full": (0, 2), "io": (0, 1, 2), "kill": (-9,)}


@pytest.fixture(scope="module")
def forks():
    """The process that forks for each case."""
    paths = os.pathsep.join(map(str, (REPOSITORY, Path(__file__).parents[1] / "helpers")))
    with subprocess.Popen([sys.executable, Path(__file__).with_name("forked_stage.py")], text=True,
                          env=os.environ | {"PYTHONPATH": paths}, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as own:
        yield own
        own.stdin.close()
    assert own.returncode == 0


class Bench:
    """The stage in processes of its own."""

    def __init__(self, folder, forks):
        self.folder, self.forks, self.exchanges = folder, forks, True
        self.subject, self.pipeline = make_subject(folder / "anna"), folder / "pipeline.yaml"
        self.pipeline.write_text("stages:\n  read_text: {}\n")
        self.published = self.subject / "work" / "read_text"

    def call(self, size, kind="", at=0):
        """-> exit code, what it said, and the writes that it came to."""
        said, counted = self.folder / "said.txt", self.folder / "counted.txt"
        case = {"subject": str(self.subject), "pipeline": str(self.pipeline), "size": size, "kind": kind, "at": at,
                "exchanges": self.exchanges, "said": str(said), "counted": str(counted)}
        self.forks.stdin.write(json.dumps(case) + "\n")
        self.forks.stdin.flush()
        code = int(self.forks.stdout.readline())
        return code, said.read_text(), int(counted.read_text()) if kind == "" else 0

    def result(self):
        """{file: SHA-256} of what is published, None where nothing is; fails where it is not whole."""
        if not self.published.exists():
            return None
        manifest = read_manifest(self.published)
        assert manifest is not None, "half published"
        assert not damage(self.published, manifest, HashMemory(self.folder / "memory.json", verify=True))
        vouched = [name for name, entry in manifest["outputs"].items() if not entry.get("volatile")]
        return {name: hashlib.sha256((self.published / name).read_bytes()).hexdigest()
                for name in (*vouched, "manifest.json")}

    def restore(self, backup):
        """The subject's work/ as it was before."""
        shutil.rmtree(self.subject / "work", ignore_errors=True)
        if backup.exists():
            shutil.copytree(backup, self.subject / "work")


@pytest.mark.parametrize("number, hint", [(errno.ENOSPC, "no space left"), (errno.EDQUOT, "no space left"),
                                          (errno.EIO, "the disk fails"), (errno.ESTALE, "the disk fails")])
def test_reasons_that_libraries_give_in_words_are_understood(tmp_path, number, hint):
    said = RuntimeError(f"Failed to write pixel data to image file x.exr. {os.strerror(number)}.")
    for error in (OSError(number, os.strerror(number)), said):
        assert hint in str(disk_fault(error, tmp_path))
    assert disk_fault(ValueError("shapes differ"), tmp_path) is None


@pytest.mark.parametrize("before", ["nothing", "earlier result", "earlier result, no exchange"])
@pytest.mark.parametrize("kind", KINDS)
def test_old_result_or_new_one_never_a_third(tmp_path, monkeypatch, forks, kind, before):
    bench, backup = Bench(tmp_path, forks), tmp_path / "backup"
    if before != "nothing":
        assert bench.call(3)[0] == 0
        shutil.copytree(bench.subject / "work", backup)
    if before.endswith("no exchange"):  # as on NFS: a kill between two renames is mended by whoever comes next
        monkeypatch.setattr("shared.contract.folders.exchange", lambda one, other: False)
        bench.exchanges = False
    old = bench.result()
    code, said, writes = bench.call(4)
    new = bench.result()
    assert code == 0 and writes > 15 and new not in (None, old)
    ends = set()
    for at in range(1 + len(before) % EVERY, writes + 1, EVERY):
        bench.restore(backup)
        code, said, _ = bench.call(4, kind, at)
        where = f"{kind} at write {at}: exit code {code}, {said}"
        if before.endswith("no exchange"):
            RunFolder(bench.subject).remove_leftovers("read_text")
        found = bench.result()
        assert found in (old, new), where
        assert code in OUTCOMES[kind] and "Traceback" not in said, where
        assert code != 0 or found == new, where
        assert code != 2 or said.startswith("read_text: ") and said.count("\n") == 1, where
        ends.add(found == new)
        if SLOW and at % 3 == 0 or at > writes - EVERY:
            assert bench.call(4)[0] == 0 and bench.result() == new, where
            left = {path.name for path in (bench.subject / "work").iterdir() if path.name.startswith(".")}
            assert left <= {".hashes.json"}, where
    assert ends == {True, False}
