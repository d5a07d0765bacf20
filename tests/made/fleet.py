"""Many clips for the stand-in pipeline of tests/made/flow.py, some of them broken, and `hugs fleet` on them."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hugs_cli.cache.fingerprint import file_digest, files_under
from hugs_cli.cache.workspace import OURS, PART, Stamp
from tests.made.flow import HUGS, LONGEST, Flow

BREAKS = '''
"""Does to a stage what the clip asks for."""
import os, signal, time
from stages.contract import StageError

def obey(job, text):
    """Break in the way that the text names; nothing for another text."""
    way = text.partition(" ")[2] if text.startswith("broken ") else ""
    if way == "error":
        raise StageError(f"no person in any of {len(text)} frames of '{text}'", "film somebody", ["0 landmarks"])
    if way == "bug":
        raise KeyError("shoulder")
    if way == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if way == "exit":
        os._exit(3)
    if way == "nothing":
        return True
    if way == "disk":
        open("/dev/full", "w").write("x" * 100_000)
    if way == "memory":
        raise MemoryError("wanted too much")
    return False
'''
FIRST = '''
"""A stage that writes what the clip holds, or breaks."""
from stages.contract import Params as Base, speed_only

class Params(Base):
    word: str = "a"
    """What to write."""
    delay: float = speed_only(0.0)
    """Seconds to wait before the end."""
    hold: str = speed_only("")
    """A file; while it is there, the stage waits."""

def run(job, params, *, video):
    """Write one file."""
    from flow import breaks, helper
    if not breaks.obey(job, video.read_text()):
        helper.work(job, params, "one", [video])
'''
WAYS = ("error", "bug", "killed", "exit", "nothing", "disk", "memory", "missing", "pipeline", "setting")
"""Ten ways in which a clip is broken; the last three show before anything runs."""
SHORT = """
short:
  doc: One stage.
  stages: {one: {needs: [video], module: flow.one}}
pair:
  doc: Two stages.
  extends: short
  stages: {two: {needs: [one], module: flow.two}}
"""


class Fleet(Flow):
    """A folder of clips, and pipelines of stand-ins: `default` of four stages, `short` of one, `pair` of two."""

    def __init__(self, folder: Path, count: int = 0):
        super().__init__(folder)
        self.clips = folder / "clips"
        self.clips.mkdir()
        self.write("breaks", BREAKS)
        self.write("one", FIRST)
        file = folder / "pipelines.yaml"
        file.write_text(file.read_text() + SHORT)
        for i in range(count):
            self.add(f"c{i:05d}", f"pixels {i}")

    def add(self, name: str, text: str) -> Path:
        """One more clip."""
        path = self.clips / f"{name}.mp4"
        path.write_text(text)
        return path

    def table(self, good: Iterable[Path], broken: int) -> Path:
        """A table of good clips, and of some that are broken in the ten ways in turn."""
        rows = [{"clip": f"clips/{path.name}", "pipeline": "", "settings": ""} for path in good]
        for i in range(broken):
            way = WAYS[i % len(WAYS)]
            path = self.add(f"b{i:05d}", f"broken {way}")
            row = {"clip": f"clips/{path.name}", "pipeline": "", "settings": ""}
            if way == "missing":
                path.unlink()
            row |= {"pipeline": {"pipeline": "nowhere"}, "setting": {"settings": "one.colour=red"}}.get(way, {})
            rows.insert(i * len(rows) // max(1, broken), row)
        file = self.folder / "clips.csv"
        with file.open("w", newline="") as out:
            table = csv.DictWriter(out, ("clip", "pipeline", "settings"))
            table.writeheader()
            table.writerows(rows)
        return file

    def arguments(self, command: str, *args: str) -> list[str]:
        """As words: a fleet has many clips."""
        return [command, *args, "--pipelines-file", "pipelines.yaml"]

    def fleet(self, *args: str, first: str = "", **environment: str) -> subprocess.Popen[str]:
        """Start `hugs fleet`, on all clips if none are named. `first` comes before all else on Python's path."""
        given = args if args and not args[0].startswith("-") else ("clips/*.mp4", *args)
        own = self.environment()
        own["PYTHONPATH"] = ":".join([*([first] if first else []), own["PYTHONPATH"]])
        return subprocess.Popen(
            [sys.executable, "-c", HUGS, "fleet", *given, "--pipelines-file", "pipelines.yaml"],
            cwd=self.folder,
            env={**own, "OMP_NUM_THREADS": "1", **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def done(self, *args: str, code: int = 0, **more: str) -> tuple[dict[str, Any], str]:
        """Run it to its end: what `--json` says, and stderr."""
        process = self.fleet(*args, "--json", **more)
        out, err = process.communicate(timeout=LONGEST)
        assert process.returncode == code, f"exit code {process.returncode}\n{out}\n{err}"
        return json.loads(out), err

    def forked(self, *args: str, code: int = 0) -> tuple[dict[str, Any], str]:
        """As `done`, through the process of tests/made/ready.py."""
        given = args if args and not args[0].startswith("-") else ("clips/*.mp4", *args)
        out, err = self.hugs(*given, "--json", command="fleet", code=code)
        return json.loads(out), err

    def runs(self) -> list[dict[str, Any]]:
        """Every stage that ever ran, of all clips: the lines of runs.jsonl, and the clip's name."""
        files = self.work.glob("*/runs.jsonl")
        return [{**json.loads(line), "clip": f.parent.name} for f in files for line in f.read_text().splitlines()]

    def twice(self) -> list[tuple[str, str, str]]:
        """Clip, stage and key of results that were made more than once."""
        made = Counter((run["clip"], run["stage"], run["key"]) for run in self.runs() if run["result"] == "done")
        return [one for one, count in made.items() if count > 1]

    def made(self) -> dict[str, str]:
        """Clip and stage of each finished result -> digest of its content; every byte is compared with the stamp."""
        found = {}
        for folder in self.work.glob("*/store/*"):
            if folder.suffix == PART:
                continue
            stamp = Stamp.read(folder)
            assert stamp, f"{folder} has no stamp"
            there = {name: file_digest(path) for name, path in files_under(folder).items() if name not in OURS}
            assert there == {name: one["sha256"] for name, one in stamp.files.items()}, f"{folder} is not as written"
            found[f"{folder.parents[1].name}/{folder.name}"] = stamp.content
        return found


def states(said: dict[str, Any]) -> dict[str, str]:
    """Clip -> state, of what `--json` says."""
    return {row["clip"]: row["state"] for row in said["rows"]}
