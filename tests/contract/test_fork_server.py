"""Stages as forks of processes that have loaded ahead: what they share and what they do not, who dies with whom."""

import ast
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from functools import partial
from itertools import chain, repeat
from pathlib import Path

import pytest
from toy_runs import REPOSITORY, limn, limn_process, make_subject, wait_for

from shared.contract import fork_client
from shared.contract.confine import trust
from shared.contract.fork_server import Served, do_at_low_priority, first_imports

STAGE = '''
"""A stage that tells of its process, and does what the environment says."""
from __future__ import annotations

import os
from pathlib import Path

from shared.contract import Job, Output, Stage, main

STAGE = Stage(name="NAME", version=1, help="Tells.", inputs=INPUTS, outputs=(Output("done.txt", "a word"),))


def run(job: Job) -> None:
    """Its parent's command line, then what it is told to do."""
    from hand.NAME_library import STATE

    word = os.environ.get("TOY_DO", "") if job.subject.name == "anna" else ""
    told = Path(os.environ["TOY_TOLD"]) / f"{job.subject.name}-{STAGE.name}"
    told.with_suffix(".new").write_text(f"{os.getpid()} {os.getppid()} {STATE['runs']}")
    told.with_suffix(".new").rename(told)
    STATE["runs"] += 1
    if word == "sleep":
        import time
        time.sleep(300)
    elif word.startswith("signal"):
        os.kill(os.getpid(), int(word.split()[1]))
    elif word.startswith("hoard"):
        b"x" * (int(word.split()[1]) << 20)
    (job.out / "done.txt").write_text("done")


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run))
'''
LIBRARY = "STATE = {'runs': 0}\n"
HOARD_MB = 200


@pytest.fixture
def pipeline(tmp_path):
    folder = tmp_path / "hand"
    folder.mkdir()
    (folder / "__init__.py").touch()
    for name, inputs in (("first", ()), ("second", ("first",))):
        (folder / f"{name}.py").write_text(STAGE.replace("NAME", name).replace("INPUTS", repr(inputs)))
        (folder / f"{name}_library.py").write_text(LIBRARY)
    stages = "  first: {needs: []}\n  second: {needs: [first]}\n"
    (tmp_path / "pipeline.yaml").write_text(f"package: hand\nstages:\n{stages}")
    trust([tmp_path])
    (tmp_path / "told").mkdir()
    return tmp_path / "pipeline.yaml"


@pytest.fixture
def anna(tmp_path):
    return make_subject(tmp_path / "anna")


@pytest.fixture
def environment(tmp_path):
    return {"TOY_TOLD": str(tmp_path / "told")}


def run(pipeline, *subjects, **environment):
    """limn run -> (exit code, output)."""
    return limn("run", *subjects, "--pipeline", pipeline, "--trust", pipeline.parent, "--cores", "2", **environment)


def told(pipeline, name):
    """[process, parent, how often the library was used before in this process] of a stage; None before it ran."""
    path = pipeline.parent / "told" / name
    return [int(number) for number in path.read_text().split()] if path.is_file() else None


def words_of(pid):
    return Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")


def is_alive(pid):
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


def provenance(subject, stage):
    return json.loads((subject / "work" / stage / "provenance.json").read_text())


def log_of(subject):
    return (subject / "work" / "workflow.log").read_text()


def test_stages_of_several_subjects_are_forks_of_one_process_and_share_nothing(pipeline, anna, tmp_path, environment):
    otto = make_subject(tmp_path / "otto")
    code, output = run(pipeline, anna, otto, **environment)
    assert code == 0, output
    for stage in ("first", "second"):
        (own, server, before), (other, same_server, other_before) = (
            told(pipeline, f"{name}-{stage}") for name in ("anna", "otto"))
        assert own != other and server == same_server and before == other_before == 0
    assert "alone" not in log_of(anna) and "ahead" not in log_of(anna)


def test_a_record_names_what_the_stage_itself_loaded(pipeline, anna, tmp_path, environment):
    assert run(pipeline, anna, **environment)[0] == 0
    by_hand = [sys.executable, "-m", "hand.second", "--subject", anna, "--pipeline", pipeline, "--force",
               "--out", tmp_path / "out"]
    first = [str(word).replace("second", "first") for word in by_hand]
    search = os.pathsep.join([str(pipeline.parent), str(REPOSITORY)])
    for command in (first, by_hand):
        subprocess.run(command, env={**os.environ, **environment, "PYTHONPATH": search}, check=True,
                       capture_output=True)
    for stage in ("first", "second"):
        forked, alone = provenance(anna, stage), provenance(tmp_path / "out" / "anna", stage)
        assert {key: forked[key] for key in ("code", "sources")} == {key: alone[key] for key in ("code", "sources")}
        assert set(forked["packages"]) <= set(alone["packages"])
        assert forked["command"][1].endswith(f"hand/{stage}.py") and "--events" in forked["command"]


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGKILL, signal.SIGTERM])
def test_a_stage_that_dies_takes_nothing_with_it(pipeline, anna, tmp_path, environment, number):
    otto = make_subject(tmp_path / "otto")
    code, output = run(pipeline, anna, otto, TOY_DO=f"signal {int(number)}", **environment)
    assert code == 1 and "otto: done" in output and "anna: not done" not in output.partition("otto: done")[0]
    assert (otto / "work" / "second" / "done.txt").is_file() and not (anna / "work" / "first").exists()
    assert told(pipeline, "otto-first")[1] == told(pipeline, "anna-first")[1]
    assert run(pipeline, anna, **environment)[0] == 0


@pytest.mark.parametrize("victim", ["limn", "server", "client", "engine"])
def test_a_stage_dies_with_those_above_it(pipeline, anna, environment, victim):
    process = limn_process("run", anna, "--pipeline", pipeline, "--trust", pipeline.parent, TOY_DO="sleep",
                           **environment)
    stage, server, _ = wait_for(lambda: told(pipeline, "anna-first"))
    family = {pid: " ".join(words_of(pid)) for pid in processes_below(process.pid)}
    clients = [pid for pid, words in family.items() if words.split()[1:3] == ["-I", "-S"]]
    engines = [pid for pid, words in family.items() if "snakemake_process" in words]
    assert Path(f"/proc/{stage}/comm").read_text() == "first\n"
    assert "fork_server" in family[server] and stage in family and len(clients) == len(engines) == 1
    os.kill({"limn": process.pid, "server": server, "client": clients[0], "engine": engines[0]}[victim], signal.SIGKILL)
    output, _ = process.communicate(timeout=120)
    wait_for(lambda: not any(map(is_alive, family)))
    if victim != "limn":
        assert process.returncode == 1 and "first was killed without a message" in output
    assert run(pipeline, anna, **environment)[0] == 0


def processes_below(pid):
    """All processes that a process started, and those that these did."""
    children = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        children.setdefault(parent, []).append(int(path.parent.name))
    found = list(children.get(pid, ()))
    for child in found:
        found += children.get(child, ())
    return found


def test_a_request_to_end_reaches_the_stage(pipeline, anna, environment):
    process = limn_process("run", anna, "--pipeline", pipeline, "--trust", pipeline.parent, TOY_DO="sleep",
                           **environment)
    wait_for(lambda: told(pipeline, "anna-first"))
    client = next(pid for pid in processes_below(process.pid) if words_of(pid)[1:3] == ["-I", "-S"])
    os.kill(client, signal.SIGTERM)
    process.communicate(timeout=120)
    assert process.returncode == 1
    assert not list((anna / "work").glob("first*"))  # it cleared up; of one that is killed the log is kept


def test_peak_memory_is_that_of_the_stage(pipeline, anna, tmp_path, environment):
    """Neither what its server held and gave back nor what another stage took."""
    library = pipeline.parent / "hand" / "first_library.py"
    library.write_text(LIBRARY + f"b'x' * ({HOARD_MB} << 20)\n")
    assert run(pipeline, anna, **environment)[0] == 0
    assert "alone" not in log_of(anna)
    slim = provenance(anna, "first")["peak_memory_mb"]
    assert 5 < slim < HOARD_MB
    library.write_text(LIBRARY + f"HELD = b'x' * ({HOARD_MB} << 20)\n")
    assert run(pipeline, anna, "--renew", **environment)[0] == 0
    assert provenance(anna, "first")["peak_memory_mb"] > HOARD_MB
    assert provenance(anna, "second")["peak_memory_mb"] < HOARD_MB
    library.write_text(LIBRARY)
    out = tmp_path / "out"
    assert run(pipeline, anna, "--out", out, TOY_DO=f"hoard {HOARD_MB}", **environment)[0] == 0
    assert provenance(out / "anna", "first")["peak_memory_mb"] > HOARD_MB


@pytest.mark.parametrize("library, reason", [
    ("import threading, time\nthreading.Thread(target=time.sleep, args=(9,), daemon=True).start()\n",
     "started threads"),
    ("import os\nif os.environ.get('LIMN_ATTEMPT') is None: raise ImportError('not here')\n", "not here"),
])
def test_what_cannot_be_loaded_ahead_starts_alone_and_says_so(pipeline, anna, environment, library, reason):
    (pipeline.parent / "hand" / "second_library.py").write_text(LIBRARY + library)
    code, output = run(pipeline, anna, **environment)
    assert code == 0, output
    log = log_of(anna)
    assert re.search(rf"^second: not loaded ahead: .*{reason}", log, re.M)
    assert re.search(r"^second: starts alone, nothing is loaded ahead: ", log, re.M)
    assert not re.search(r"^first: ", log, re.M)


def test_without_a_server_the_client_becomes_the_stage(pipeline, anna, tmp_path, environment):
    command = [sys.executable, "-I", "-S", fork_client.__file__, "nowhere", str(pipeline.parent), "hand", "first",
               "--subject", str(anna), "--pipeline", str(pipeline), "--threads", "1"]
    done = subprocess.run(command, env={**os.environ, **environment, "PYTHONPATH": str(REPOSITORY)}, text=True,
                          capture_output=True, cwd=tmp_path, check=False)
    assert done.returncode == 0
    assert "first: starts alone, nothing is loaded ahead: no fork server: No such file" in done.stderr
    assert (anna / "work" / "first" / "done.txt").is_file()


def test_only_imports_that_every_run_makes_are_made_ahead(tmp_path):
    path = tmp_path / "stage.py"
    path.write_text('from __future__ import annotations\nimport a\nfrom . import b\nif a:\n    import c\n'
                    'def other():\n    import d\n'
                    'def run(job):\n    """Does."""\n    import e\n    from f.g import h\n\n    job()\n    import i\n')
    assert [ast.unparse(node) for node in first_imports(path)] == ["import a", "import e", "from f.g import h"]


def test_what_is_not_loaded_yet_when_a_job_waits_is_loaded_at_full_priority(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_UNIX) as listener, socket.socket(socket.AF_UNIX) as client:
        listener.bind("stage")
        listener.listen()
        priorities = []
        first = [lambda: priorities.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id())),
                 lambda: client.connect("stage")]
        do_at_low_priority(chain(first, repeat(partial(time.sleep, 0.001))), listener)  # it comes back
        assert priorities[0] > os.getpriority(os.PRIO_PROCESS, 0)
        steps = iter(first)
        do_at_low_priority(steps, listener)
        assert list(steps) == first and len(priorities) == 1  # a job waits already


def test_a_served_stage_reads_its_own_text():
    assert Served.of(str(Served("first", 2, 20))) == Served("first", 2, 20)
