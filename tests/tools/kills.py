"""Runs of the real engine, killed at random moments: `python -m tests.tools.kills --times 200` prints what was found.

Two pipelines: stand-in stages of a fraction of a second, and a real training that goes on from its checkpoints. After
each kill every finished result is read again, byte by byte; in the end the results are those of a run left in peace.
"""

from __future__ import annotations

import argparse
import json
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

from hugs_cli.cache.fingerprint import file_digest, files_under
from hugs_cli.cache.workspace import OLD, OURS, PART, Stamp
from tests.made import tiny
from tests.made.flow import Flow

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
FINDINGS = ("corrupt", "lost", "other bytes", "not said", "traceback")
TRAINED = 16  # one of so many kills hits a training, which takes longer than all stand-ins
LONGEST = 600.0  # s for one run, on a machine with much else to do
COMPARED = (".txt", ".npz", ".ply", ".png")  # the others tell times

COPY = '''
"""A stage that takes what the clip's folder has for it."""
import shutil
from stages.contract import Params

def run(job, params, *, video):
    """Copy one folder."""
    shutil.copytree(video / "{name}", job.out, dirs_exist_ok=True)
'''
TRAIN = '''
"""The real training, with a checkpoint four times a second."""
from stages import train
from stages.train import Params

RESUMES = True

def run(job, params, *, sfm, smpl, survey):
    """Train."""
    train.CHECKPOINT_SECONDS = 0.25
    train.run(job, params, sfm=sfm, smpl=smpl, survey=survey)
'''
SMALL = {"steps": 24, "human_points": 7_000, "human_cap": 7000, "scene_cap": 500, "scene_fill": 20, "channels": 4, "resolution": 8,
         "views_per_decode": 2, "curve_points": 1}  # fmt: skip


class StandIns(Flow):
    """Four stages; the third goes on where it was cut short."""

    args = ("--set", "two.delay=0.2", "--set", "three.delay=0.6")
    peace: tuple[tuple[str, ...], ...] = ((),)

    @property
    def name(self) -> str:
        """The clip's folder in the work folder."""
        return "clip"


class Training(Flow):
    """A tiny clip's folder in place of the video, and the real training on it."""

    args = ()
    peace = ((), ("--force",))  # the first run may have kernels to compile

    def __init__(self, folder: Path):
        super().__init__(folder)
        self.video.unlink()
        tiny.make(self.video)
        for name in ("sfm", "smpl", "survey"):
            self.write(name, COPY.format(name=name))
        self.write("train", TRAIN)
        stages = {name: {"needs": ["video"], "module": f"flow.{name}"} for name in ("sfm", "smpl", "survey")}
        stages["train"] = {"needs": ["sfm", "smpl", "survey"], "module": "flow.train", "params": SMALL}
        (folder / "pipelines.yaml").write_text(json.dumps({"default": {"doc": "Train.", "stages": stages}}))

    @property
    def name(self) -> str:
        """The clip's folder in the work folder."""
        return "clip.mp4"

    @property
    def store(self) -> Path:
        """The folder of results."""
        return self.work / self.name / "store"


def harass(flow: StandIns | Training, times: int, rng: np.random.Generator) -> Counter:
    """Kill runs `times` times, each at a random moment, and let every fourth one end; counts of what was found."""
    found = Counter()
    length, truth = in_peace(flow)
    while sum(found[f"killed {number.name}"] for number in SIGNALS) < times:
        shutil.rmtree(flow.work / flow.name)
        kept, cut, ended = {}, set(), False
        while not ended:
            calm = sum(found[f"killed {number.name}"] for number in SIGNALS) >= times or rng.random() < 0.25
            process = flow.start(*flow.args)
            if not calm:
                hit = strike(process, length * rng.random(), rng, found)
                length *= 1.03 if hit else 0.8  # a machine with much else to do is not always as slow
            _, said = process.communicate(timeout=LONGEST)
            ended = process.returncode == 0
            early = "KeyboardInterrupt" in said and "hugs_cli" not in said  # Ctrl-C while Python itself begins
            if "Traceback" in said and not early:
                found["traceback"] += 1
                print(said, file=sys.stderr)
            examine(flow, kept, found)
            if ended:
                found["finished"] += 1
                found["other bytes"] += bytes_of(flow) != truth
                found["not said"] += sum(f"  {stage} " not in told(said) for stage in cut)
            elif process.returncode == 130:
                found["not said"] += "stopped" not in said
            cut = {path.name.rpartition("-")[0] for path in flow.store.glob(f"*{PART}") if any(path.iterdir())}
    return found


def in_peace(flow: StandIns | Training) -> tuple[float, dict[str, str]]:
    """How long a whole run takes and what it leaves."""
    for more in flow.peace:
        began = time.monotonic()
        process = flow.start(*flow.args, *more)
        _, said = process.communicate(timeout=LONGEST)
        if process.returncode:
            raise RuntimeError(said)
    return time.monotonic() - began, bytes_of(flow)


def strike(process: subprocess.Popen, after: float, rng: np.random.Generator, found: Counter) -> bool:
    """Send a signal to a run, or to the stage that it runs, after some seconds; True, and counted, if it was still there."""
    try:
        process.wait(after)
        return False
    except subprocess.TimeoutExpired:
        pass
    number = SIGNALS[int(rng.integers(len(SIGNALS)))]
    stages = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    target = int(stages[0]) if stages and rng.random() < 0.25 else process.pid
    try:
        os.kill(target, number)
    except ProcessLookupError:
        return False
    found[f"killed {number.name}"] += 1
    found["of these, the stage alone"] += target != process.pid
    return True


def examine(flow: StandIns | Training, kept: dict[str, str], found: Counter) -> None:
    """Count results that are not whole, and results of `kept` (folder -> content) that are gone or changed."""
    now = {}
    for folder in flow.store.glob("*") if flow.store.is_dir() else ():
        if folder.suffix in (PART, OLD):
            continue
        stamp = Stamp.read(folder)
        facts = {} if stamp is None else {name: one["sha256"] for name, one in stamp.files.items()}
        there = {name: file_digest(path) for name, path in files_under(folder).items() if name not in OURS}
        found["corrupt"] += stamp is None or there != facts
        now[folder.name] = stamp.content if stamp else ""
    found["lost"] += sum(now.get(name) != content for name, content in kept.items())
    kept.update(now)
    root = flow.work / flow.name
    found["corrupt"] += sum(not link.exists() for link in root.glob("default/*") if not link.name.startswith("."))
    for file in (root / "runs.jsonl", root / "sources.json"):
        lines = file.read_text().splitlines() if file.exists() else []
        try:
            list(map(json.loads, lines if file.suffix == ".jsonl" else ["\n".join(lines)] * bool(lines)))
        except ValueError:
            found["corrupt"] += 1


def told(said: str) -> str:
    """The rows of stages of which a run says that an earlier run of them was cut short."""
    return "\n".join(line for line in said.splitlines() if "cut short" in line)


def bytes_of(flow: StandIns | Training) -> dict[str, str]:
    """Digest of each file that the pipeline's links show, those that tell times left out."""
    return {
        f"{link.name}/{name}": file_digest(path)
        for link in sorted((flow.work / flow.name / "default").iterdir())
        for name, path in files_under(link.resolve()).items()
        if path.suffix in COMPARED and name not in OURS
    }


def run(times: int, trained: int, seed: int, folder: Path) -> dict[str, Counter]:
    """Harass both pipelines."""
    rng, found = np.random.default_rng(seed), {}
    for name, kind, count in (("stand-ins", StandIns, times - trained), ("training", Training, trained)):
        (folder / name).mkdir()
        found[name] = harass(kind(folder / name), count, rng)
        print(name, dict(found[name]), file=sys.stderr, flush=True)
    return found


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = run(args.times, -(-args.times // TRAINED), args.seed, Path(folder))
    for name, counts in found.items():
        print(name, *(f"  {what:<28}{counts[what]:>5}" for what in sorted({*counts, *FINDINGS})), sep="\n")
    return int(any(counts[what] for counts in found.values() for what in FINDINGS))


if __name__ == "__main__":
    sys.exit(main())
