"""How a fleet scales: `python -m tests.tools.fleet_scale --clips 10 100 1000 10000` prints seconds and memory.

Stand-in clips: a plan of new ones, Snakemake's own plan for them, a call with nothing to do, and the page. The results are
made once and then linked. `--run N` runs N of them for real, five in a hundred broken in ten ways.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stages.commands import fleet_page
from stages.contract import Job
from stages.formats.images import write_image
from tests.made.devtools import Page
from tests.made.fleet import Fleet
from tests.made.flow import HUGS, ROOT

DRAWN = """document.readyState === "complete" && [...document.images].some(i => i.src)
  && [...document.images].every(i => !i.src || i.complete)"""


def measured(folder: Path, command: Sequence[str], path: str = "") -> tuple[float, int, str]:
    """Seconds, peak memory in MiB, and stdout of a command."""
    where = os.pathsep.join([*([path] if path else []), str(ROOT)])
    began = time.monotonic()
    process = subprocess.Popen(
        command,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": where},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout
    out = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    assert status == 0, command
    return time.monotonic() - began, usage.ru_maxrss // 1024, out


def hugs(fleet: Fleet, *args: str) -> tuple[float, int, str]:
    """`hugs fleet` on all clips."""
    command = [sys.executable, "-c", HUGS, "fleet", "clips.txt", *args, "--pipelines-file", "pipelines.yaml"]
    return measured(fleet.folder, command, str(fleet.folder))


def clone(fleet: Fleet, source: str, names: Sequence[str]) -> None:
    """Give clips the results of one that has the same content."""
    root, video = fleet.work / source, fleet.clips / f"{source}.mp4"
    memory = json.loads((root / "sources.json").read_text())
    for name in names:
        copy, path = fleet.work / name, fleet.clips / f"{name}.mp4"
        shutil.copy2(video, path)
        shutil.copytree(root, copy, symlinks=True, copy_function=os.link, ignore=lambda *_: ["sources.json", ".lock"])
        (copy / "sources.json").write_text(json.dumps({"video": memory["video"] | {"path": str(path)}}))


def snakemake_plan(fleet: Fleet) -> tuple[float, int]:
    """Snakemake's own plan of as many jobs, which comes on top of ours where clips run side by side."""
    names = [line.partition(".")[0].rpartition("/")[2] for line in (fleet.folder / "clips.txt").read_text().split()]
    run = fleet.folder / "plan"
    run.mkdir()
    jobs = {"python": "true", "run": ".", "local": False, "most": 0, "megabytes": dict.fromkeys(names, 100),
            "steps": [["clip", None, "{row}.done"]], "threads": 1, "minutes": 1}  # fmt: skip
    (run / "jobs.json").write_text(json.dumps(jobs))
    file = str(ROOT / "hugs_cli/fleet/Snakefile")
    command = [sys.executable, "-m", "snakemake", "-s", file, "--directory", ".", "--cores", "2", "-n", "-q", "all"]
    seconds, memory, _ = measured(run, command)
    shutil.rmtree(run)
    return seconds, memory


def opened(fleet: Fleet, told: dict) -> str:
    """Seconds until Chromium has drawn the page with a picture in each row; '-' where it is not installed."""
    if shutil.which("chromium") is None:
        return "-"
    for row in told["rows"]:
        row["picture"] = "evaluate-1/heldout/1.png"
        picture = fleet.work / row["folder"] / "store" / row["picture"]
        picture.parent.mkdir(parents=True)
        write_image(picture, np.random.default_rng(len(row["clip"])).integers(0, 255, (108, 244, 3), np.uint8))
    fleet_page.run(
        Job(fleet.work), fleet_page.Params(), name="fleet", rows=told["rows"], totals=told["totals"], live=False
    )
    page = fleet.work / "fleet.html"
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.closing(Page(Path(folder), (1280, 900), ["--disable-gpu"])) as tab,
    ):
        tab.open(page, DRAWN)
        return f"{tab.run('performance.now()') / 1000:.1f}"


def scale(count: int, folder: Path) -> None:
    """Measure one size, and print a row."""
    fleet = Fleet(folder)
    names = [f"c{i:06d}" for i in range(count)]
    for name in names:
        fleet.add(name, "pixels")
    (fleet.folder / "clips.txt").write_text("".join(f"clips/{name}.mp4\n" for name in names))
    new = hugs(fleet, "--dry-run")
    theirs = snakemake_plan(fleet) if importlib.util.find_spec("snakemake") else (0.0, 0)
    fleet.done(f"clips/{names[0]}.mp4", "--jobs", "1")
    clone(fleet, names[0], names[1:])
    fresh = hugs(fleet, "--json")
    size = (fleet.work / "fleet.html").stat().st_size / 2**20
    cells = (f"{new[0]:.1f} s {new[1]} MiB", f"{theirs[0]:.1f} s {theirs[1]} MiB", f"{fresh[0]:.1f} s {fresh[1]} MiB",
             f"{size:.1f} MiB", f"{opened(fleet, json.loads(fresh[2]))} s")  # fmt: skip
    print(f"{count:>7}", *(f"{cell:>18}" for cell in cells), flush=True)


def rehearse(count: int, folder: Path) -> int:
    """Run so many clips, five in a hundred broken; 1 if anything is not as it should be."""
    fleet = Fleet(folder)
    broken = max(10, count // 20)
    good = [fleet.add(f"c{i:06d}", f"pixels {i}") for i in range(count - broken)]
    began = time.monotonic()
    said, err = fleet.done(fleet.table(good, broken).name, "--pipeline", "short", code=1)
    print(f"{count} clips, {broken} of them broken: {time.monotonic() - began:.0f} s, {said['totals']['states']}")
    print(*(f"  {number:>4} x {kind}" for kind, number in said["totals"]["failures"].items()), sep="\n")
    well = {row["clip"] for row in said["rows"] if row["state"] == "done"} == {path.stem for path in good}
    whole = len(fleet.made()) == len(good) and not fleet.twice() and "Traceback" not in err
    print(f"all others done: {well}; every result whole, none made twice: {whole}")
    return int(not (well and whole and len(said["totals"]["failures"]) == 10))


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, nargs="*", default=[10, 100, 1000])
    parser.add_argument("--run", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if args.run:
            return rehearse(args.run, Path(folder))
    heads = ("plan of new clips", "Snakemake's plan", "nothing to do", "page", "page drawn")
    print(f"{'clips':>7}", *(f"{head:>18}" for head in heads))
    for count in args.clips:
        with tempfile.TemporaryDirectory() as folder:
            scale(count, Path(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())
