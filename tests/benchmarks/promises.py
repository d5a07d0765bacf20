"""Are promises of time kept, also beside other work: `python -m tests.benchmarks.promises WORK kitchen.mp4=5m ... [--busy 0 1 2]`.

Each clip is run from nothing `--within` its time, beside so many processes that do nothing but compute. A promise is kept if the
run ends at most 10 % late, beside other work 20 %, or if it said before its first stage that it would be late. Results are
in WORK/busyN.

A clip without a time is run through `--pipeline` (preview), `--runs` times (1): seconds guessed at first, seconds that it
`took` from then on, seconds `to_go` at half-time and what was `said` then, and the `least` that was said with more than 2 s to go.
Earlier runs of the same HUGS_CACHE are what a guess is made from.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path

from tests.benchmarks.host import tell
from tests.made.command import ROOT

QUIET, BUSY = 1.1, 1.2  # of the promised time, that a run may take
CLOSE = 2.0  # s to go, from which on a countdown may say nothing is left


@contextmanager
def other_work(processes: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """So many processes that compute all the time, each in a session of its own, as those of somebody else who works beside. They
    end with this process, however it ends.
    """
    loop = f"import os\nwhile os.getppid() == {os.getpid()}:\n    for _ in range(10**6): pass"
    others: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(processes):
            others.append(subprocess.Popen([sys.executable, "-c", loop], start_new_session=True))
        yield others
    finally:
        for one in others:
            one.kill()
            one.wait()


def countdown(clip: Path, pipeline: str, work: Path, busy: int) -> dict[str, object]:
    """One run from nothing through a pipeline, and what its countdown said."""
    work.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(work / clip.stem, ignore_errors=True)
    heard = work / f"{clip.stem}.json"
    command = [sys.executable, "-m", "tests.benchmarks.watched", heard, "run", clip, "--pipeline", pipeline]
    with other_work(busy):
        done = subprocess.run([*map(str, command), "--work", str(work)], cwd=ROOT, capture_output=True, text=True)
    row: dict[str, object] = {"clip": clip.name, "pipeline": pipeline, "busy": busy}
    if done.returncode:
        return row | {"failed": (done.stdout + done.stderr).strip().splitlines()[-3:]}
    return row | judged(**json.loads(heard.read_text()))


def judged(said: list[tuple[float, float]], took: float) -> dict[str, object]:
    """Of a run that `took` so many seconds, and `said` at some of them how many there were to go: see above."""
    half = [left for now, left in said if now <= took / 2][-1]
    least = min((left for now, left in said if took - now > CLOSE), default=None)
    found = {"guess": said[0][1], "took": took, "to_go": took / 2, "said": half, "off": half / (took / 2) - 1}
    return {name: round(value, 2) for name, value in found.items()} | {"least": least and round(least, 2)}


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
    parser.add_argument("clips", nargs="+", metavar="CLIP[=TIME]")
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--pipeline", default="preview")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    for busy, one in product(given.busy, given.clips):
        name, _, time = one.partition("=")
        clip, work = Path(name).resolve(), given.work.resolve() / f"busy{busy}"
        for _ in range(given.runs):
            rows.append(run(clip, time, work, busy) if time else countdown(clip, given.pipeline, work, busy))
            print(json.dumps(rows[-1]), flush=True)
    tell({"rows": rows}, given.json)


if __name__ == "__main__":
    main()
