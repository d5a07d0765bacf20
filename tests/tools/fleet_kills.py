"""Fleets of stand-ins, hit by kill -9 at random moments: `python -m tests.tools.fleet_kills --times 50` prints what was found.

Hit is the fleet itself, Snakemake (where it is installed), a job, or a stage. After each call every finished result is
read again, byte by byte; in the end the results are those of a fleet left in peace, and no stage was made twice.
"""

from __future__ import annotations

import argparse
import fcntl
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from tests.made.fleet import Fleet

FINDINGS = ("corrupt", "lost", "other bytes", "made twice", "not finished", "traceback")
LONGEST = 900.0  # s for one call, on a machine with much else to do
ARGS = ("--set", "one.delay=0.2", "--set", "three.delay=0.6")
NAMES = (("hugs_cli.fleet.job", "a job"), ("snakemake", "Snakemake"), ("child.py", "a stage"), ("fleet", "the fleet"))


def harass(fleet: Fleet, times: int, jobs: int, rng: np.random.Generator) -> Counter:
    """Kill `times` times, each call of the fleet once at most; counts of what was found."""
    found: Counter = Counter()
    args = (*ARGS, "--jobs", str(jobs))
    began = time.monotonic()
    fleet.done(*args)
    length, truth = time.monotonic() - began, fleet.made()
    while found["killed"] < times:
        shutil.rmtree(fleet.work)
        kept: dict[str, str] = {}
        ended = False
        while not ended:
            calm = found["killed"] >= times
            process = fleet.fleet(*args)
            if not calm:
                hit = strike(process, length * rng.random(), rng, found)
                length *= 1.02 if hit else 0.9
            _, said = process.communicate(timeout=LONGEST)
            settle(fleet)
            found["traceback"] += "Traceback" in said
            try:
                now = fleet.made()
            except AssertionError as error:
                print(error, file=sys.stderr)
                found["corrupt"] += 1
                return found
            found["lost"] += sum(now.get(name) != content for name, content in kept.items())
            kept, ended = now, process.returncode == 0
            found["not finished"] += calm and not ended
            if calm and not ended:
                print(said, file=sys.stderr)
                return found
            if ended:
                found["finished"] += 1
                found["other bytes"] += now != truth
                found["made twice"] += len(fleet.twice())
    return found


def strike(process: subprocess.Popen, after: float, rng: np.random.Generator, found: Counter) -> bool:
    """kill -9 to a fleet, or to a process that it started, after some seconds; True, and counted, if it was still there."""
    try:
        process.wait(after)
        return False
    except subprocess.TimeoutExpired:
        pass
    family = [process.pid, *(pid for pid in below(process.pid) if what(pid))]
    target = family[int(rng.integers(len(family)))]
    kind = "the fleet" if target == process.pid else what(target)
    try:
        os.kill(target, signal.SIGKILL)
    except ProcessLookupError:
        return False
    found["killed"] += 1
    found[f"  of these {kind}"] += 1
    return True


def below(pid: int) -> list[int]:
    """All processes that a process started, and those that they started."""
    try:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        own = [int(child) for task in tasks for child in (task / "children").read_text().split()]
    except OSError:
        return []
    return [one for child in own for one in (child, *below(child))]


def what(pid: int) -> str:
    """What a process of a fleet is; '' for a shell between two of them."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return ""
    if not Path(words[0]).name.startswith("python"):
        return ""
    return next((name for word, name in NAMES if any(word in one for one in words)), "")


def settle(fleet: Fleet) -> None:
    """Wait until nobody works on a clip any more: stages that outlive their job hold the clip's lock."""
    end = time.monotonic() + LONGEST
    for lock in fleet.work.glob("*/.lock"):
        with open(lock) as file:
            while time.monotonic() < end:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    time.sleep(0.05)


def run(times: int, seed: int, folder: Path) -> Counter:
    """Harass fleets of a few clips."""
    jobs = 2 if importlib.util.find_spec("snakemake") else 1
    return harass(Fleet(folder, 4), times, jobs, np.random.default_rng(seed))


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = run(args.times, args.seed, Path(folder))
    print(*(f"  {what:<28}{found[what]:>5}" for what in sorted({*found, *FINDINGS})), sep="\n")
    return int(any(found[what] for what in FINDINGS))


if __name__ == "__main__":
    sys.exit(main())
