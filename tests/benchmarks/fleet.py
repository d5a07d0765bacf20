"""Six synthetic clips one after another and side by side: `python -m tests.benchmarks.fleet [--set train.steps=40 ...]`.

Prints how many clips a minute each way makes, and whether the results have the same bytes. Give it a machine of its own.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

from hugs_cli.cache.fingerprint import file_digest, files_under
from hugs_cli.cache.workspace import OURS
from hugs_cli.console import Console
from hugs_cli.demo import synthetic_clip
from tests.made.command import hugs

COMPARED = (".npz", ".ply", ".png", ".bin")  # the others tell times


def made(work: Path) -> dict[str, str]:
    """Clip, stage and file -> digest, of all results."""
    return {
        f"{link.parent.parent.name}/{link.name}/{name}": file_digest(path)
        for link in sorted(work.glob("*/ci/*"))
        for name, path in files_under(link.resolve()).items()
        if path.suffix in COMPARED and name not in OURS
    }


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=Path, help="a folder of clips; else six are made")
    parser.add_argument("--set", action="append", default=[], help="as in `hugs run`")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as room:
        clips = args.clips or Path(room) / "clips"
        for seed in range(0 if args.clips else 6):
            clips.mkdir(exist_ok=True)
            shutil.copy2(synthetic_clip(Path(room) / str(seed), seed, Console()), clips / f"s{seed}.mp4")
        settings = [word for one in args.set for word in ("--set", one)]
        results, times = [], []
        for jobs in (2, 1):  # what is warmed up by the first helps the one that it is compared with
            work, began = Path(room) / f"jobs{jobs}", time.monotonic()
            done = hugs(
                "fleet",
                clips / "*.mp4",
                "--pipeline",
                "ci",
                "--work",
                work,
                "--jobs",
                str(jobs),
                "--json",
                *settings,
                seconds=7200,
            )
            times.append(time.monotonic() - began)
            rows = json.loads(done.stdout)["rows"]
            print(
                f"--jobs {jobs}: {len(rows)} clips in {times[-1]:.0f} s, {60 * len(rows) / times[-1]:.2f} a minute",
                flush=True,
            )
            results.append(made(work))
        same = results[0] == results[1] and bool(results[0])
        print(
            f"side by side {times[1] / times[0]:.2f} times as many; {len(results[0])} files with the same bytes: {same}"
        )
    return int(not same)


if __name__ == "__main__":
    sys.exit(main())
