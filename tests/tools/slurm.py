"""A real Slurm with one node, this machine: `python -m tests.tools.slurm` runs a fleet of small clips on it, end to end.

`python -m tests.tools.slurm COMMAND ...` runs a command while it is up. Needs Debian's slurm-wlm and munge, root, and
Snakemake with snakemake-executor-plugin-slurm. It writes /etc/slurm/slurm.conf (Slurm looks nowhere else in jobs) and a key
for munge, where there are none, and ends the three daemons when the command has ended.
"""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.made.fleet import Fleet, states
from tests.made.studies import add_tiny

CONFIG, KEY = Path("/etc/slurm/slurm.conf"), Path("/etc/munge/munge.key")
OURS = "# written by tests.tools.slurm"
SETTINGS = """{ours}
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
StateSaveLocation={room}/state
SlurmdSpoolDir={room}/spool
SlurmctldPidFile={room}/slurmctld.pid
SlurmdPidFile={room}/slurmd.pid
SlurmctldLogFile={room}/slurmctld.log
SlurmdLogFile={room}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=sched_interval=1,batch_sched_delay=0
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
ReturnToService=2
KillWait=10
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={memory} State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""
NEEDED = ("slurmctld", "slurmd", "sbatch", "sinfo", "munged")


def missing() -> str:
    """Why Slurm cannot be started here; '' if it can."""
    if lacking := [program for program in NEEDED if shutil.which(program) is None]:
        return f"not installed: {', '.join(lacking)} (apt-get install slurm-wlm munge)"
    if not all(importlib.util.find_spec(name) for name in ("snakemake", "snakemake_executor_plugin_slurm")):
        return "not installed: Snakemake and its Slurm plugin (pip install snakemake-executor-plugin-slurm)"
    if os.geteuid() != 0:
        return "only root may start it"
    if CONFIG.exists() and OURS not in CONFIG.read_text():
        return f"{CONFIG} is somebody else's"
    return ""


@contextmanager
def slurm(room: Path) -> Iterator[None]:
    """Slurm, up and idle; its logs and state lie in `room`."""
    for folder in (room / "state", room / "spool", CONFIG.parent):
        folder.mkdir(parents=True, exist_ok=True)
    memory = int(Path("/proc/meminfo").read_text().split()[1]) // 1024
    host = platform.node()
    CONFIG.write_text(SETTINGS.format(ours=OURS, host=host, room=room, cpus=os.cpu_count(), memory=memory))
    daemons: list[subprocess.Popen[bytes]] = []
    try:
        if not munge_answers():
            if not KEY.exists():
                KEY.write_bytes(os.urandom(1024))
                KEY.chmod(0o400)
                shutil.chown(KEY, "munge", "munge")
            Path("/run/munge").mkdir(exist_ok=True)
            shutil.chown("/run/munge", "munge", "munge")
            become = ["setpriv", "--reuid=munge", "--regid=munge", "--clear-groups"]
            daemons.append(subprocess.Popen([*become, "munged", "--foreground", "--force"], stderr=subprocess.DEVNULL))
            until(munge_answers)
        daemons.append(subprocess.Popen(["slurmctld", "-D", "-c"], stderr=subprocess.DEVNULL))
        until(lambda: answers("scontrol", "ping"))
        daemons.append(subprocess.Popen(["slurmd", "-D"], stderr=subprocess.DEVNULL))
        until(lambda: "idle" in said("sinfo", "-h", "-o", "%t"))
        yield
    finally:
        for daemon in reversed(daemons):
            daemon.terminate()
            daemon.wait(120)
        CONFIG.unlink()


def munge_answers() -> bool:
    """Whether munge signs."""
    return answers("munge", "-n")


def answers(*command: str) -> bool:
    """Whether a command ends well."""
    return subprocess.run(command, capture_output=True, timeout=120).returncode == 0


def said(*command: str) -> str:
    """What a command prints."""
    return subprocess.run(command, capture_output=True, text=True, timeout=120).stdout


def until(so: Callable[[], object], seconds: float = 300.0) -> None:
    """Wait until something is so; TimeoutError if it does not come to be."""
    end = time.monotonic() + seconds
    while not so():
        if time.monotonic() > end:
            raise TimeoutError("Slurm does not come up; its logs say why")
        time.sleep(0.2)


PROFILE = """
executor: slurm
scheduler: greedy
jobs: 10
latency-wait: 20
slurm-no-account: true
slurm-status-command: squeue
slurm-init-seconds-before-status-checks: 3
seconds-between-status-checks: 2
set-threads: {clip: 1, before: 1, train: 1}
"""


def rehearse(folder: Path) -> None:
    """A fleet on Slurm, each clip in two jobs: one clip is broken, one job is killed as if its machine was gone. What is
    left is done, nothing is made twice, and a second call has nothing to do."""
    fleet = add_tiny(Fleet(folder, 3))
    fleet.add("c00003", "broken error")
    (folder / "profile").mkdir()
    (folder / "profile" / "config.yaml").write_text(PROFILE)
    args = ("--profile", "./profile", "--split", "train", "--pipeline", "tiny")
    process = fleet.fleet(*args, "--set", "one.delay=4", "--json")
    reports = folder / "work/.fleet/fleet"
    until(lambda: any(read(file).get("state") == "running" for file in reports.glob("*/rows/c00000.*.json")))
    jobs = said("squeue", "-h", "-o", "%i %k", "--states=RUNNING").splitlines()
    (victim,) = [line.split()[0] for line in jobs if "c00000" in line]
    subprocess.run(["scancel", "--signal=KILL", "--full", victim], check=True)
    out, err = process.communicate(timeout=600)
    found = json.loads(out)
    expected = {"c00000": "done", "c00001": "done", "c00002": "done", "c00003": "failed"}
    assert states(found) == expected and process.returncode == 1, (found, err)
    assert len(fleet.made()) == 9 and not fleet.twice()
    assert not said("squeue", "-h"), "jobs are left in the queue"
    found, _ = fleet.done(*args, code=1)
    assert found["totals"]["states"] == {"fresh": 3, "failed": 1}


def read(file: Path) -> dict[str, object]:
    """A report; empty while it is not there."""
    return json.loads(file.read_text()) if file.exists() else {}


def main() -> int:
    """The command."""
    if why := missing():
        sys.exit(why)
    with tempfile.TemporaryDirectory() as folder, slurm(Path(folder) / "slurm"):
        if sys.argv[1:]:
            return subprocess.run(sys.argv[1:]).returncode
        (Path(folder) / "fleet").mkdir()
        rehearse(Path(folder) / "fleet")
        print("a fleet ran on Slurm, one job was killed, one clip was broken, and nothing was lost")
    return 0


if __name__ == "__main__":
    sys.exit(main())
