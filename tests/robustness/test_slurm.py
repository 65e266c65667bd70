"""The same workflow on a real Slurm, disturbed: a job cancelled, a node drained, jobs killed for memory."""

import importlib.util
import json
import os
import shutil
import time

import pytest
import slurm_cluster
from slurm_cluster import slurm
from toy_runs import REPOSITORY, copy_pipeline, limn_process, make_subject, outputs_of, tree

SUBJECTS = 6


def reason_to_skip():
    """Why the test cannot or should not run here."""
    if not os.environ.get("LIMN_SLOW_TESTS"):
        return "takes minutes: set LIMN_SLOW_TESTS=1"
    if importlib.util.find_spec("snakemake_executor_plugin_slurm") is None:
        return "the executor is not installed: pip install -r requirements-cluster.lock"
    return slurm_cluster.why_not()


pytestmark = pytest.mark.skipif(bool(reason_to_skip()), reason=reason_to_skip() or "-")


@pytest.fixture(scope="module")
def node(tmp_path_factory):
    """The name of the node of a running cluster."""
    with slurm_cluster.cluster(tmp_path_factory.mktemp("slurm")) as host:
        yield host


@pytest.fixture
def batch(tmp_path):
    """(pipeline, folder of subjects, profile): the committed profile with what this cluster differs in."""
    pipeline = copy_pipeline(tmp_path / "toy")
    requested = "{needs: [read_text], resources: {mem_mb: 300, runtime: 5}}"
    pipeline.write_text(pipeline.read_text().replace("{needs: [read_text]}", requested))
    for i in range(SUBJECTS):
        make_subject(tmp_path / "batch" / f"s{i}")
    shutil.copytree(REPOSITORY / "profiles" / "slurm", tmp_path / "profile")
    profile = tmp_path / "profile" / "config.yaml"
    profile.write_text(profile.read_text().replace("status-checks: 20", "status-checks: 3")
                       + "slurm-status-command: squeue  # there is no accounting database\n")
    return pipeline, tmp_path / "batch", tmp_path / "profile"


def start(batch, *settings):
    """limn run on the cluster."""
    pipeline, folder, profile = batch
    words = [word for setting in settings for word in ("--set", setting)]
    return limn_process("run", folder, "--pipeline", pipeline, "--profile", profile, "--threads", 1, *words)


def states():
    """{state: jobs} as squeue tells."""
    found = {}
    for line in slurm("squeue", "--noheader", "--states=all", "--format=%i %T").splitlines():
        job, state = line.split()
        found.setdefault(state, []).append(job)
    return found


def wait_for(condition, seconds=600):
    """What the condition gives once it is true."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited in vain: {states()}"
        time.sleep(0.2)
    return found


def test_cancelled_job_and_drained_node(node, batch):
    process = start(batch, "count_words.pause_s=5")
    stamp = batch[1] / "s0" / "work" / "read_text.stamp"
    wait_for(lambda: stamp.exists() and any((batch[1] / "s0" / "work").glob(".count_words.tmp-*")))
    victim = states()["RUNNING"][0]
    slurm("scancel", victim)
    slurm("scontrol", "update", f"nodename={node}", "state=drain", "reason=test")
    wait_for(lambda: "RUNNING" not in states() and "COMPLETING" not in states())
    assert "drain" in slurm("sinfo", "--noheader", "--format=%T")
    time.sleep(2)
    slurm("scontrol", "update", f"nodename={node}", "state=resume")
    output, _ = process.communicate(timeout=1200)
    assert victim in states()["CANCELLED"]
    assert process.returncode == 0, output
    assert f"{SUBJECTS} subjects: {SUBJECTS} done" in output
    results = [outputs_of(batch[1] / f"s{i}") for i in range(SUBJECTS)]
    assert len(results[0]) >= 6 and all(result == results[0] for result in results)
    assert not [name for name in tree(batch[1]) if ".tmp-" in name or ".workflow-" in name]


def test_job_killed_for_memory_gets_more(node, batch):
    before = len(states().get("OUT_OF_MEMORY", []) + states().get("FAILED", []) + states().get("CANCELLED", []))
    process = start(batch, "count_words.pause_s=4", "count_words.hoard_mb=600")
    output, _ = process.communicate(timeout=1200)
    assert process.returncode == 0, output
    assert f"{SUBJECTS} subjects: {SUBJECTS} done" in output
    killed = states().get("OUT_OF_MEMORY", []) + states().get("FAILED", []) + states().get("CANCELLED", [])
    assert len(killed) - before >= SUBJECTS


def test_job_that_never_fits_ends_in_one_table(node, batch):
    for i in range(2, SUBJECTS):
        shutil.rmtree(batch[1] / f"s{i}")
    (batch[1] / "s0" / "clip.txt").write_text("no face in here\n")
    process = start(batch, "count_words.pause_s=4", "count_words.hoard_mb=3000")
    output, _ = process.communicate(timeout=1200)
    assert process.returncode == 1 and "2 subjects: 1 input error, 1 killed" in output, output
    records = {record["subject"]: record for record in json.loads((batch[1] / "summary.json").read_text())["subjects"]}
    assert (records["s0"]["state"], records["s0"]["stage"]) == ("input error", "read_text")
    assert (records["s1"]["state"], records["s1"]["stage"]) == ("killed", "count_words")
    assert "out of memory" in records["s1"]["reason"]
    assert output.count("started") <= 6
