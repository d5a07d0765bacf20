"""Fleets on a disk that is full but for so many kB: `python -m tests.tools.fleet_disk --jobs 1 2`. Needs root, to mount one.

Whatever cannot be written there, no call may end in a traceback or leave half a file, nothing that was finished may be lost,
and once there is room the next call does the rest. What the rows say is printed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.made.fleet import Fleet, states

ROOM = 4 << 20  # bytes
LEFT = (0, 4, 8, 16, 24, 32, 48, 64, 96, 200)  # kB
FINISHED = "clips/c00000.mp4"


@contextmanager
def disk() -> Iterator[Path]:
    """A small disk of its own."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={ROOM}", "tmpfs", folder], check=True)
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "--lazy", folder], check=True)


def fill(place: Path, left: int) -> Path:
    """A file that leaves so many bytes."""
    space = os.statvfs(place)
    file = place / "fill"
    file.write_bytes(bytes(max(0, space.f_bavail * space.f_frsize - left)))
    return file


def rehearse(place: Path, left: int, jobs: int) -> list[str]:
    """What is wrong after a fleet met a disk with so many kB left."""
    (place / "room").mkdir()
    fleet = Fleet(place / "room", 3)
    fleet.done(FINISHED, "--jobs", "1")
    before = fleet.made()
    filled = fill(place, left << 10)
    out, err = fleet.fleet("--jobs", str(jobs), "--json").communicate(timeout=600)
    said = states(json.loads(out)) if out.strip() else {}  # nothing where it cannot even begin
    print(
        f"  {left:>4} kB left, --jobs {jobs}: {' '.join(said.values())}; {err.strip().splitlines()[-1].strip()}",
        flush=True,
    )
    filled.unlink()
    wrong = ["a traceback"] if "Traceback" in err else []
    wrong += [f"left: {file}" for file in fleet.folder.rglob(".*.[0-9a-f]*") if file.is_file()]
    last, _ = fleet.done("--jobs", str(jobs))
    wrong += [] if set(states(last).values()) <= {"done", "fresh"} else [f"the next call: {states(last)}"]
    wrong += [] if before.items() <= fleet.made().items() else ["something was lost"]
    return wrong + [f"made twice: {one}" for one in fleet.twice()]


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--left", type=int, nargs="*", default=LEFT, help="kB")
    args = parser.parse_args()
    wrong = []
    for jobs in args.jobs:
        for left in args.left:
            with disk() as place:
                wrong += rehearse(place, left, jobs)
    print(*wrong or ["no traceback, nothing lost, nothing left behind, and the next call did the rest"], sep="\n")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
