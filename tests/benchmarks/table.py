"""The one table: each clip that is there, through each pipeline, at one commit on one machine with one seed.

    HUGS_CLIPS=FOLDER python -m tests.benchmarks.table [--work build/table] [--clips kitchen spin] [--pipelines preview default]

The synthetic clip is always there; the others are files of FOLDER, see CLIPS. Each run is `hugs run` on the video alone, so
finished ones are reused while their code is the same. Of a clip with truth the pictures that it keeps back are drawn and
compared (tests/made/held_out.py). After each run docs/benchmarks/table.json is written, at the end what is made from it: the
table, the plot and the marked numbers of the documents (tests/benchmarks/page.py). Results of two commits, two machines or
two seeds are never mixed: the program ends.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hugs_cli.cache.child import processors
from hugs_cli.cache.workspace import Stamp
from stages.avatar.measures.lpips import Lpips
from stages.estimators.assets import fetch
from tests.benchmarks import page
from tests.benchmarks.host import machine
from tests.benchmarks.promises import judged
from tests.made import held_out
from tests.made.command import ROOT

SEED = 0
ABOUT = ("commit", "machine", "seed")
CODE = ("stages", "hugs_cli", "pipelines.yaml")
METRICS = ("psnr", "ssim", "lpips")


class Clip(NamedTuple):
    """A film in the folder of clips; `truth` reads what its folder knows."""

    video: str
    truth: Callable[[Path], held_out.Truth] | None = None


SYNTHETIC = "synthetic"
CLIPS = {
    "kitchen": Clip("kitchen/kitchen.mp4"),
    "courtyard": Clip("courtyard/video.mp4", held_out.clip_truth),
    "spin": Clip("spin/video.mp4", held_out.clip_truth),
    "juggler": Clip("static_camera/juggle.mp4"),
    "treadmill": Clip("treadmill/cam01.mp4"),
}


def here(folder: Path | None) -> list[str]:
    """The clips that can be run."""
    return [SYNTHETIC, *(name for name, clip in CLIPS.items() if folder and (folder / clip.video).is_file())]


def run(name: str, pipeline: str, work: Path, folder: Path | None, lpips: Lpips) -> dict[str, Any]:
    """One row: what `hugs run` takes and reaches; `failed` with its last line in place of all if it ends with an error."""
    place = work / name
    if name == SYNTHETIC:
        video, command = place / "clip" / "synthetic" / "clip.mp4", ["demo"]
        truth: Callable[[], held_out.Truth] | None = partial(held_out.synthetic_truth, video.parent / "truth")
    else:
        assert folder is not None
        clip, video = CLIPS[name], folder / CLIPS[name].video
        command = ["run", str(video), "--seed", str(SEED)]
        truth = partial(clip.truth, video.parent) if clip.truth else None
    place.mkdir(parents=True, exist_ok=True)
    heard = place / f"{pipeline}.json"
    hugs = [sys.executable, "-m", "tests.benchmarks.watched", str(heard), *command, "--pipeline", pipeline]
    done = subprocess.run([*hugs, "--work", str(place)], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        return {"failed": next((line for line in said if line.startswith("error")), (said or ["no word"])[-1])}
    results = place / video.stem / pipeline
    row, countdown = facts(results), json.loads(heard.read_bytes())
    if countdown["said"]:  # not of a run that was finished before
        row["countdown"] = judged(**countdown)
    if truth is not None:
        finished = held_out.Finished(results, video)
        row["held_back"] = held_out.rate(finished, truth(), lpips, work / "drawn" / name / pipeline, place)
    return row


def facts(results: Path) -> dict[str, Any]:
    """Time, memory, sizes and scores of a finished run, from its stamps and .json files; SystemExit if another machine made it."""
    stamps = {link.name: stamp for link in sorted(results.iterdir()) if link.is_dir() and (stamp := Stamp.read(link))}
    hosts = {(stamp.machine["host"], stamp.machine["processors"]) for stamp in stamps.values()}
    if hosts != {(platform.node(), processors())}:
        raise SystemExit(f"{results} was made on {sorted(hosts)}, this is {platform.node()}: take another --work")
    trained, metrics, frames = (
        json.loads((results / place).read_bytes())
        for place in ("train/train.json", "evaluate/metrics.json", "frames/frames.json")
    )
    seconds = {name: stamp.seconds for name, stamp in stamps.items()}
    seconds["train"] = max(seconds["train"], trained["seconds"])  # of one that was taken up again the stamp has a part
    return {
        "size": [frames["width"], frames["height"]],
        "frames": len(frames["frames"]),
        "steps": trained["steps"],
        "device": metrics["device"],
        "minutes": round(sum(seconds.values()) / 60, 2),
        "minutes_by_stage": {name: round(value / 60, 2) for name, value in seconds.items()},
        "gib": round(max(stamp.peak_memory_bytes for stamp in stamps.values()) / 2**30, 2),
        "gaussians": metrics["gaussians"],
        **{
            protocol: {one: {metric: found[metric] for metric in METRICS} for one, found in metrics[protocol].items()}
            for protocol in ("heldout", "heldout_far")
        },
    }


def begun(old: dict[str, Any] | None, about: dict[str, Any], wanted: Collection[tuple[str, str]]) -> dict[str, Any]:
    """The table that rows are added to: `old` if it is of the same commit, machine and seed, else an empty one.

    SystemExit if rows of `old` would be lost that are not `wanted`, (clip, pipeline), again.
    """
    if old is None or all(old[key] == about[key] for key in ABOUT):
        return old or about | {"rows": {}}
    lost = [f"{clip} {one}" for clip, rows in old["rows"].items() for one in rows if (clip, one) not in wanted]
    if lost:
        apart = "; ".join(f"{key} {old[key]}, here {about[key]}" for key in ABOUT if old[key] != about[key])
        raise SystemExit(f"the table is of another {apart}: run {', '.join(lost)} as well, or remove {page.TABLE.name}")
    return about | {"rows": {}}


def commit() -> str:
    """The commit of the checkout; SystemExit if its code has changes that are not committed."""
    changed = git("status", "--porcelain", "--", *CODE)
    if changed:
        raise SystemExit(f"the code has changes that are not committed:\n{changed}")
    return git("rev-parse", "--short=10", "HEAD")


def git(*words: str) -> str:
    """What git prints."""
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "table")
    folder = Path(os.environ["HUGS_CLIPS"]).resolve() if "HUGS_CLIPS" in os.environ else None
    parser.add_argument("--clips", nargs="+", choices=here(folder), default=here(folder))
    parser.add_argument("--pipelines", nargs="+", default=["preview", "default"])
    args = parser.parse_args()
    about = {
        "commit": commit(),
        "machine": {key: value for key, value in machine().items() if key != "load"},
        "seed": SEED,
    }
    wanted = [(clip, pipeline) for clip in args.clips for pipeline in args.pipelines]
    table = begun(json.loads(page.TABLE.read_bytes()) if page.TABLE.exists() else None, about, wanted)
    with np.load(fetch("lpips_alex.npz")) as weights:
        lpips = Lpips(weights)
    for clip, pipeline in wanted:
        print(f"{time.strftime('%H:%M:%S')} {clip} {pipeline}", flush=True)
        row = run(clip, pipeline, args.work.resolve(), folder, lpips)
        if commit() != table["commit"]:
            raise SystemExit(f"the checkout was {table['commit']} and is {commit()} now: run it again")
        table["rows"].setdefault(clip, {})[pipeline] = row
        page.keep(table)
        print(page.line(clip, pipeline, row), flush=True)
    page.write(table)


if __name__ == "__main__":
    main()
