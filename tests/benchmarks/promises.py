"""Are promises of time kept, also beside other work: `python -m tests.benchmarks.promises WORK kitchen.mp4=5m ... [--busy 0 1 2]`.

Each clip is run from nothing `--within` its time, beside so many processes that do nothing but compute. A promise is kept if the
run ends at most 10 % late, beside other work 20 %, or if it said before its first stage that it would be late. Results are
in WORK/busyN.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.benchmarks.host import tell
from tests.made.command import ROOT

QUIET, BUSY = 1.1, 1.2  # of the promised time, that a run may take


@contextmanager
def other_work(processes: int) -> Iterator[None]:
    """So many processes that compute all the time."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for one in others:
            one.kill()
            one.wait()


def run(clip: Path, time: str, work: Path, busy: int) -> dict[str, object]:
    """One run from nothing, and what became of its promise."""
    work.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(work / clip.stem, ignore_errors=True)
    command = [sys.executable, "-c", "from hugs_cli import main; main()", "run", clip, "--within", time]
    with other_work(busy):
        done = subprocess.run(
            [*map(str, command), "--work", str(work), "--json"], cwd=ROOT, capture_output=True, text=True
        )
    row: dict[str, object] = {"clip": clip.name, "within": time, "busy": busy}
    if done.returncode:
        return row | {"failed": (done.stdout + done.stderr).strip().splitlines()[-3:]}
    kept = json.loads(done.stdout)["within"]
    guess, promised, took = kept["guess"], kept["promised"], kept["took"]
    needed = guess["before"] + guess["from"]
    (place,) = (work / clip.stem).glob("default.*/evaluate/metrics.json")
    found = json.loads(place.read_text())["heldout"]
    dB = {region: means["psnr"] for region, means in found.items() if means["psnr"] is not None}
    late, told = took / promised, needed > promised
    row |= {"took": took, "late": round(late - 1, 3), "told": told, "guessed": round(needed, 1)}
    row |= {"steps": json.loads((place.parents[1] / "train" / "train.json").read_text())["steps"], "psnr": dB}
    return row | {"kept": bool(late <= (BUSY if busy else QUIET) or told)}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("clips", nargs="+", metavar="CLIP=TIME")
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    for busy in given.busy:
        for clip, _, time in (one.rpartition("=") for one in given.clips):
            rows.append(run(Path(clip).resolve(), time, given.work.resolve() / f"busy{busy}", busy))
            print(json.dumps(rows[-1]), flush=True)
    tell({"rows": rows}, given.json)


if __name__ == "__main__":
    main()
