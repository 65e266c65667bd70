"""A real Slurm of one node on this machine, for a test: munge, slurmctld and slurmd, started and ended again.

Needs root and Debian's slurm-wlm and munge (apt-get install slurm-wlm munge). Jobs find the configuration at its usual
place only, so /etc/slurm/slurm.conf must be free; it is a link while the cluster runs.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

LINK = Path("/etc/slurm/slurm.conf")
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel", "scontrol", "srun")
CONTROL_PORT, NODE_PORT = 26817, 26818
CONFIGURATION = """\
ClusterName=limn
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.sock
SlurmctldPort={control_port}
SlurmdPort={node_port}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
AccountingStorageType=accounting_storage/none
MinJobAge=3600
MpiDefault=none
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory_mb} State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def why_not() -> str:
    """The reason why no Slurm can be started here; '' where it can."""
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if missing:
        return f"{', '.join(missing)} not installed (apt-get install slurm-wlm munge)"
    if os.geteuid() != 0:
        return "a Slurm of one's own needs root"
    if LINK.exists() or LINK.is_symlink():
        return f"{LINK} is there: this machine has a Slurm, which a test must not disturb"
    return ""


@contextlib.contextmanager
def cluster(folder: Path, cores: int = 2, memory_mb: int = 6000) -> Iterator[str]:
    """The running cluster; gives its node's name. RuntimeError with the logs where it does not start."""
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True)
    (folder / "munge.key").write_bytes(os.urandom(1024))
    (folder / "munge.key").chmod(0o400)
    host = socket.gethostname().split(".")[0]
    (folder / "slurm.conf").write_text(CONFIGURATION.format(
        host=host, folder=folder, control_port=CONTROL_PORT, node_port=NODE_PORT, cores=cores, memory_mb=memory_mb))
    LINK.parent.mkdir(exist_ok=True)
    LINK.symlink_to(folder / "slurm.conf")
    try:
        munge = [f"--{name}-file={folder}/munged.{name}" for name in ("pid", "log", "seed")]
        _start("munged", "--force", f"--key-file={folder}/munge.key", f"--socket={folder}/munge.sock", *munge)
        _start("slurmctld", "-c")
        _start("slurmd")
        _wait_for_node(folder)
        yield host
    finally:
        subprocess.run(["scancel", "--user=root", "--full"], capture_output=True, check=False, timeout=20)
        for name in ("slurmd", "slurmctld", "munged"):
            _stop(folder / f"{name}.pid")
        LINK.unlink()


def slurm(*command: str) -> str:
    """What a Slurm command prints."""
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout


def _start(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=30)
    if done.returncode != 0:
        raise RuntimeError(f"{command[0]} did not start: {done.stderr.strip()}")


def _wait_for_node(folder: Path) -> None:
    deadline = time.monotonic() + 30
    while "idle" not in slurm("sinfo", "--noheader", "--format=%T"):
        if time.monotonic() > deadline:
            logs = [(folder / name).read_text()[-500:] for name in ("slurmctld.log", "slurmd.log")]
            raise RuntimeError("the node does not come up:\n" + "\n".join(logs))
        time.sleep(0.3)


def _stop(pid_file: Path) -> None:
    with contextlib.suppress(FileNotFoundError, ProcessLookupError, ValueError):
        pid = int(pid_file.read_text())
        os.kill(pid, 15)
        deadline = time.monotonic() + 10
        while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        os.kill(pid, 9)
