"""Damaged files for every reader: `python -m tests.tools.fuzz --tries 10000 --seed 0` prints what became of them.

A reader may return a value or raise StageError. Anything else is a finding: another exception, a process that dies,
more than LONGEST seconds, more than GROWTH bytes of memory, a file written elsewhere than in the folder of results.
Each kind runs in a process of its own, so that a crash inside a library is seen too. `--show KIND:TRY` repeats one try.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import resource
import select
import shutil
import subprocess
import sys
import tempfile
import traceback
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.made.kinds import WHOLE, Kind
from tests.tools.mutations import mutated

CORPUS = "tests.made.corpus"  # loads every reader, which takes seconds
LONGEST = 10.0  # s for one file
START = 300.0  # s until the first one, on a machine with much else to do
GROWTH = 1 << 30  # bytes
OUTCOMES = ("refused", "read", "crashed", "hung")


@dataclass
class Tally:
    """What became of the tries of one kind, and each finding in words."""

    counts: Counter = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)


def damaged(kind: Kind, whole: Path, seed: int, number: int) -> bytes:
    """The bytes of one try."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.file.encode()), number])
    return mutated((whole / kind.file).read_bytes(), rng)


def fuzz(kind: Kind, whole: Path, seed: int, tries: int, kinds: str = CORPUS) -> Tally:
    """Run `tries` damaged files of one kind; a process that dies or hangs is replaced by another one that goes on.

    `kinds` is the module whose KINDS have it.
    """
    tally, number = Tally(), 0
    while number < tries:
        job = [kinds, kind.file, str(whole), str(seed), str(number), str(tries)]
        for outcome, text in results([sys.executable, "-m", "tests.tools.fuzz", "--work", *job]):
            tally.counts[outcome] += 1
            if outcome in ("crashed", "hung"):
                tally.findings.append(f"{kind.file}:{number} {outcome} {text}")
            number += 1
    return tally


def results(command: list[str]) -> Iterator[tuple[str, str]]:
    """(outcome, text) of each try as the process tells it, the last one of a process that dies or takes too long."""
    env = {**os.environ, "MALLOC_ARENA_MAX": "2", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=env) as process,
    ):
        rest, ready = b"", False
        while True:
            if not select.select([process.stdout], [], [], LONGEST if ready else START)[0]:
                process.kill()
                yield "hung", f"for {LONGEST:.0f} s"
                return
            data = os.read(process.stdout.fileno(), 65536)
            if not data:
                break
            *lines, rest = (rest + data).split(b"\n")
            ready |= bool(lines)
            yield from (json.loads(line) for line in lines if line != b"ready")
        if process.wait():
            errors.seek(0)
            said = errors.read().decode(errors="replace").strip()
            if not ready:
                raise RuntimeError(f"it does not begin: {said}")
            yield "crashed", f"exit code {process.returncode} {said[-200:]}"


def work(kind: Kind, whole: Path, seed: int, first: int, tries: int) -> None:
    """The process of one kind: damage, read, tell."""
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch) / "a" / "b" / "c"  # so that ../../ stays in scratch
        shutil.copytree(whole, root)
        outcome, text = attempt(kind, root)
        if outcome != "read":
            raise SystemExit(f"whole file {outcome}: {text}")
        before = set(Path(scratch).rglob("*"))
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + GROWTH, used + GROWTH))
        print("ready", flush=True)
        for number in range(first, tries):
            (root / kind.file).write_bytes(damaged(kind, whole, seed, number))
            outcome, text = attempt(kind, root)
            if new := set(Path(scratch).rglob("*")) - before:
                outcome, text = "crashed", f"wrote {sorted(new)[0]}"
                before |= new
            print(json.dumps([outcome, text]), flush=True)


def attempt(kind: Kind, root: Path, shown: bool = False) -> tuple[str, str]:
    """What one file comes to: (outcome, words), its results removed again."""
    from stages.contract import StageError

    (root / "out").mkdir()
    try:
        kind.read(root)
        return "read", ""
    except StageError as error:
        if shown:
            print(error.problem, *error.facts, error.hint, sep="\n")
        return "refused", error.problem
    except Exception as error:
        if shown:
            traceback.print_exc()
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/tests/" not in frame.filename]
        place = [frame for frame in frames if "/stages/" in frame.filename or "/hugs_cli/" in frame.filename][-1:]
        where = f"{Path(place[0].filename).name}:{place[0].lineno}" if place else ""
        return "crashed", f"{type(error).__name__}: {str(error)[:100]} at {where}"
    finally:
        shutil.rmtree(root / "out")


def table(tallies: dict[str, Tally]) -> str:
    """A line a kind, a line for all."""
    rows = [f"{'kind':<56}{'tries':>7}" + "".join(f"{name:>9}" for name in OUTCOMES)]
    total = Counter()
    for name, tally in tallies.items():
        rows.append(row(name, tally.counts))
        total += tally.counts
    return "\n".join([*rows, row("all", total)])


def row(name: str, counts: Counter) -> str:
    """One line of the table."""
    return f"{name:<56}{sum(counts.values()):>7}" + "".join(f"{counts[outcome]:>9}" for outcome in OUTCOMES)


def run(tries: int, seed: int, kinds: list[Kind], folder: Path) -> dict[str, Tally]:
    """Spread `tries` evenly over the kinds."""
    whole = folder / WHOLE if (folder / WHOLE).is_dir() else importlib.import_module(CORPUS).make(folder)
    share = -(-tries // len(kinds))
    return {kind.file: fuzz(kind, whole, seed, share) for kind in kinds}


def show(text: str, seed: int, folder: Path) -> None:
    """Repeat one try of a finding, with its traceback."""
    name, _, number = text.rpartition(":")
    (kind,) = (kind for kind in importlib.import_module(CORPUS).KINDS if kind.file == name)
    whole = importlib.import_module(CORPUS).make(folder)
    (folder / "damaged").write_bytes(damaged(kind, whole, seed, int(number)))
    shutil.copyfile(folder / "damaged", whole / name)
    print(attempt(kind, whole, shown=True))


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", help="kinds; all if none")
    parser.add_argument("--show", metavar="KIND:TRY")
    parser.add_argument("--corpus", type=Path, help="folder that keeps the corpus")
    parser.add_argument("--work", nargs=6, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        module, name, whole, *numbers = args.work
        kinds = importlib.import_module(module).KINDS
        work(next(kind for kind in kinds if kind.file == name), Path(whole), *map(int, numbers))
        return 0
    every = importlib.import_module(CORPUS).KINDS
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.corpus or Path(temporary)
        if args.show:
            show(args.show, args.seed, folder)
            return 0
        kinds = [kind for kind in every if not args.only or kind.file in args.only]
        tallies = run(args.tries, args.seed, kinds, folder)
    findings = [finding for tally in tallies.values() for finding in tally.findings]
    print("\n".join([*findings, "", table(tallies)]))
    return int(bool(findings))


if __name__ == "__main__":
    sys.exit(main())
