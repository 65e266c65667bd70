"""Submitting to schedulers other than Slurm: their units, their answers, their logs; against stand-ins for them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from shared.contract.folders import RunFolder
from shared.contract.pipeline import load_pipeline
from tools.cli import cluster
from tools.cli.cluster import command, keep_slurm_logs
from tools.cli.housekeeping import removable

ROOT = Path(__file__).resolve().parents[2]


def after(words, flag):
    """All words that follow a flag."""
    return [words[i + 1] for i, word in enumerate(words) if word == flag]


@pytest.mark.parametrize("scheduler, cores, memory_mb, wanted", [
    ("sge", 4, 3001, {"-pe": ["smp"], "smp": ["4"], "-l": ["h_vmem=751M", "h_rt=5400"], "-o": ["/here/x.log"]}),
    ("lsf", 2, 1500, {"-M": ["1500MB"], "-W": ["90"], "-R": ["span[hosts=1] rusage[mem=1500MB]"],
                      "-oo": ["/here/x.log"]}),
    ("pbs", 2, 1500, {"-l": ["select=1:ncpus=2:mem=1500mb", "walltime=5400"]})])
def test_each_scheduler_gets_its_units(scheduler, cores, memory_mb, wanted):
    """Grid Engine counts memory for each slot, PBS wants seconds and one chunk."""
    words = command(scheduler, cores, memory_mb, 90, "/here/x.log")
    assert {flag: after(words, flag) for flag in wanted} == wanted


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """stand_in(name, text): a command that notes its words and then does what the shell text says."""
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")

    def make(name, text):
        path = tmp_path / "bin" / name
        path.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > "{tmp_path}/{name}.words"\n{text}\n')
        path.chmod(0o755)

    return make


def call(*words):
    """The module as Snakemake calls it, by a python3 that knows nothing of the environment -> (code, out, err)."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-S", "-m", "tools.cli.cluster", *map(str, words)], env=environment,
                          text=True, capture_output=True, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("scheduler, name, answer, job", [
    ("sge", "qsub", "4711", "4711"), ("sge", "qsub", "note: be gentle\n4712.1-3:1", "4712"),
    ("lsf", "bsub", "Job <815> is submitted to queue <normal>.", "815"), ("pbs", "qsub", "99.master", "99.master")])
def test_submit_prints_the_id_alone(tmp_path, stand_in, scheduler, name, answer, job):
    stand_in(name, f"cat <<'X'\n{answer}\nX")
    (tmp_path / "results").mkdir()
    (tmp_path / "0").symlink_to(tmp_path / "results")
    code, out, err = call("submit", scheduler, "--threads", 2, "--mem-mb", 999, "--minutes", 7, "--log",
                          tmp_path / "0" / "a.cluster.log", "--option=-q", "--option=long.q", "job.sh")
    assert (code, out, err) == (0, f"{job}\n", "")
    words = (tmp_path / f"{name}.words").read_text().splitlines()
    assert words[-3:] == ["-q", "long.q", "job.sh"] and str(tmp_path / "results" / "a.cluster.log") in words


def test_a_refusal_is_told(stand_in):
    stand_in("bsub", "echo 'no such queue' >&2; exit 255")
    words = ("submit", "lsf", "--threads", 1, "--mem-mb", 9, "--minutes", 7, "--log", "x.log", "job.sh")
    code, out, err = call(*words)
    assert code == 1 and not out and "no such queue" in err
    stand_in("bsub", "echo maybe later")
    code, out, err = call(*words)
    assert code == 1 and not out and "no job id" in err


@pytest.mark.parametrize("scheduler, answers, status", [
    ("sge", {"qstat": "echo job_number 1"}, "running"),
    ("sge", {"qstat": "exit 1", "qacct": "echo 'failed       0'; echo 'exit_status  0'"}, "success"),
    ("sge", {"qstat": "exit 1", "qacct": "echo 'failed       100 : assumedly after job'; echo 'exit_status  137'"},
     "failed"),
    ("lsf", {"bjobs": "echo PEND"}, "running"), ("lsf", {"bjobs": "echo DONE"}, "success"),
    ("lsf", {"bjobs": "echo EXIT"}, "failed"), ("lsf", {"bjobs": "exit 255", "bhist": "echo gone"}, "failed"),
    ("lsf", {"bjobs": "exit 255", "bhist": "echo 'Done successfully. The CPU time'"}, "success"),
    ("pbs", {"qstat": "echo '    job_state = R'"}, "running"), ("pbs", {"qstat": "exit 35"}, "failed"),
    ("pbs", {"qstat": "echo '    job_state = F'; echo '    Exit_status = 0'"}, "success"),
    ("pbs", {"qstat": "echo '    job_state = F'; echo '    Exit_status = 271'"}, "failed")])
def test_status_is_one_of_three_words(stand_in, scheduler, answers, status):
    for name, text in answers.items():
        stand_in(name, text)
    assert call("status", scheduler, "17") == (0, f"{status}\n", "")


def test_accounting_that_lags_is_waited_for(stand_in, tmp_path, monkeypatch):
    stand_in("qstat", "exit 1")
    stand_in("qacct", f"test -f {tmp_path}/later || {{ touch {tmp_path}/later; exit 1; }}\n"
                      "echo 'failed 0'; echo 'exit_status 0'")
    pauses = []
    monkeypatch.setattr(cluster.time, "sleep", pauses.append)
    assert cluster.sge_status("17") == "success" and len(pauses) == 1
    stand_in("qacct", "exit 1")
    assert cluster.sge_status("17") == "failed"


def test_profile_loses_no_log_and_states_no_units_of_its_own():
    text = (ROOT / "profiles" / "generic" / "config.yaml").read_text()
    profile = yaml.safe_load(text)
    submit = profile["cluster-generic-submit-cmd"]
    assert "/dev/null" not in text and "--log runs/{wildcards.run}/work/{rule}" + cluster.LOG_SUFFIX in submit
    assert set(re.findall(r"{([\w.]+)}", submit)) == {
        "threads", "resources.mem_mb", "resources.runtime", "wildcards.run", "rule"}
    assert profile["cluster-generic-status-cmd"].startswith("python3 -m tools.cli.cluster status")


def test_slurm_logs_stay_beside_their_stages_and_clean_removes_them(tmp_path):
    home, run = tmp_path / "scratch", RunFolder(tmp_path / "anna")
    run.work.mkdir(parents=True)
    (home / "runs").mkdir(parents=True)
    (home / "runs" / "0").symlink_to(run.root)
    for number, text in (("7", "first"), ("12", "slurmstepd: out of memory")):
        log = home / ".snakemake" / "slurm_logs" / "rule_init_albedo" / "0" / f"{number}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text(text)
        os.utime(log, (int(number), int(number)))
    keep_slurm_logs(home)
    kept = run.work / "init_albedo.cluster.log"
    assert kept.read_text() == "slurmstepd: out of memory" and kept in removable(run, load_pipeline())
    keep_slurm_logs(tmp_path / "nothing")
