"""Places the jobs of a fleet: one after another in a plain loop, or through Snakemake."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from hugs_cli.cache import child, whole
from hugs_cli.fleet.history import free_megabytes
from hugs_cli.fleet.job import LOGS, SNAKEMAKE_LOG, STOP
from hugs_cli.fleet.plan import AFTER, BEFORE, WHOLE, Planned
from hugs_cli.pipelines import UsageError
from stages.contract import StageError

ROOM = Path(__file__).parent
EXTRA = "pip install 'hugs-avatar[fleet]'"
TRIES = 2  # of a clip that ran out of memory
STEPS = {  # split? -> step, marker it needs, marker it makes
    False: ((WHOLE, None, "{row}.done"),),
    True: ((BEFORE, None, "{row}.before"), (AFTER, "{row}.before", "{row}.done")),
}
BUSY = 0.75  # of its threads, that a clip keeps busy: six clips, two at a time, took 0.75 of the time one after another
MINUTES = 720  # that a cluster gives a job at least


class Runner(Protocol):
    """What places jobs."""

    def going(self) -> bool:
        """Whether jobs are left; to be asked a few times a second."""
        ...

    def stop(self) -> None:
        """Start no more jobs, and let those that run stop. `going` says when they have."""
        ...

    def kill(self) -> None:
        """End all at once."""
        ...


@dataclass(frozen=True)
class Order:
    """What to place: the folder of the call, the rows to do, and how many at a time."""

    folder: Path
    todo: Sequence[Planned]
    split: bool
    side_by_side: int
    profile: str | None


def threads() -> int:
    """Threads of each stage on this machine: as many as `hugs run` takes, so that results have the same bytes."""
    told = os.environ.get("OMP_NUM_THREADS", "")
    return int(told) if told.isdigit() and int(told) else child.processors()


def slower(side_by_side: int) -> float:
    """How many times as long a clip takes beside others on this machine; 0: each has its own."""
    return max(1.0, BUSY * side_by_side * threads() / child.processors())


def side_by_side(asked: int | None, megabytes: Sequence[int]) -> tuple[int, str]:
    """How many clips run at a time on this machine, and why: at most `asked`, one a processor, and what memory holds.

    Stages keep about half of their threads busy, so clips are not given more than twice the threads there are.
    """
    cores = child.processors()
    bounds = {"the processors": cores if asked else max(1, min(cores, 2 * cores // threads()))}
    if asked:
        bounds["--jobs"] = asked
    if (free := free_megabytes()) and megabytes:
        bounds["memory"] = max(1, free // max(megabytes))
    why = min(bounds, key=lambda name: bounds[name])
    return bounds[why], why


def has_snakemake() -> bool:
    """Whether the extra is installed."""
    return importlib.util.find_spec("snakemake") is not None


class Loop:
    """One clip after another, each in a process of its own."""

    def __init__(self, order: Order, failed: Callable[[str], str]):
        """`failed(row)` says how a row failed: its kind."""
        self.order, self.failed = order, failed
        self.open = [(one.row.id, step, 1) for one in order.todo for step, _, _ in STEPS[order.split]]
        self.running: tuple[subprocess.Popen[bytes], str, str, int] | None = None
        self.stopped = False

    def going(self) -> bool:
        """Start the next job when one has ended; a second try where memory ran out."""
        if self.running:
            process, row, step, tries = self.running
            if process.poll() is None:
                return True
            self.running = None
            if process.returncode:
                again = tries < TRIES and (process.returncode < 0 or self.failed(row) == "memory")
                later = [one for one in self.open if one[0] != row]  # its other step needs this one
                self.open = [(row, step, tries + 1), *self.open] if again else later
        if self.open and not self.stopped:
            row, step, tries = self.open.pop(0)
            self.running = (self._start(row, step), row, step, tries)
        return self.running is not None

    def _start(self, row: str, step: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "hugs_cli.fleet.job", str(self.order.folder), row, step]
        with open(self.order.folder / LOGS / f"{row}.{step}.log", "ab") as log:
            return subprocess.Popen(
                [*command, str(threads())],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def stop(self) -> None:
        """The job sees the file."""
        self.stopped = True
        (self.order.folder / STOP).touch()

    def kill(self) -> None:
        """End the job; its stage ends with it."""
        self.stopped = True
        if self.running:
            self.running[0].kill()


class Snakemake:
    """Snakemake, with its working folder in the run's own: all files that it knows are markers there."""

    def __init__(self, order: Order):
        self.order = order
        local = order.profile is None
        most = free_megabytes() if local else 0
        jobs: dict[str, Any] = {
            "python": sys.executable,
            "run": str(order.folder),
            "local": local,
            "most": most,
            "megabytes": {one.row.id: one.megabytes for one in order.todo},
            "steps": STEPS[order.split],
            "threads": threads(),
            "minutes": max(MINUTES, round(max(one.seconds for one in order.todo) / 20)),
        }
        whole.replace(order.folder / "jobs.json", json.dumps(jobs))
        command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOM / "Snakefile"), "--directory",
                   str(order.folder), "--nolock", "--rerun-incomplete", "--drop-metadata", "--rerun-triggers", "mtime",
                   "--keep-going", "--profile", profile_folder(order.profile)]  # fmt: skip
        if local:
            slots = order.side_by_side * threads()  # a clip counts as its threads
            command += ["--cores", str(slots), *(["--resources", f"mem_mb={most}"] if most else [])]
        elif order.side_by_side:
            command += ["--jobs", str(order.side_by_side)]
        self.log = order.folder / SNAKEMAKE_LOG
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )

    def going(self) -> bool:
        """Whether Snakemake still runs."""
        return self.process.poll() is None

    def stop(self) -> None:
        """Jobs that run see the file; Snakemake starts no more, and takes those that wait in a cluster's queue out of it."""
        (self.order.folder / STOP).touch()
        with suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """End Snakemake and what it started here."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)

    def check(self) -> None:
        """StageError if Snakemake did not do its part: it was killed, or placed no job."""
        lines = [line for line in self.log.read_text(errors="replace").splitlines() if line.strip()][-6:]
        if self.process.returncode < 0:
            name = signal.Signals(-self.process.returncode).name
            raise StageError(f"Snakemake was killed by {name}", "call the fleet again: what is finished is kept", lines)
        if not any((self.order.folder / LOGS).iterdir()):
            hint = "correct the profile, or try one machine: leave out `--profile`"
            raise StageError("Snakemake placed no job", hint, lines)


def profile_folder(name: str | None) -> str:
    """A profile's folder, or its name if it is one of the user's; UsageError where there is none."""
    own = ROOM / "profiles" / (name or "machine")
    if name is None:
        return str(own)
    config = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "snakemake" / name
    for folder in (Path(name), config, Path("/etc/xdg/snakemake") / name, own):
        if folder.is_dir():
            return str(folder.absolute())
    facts = ["slurm is an example that comes with hugs"]
    hint = "give its folder, or the name of one in ~/.config/snakemake"
    raise UsageError(f"no Snakemake profile {name}", hint, facts)
