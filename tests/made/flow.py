"""A small pipeline of its own package, in a folder, and a way to run `hugs` on it."""

from __future__ import annotations

import copy
import json
import os
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Self

ROOT = Path(__file__).parents[2]
LONGEST = 600.0  # s for what takes a few, on a machine with much else to do
HUGS = "from hugs_cli import main; main()"  # what the installed command does
READY = "tests.made.ready"  # what has `serve`

STAGE = '''
"""A stage that writes what its inputs hold, after its own name."""
from stages.contract import Params as Base, speed_only

RESUMES = {resumes}

class Params(Base):
    word: str = "a"
    """What to write."""
    delay: float = speed_only(0.0)
    """Seconds to wait before the end."""
    hold: str = speed_only("")
    """A file; while it is there, the stage waits."""

def run(job, params, *, {needs}):
    """Write one file."""
    from flow import helper
    helper.work(job, params, "{name}", [{needs}])
'''

HELPER = '''
"""What all stages do."""
import os, time
from pathlib import Path

def work(job, params, name, inputs):
    # with a comment
    path = job.out / "out.txt"
    count = len(list(job.out.glob("step*")))
    if params.delay or params.hold or count:
        for i in range(count, 5):
            (job.out / f"step{i}").write_text("")
            job.progress(i + 1, 5, psnr=20.0 + i)
            end = time.monotonic() + params.delay / 5
            while time.monotonic() < end or (params.hold and os.path.exists(params.hold)):
                time.sleep(0.01)
                if job.stop_asked:
                    from stages.contract import Stopped
                    raise Stopped
        job.note(f"began at step {count}")
        for file in job.out.glob("step*"):
            file.unlink()
    texts = [(p / "out.txt").read_text() if p.is_dir() else p.read_text() for p in inputs if p]
    path.write_text(f"{name}:{params.word}({','.join(texts)})"[:10_000])
'''

ALL = ["one", "two", "three", "four"]
WHOLE = "four:a(two:a(one:a(pixels)),three:a(one:a(pixels)))"  # what the last one writes
# one -> two, three (resumes) -> four: a diamond
NEEDS = {"one": ["video"], "two": ["one"], "three": ["one", "mask_files"], "four": ["two", "three"]}


@cache
def ready_made(module: str = READY) -> subprocess.Popen:
    """The process that forks command lines by the `serve` of a module, one for all tests."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    start = f"from hugs_cli.cache import child; child.prepare(); from {module} import serve; serve()"
    return subprocess.Popen(
        [sys.executable, "-c", start], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def forked(
    folder: Path, environment: dict[str, str], arguments: list[str], code: int = 0, module: str = READY
) -> tuple[str, str]:
    """Run a command line in a folder, by `ready_made`; its stdout and stderr. The exit code must be `code`."""
    with tempfile.NamedTemporaryFile() as out, tempfile.NamedTemporaryFile() as err:
        job, ready = [str(folder), environment, [str(folder)], arguments], ready_made(module)
        print(json.dumps([*job, out.name, err.name]), file=ready.stdin, flush=True)
        ended, said = int(ready.stdout.readline()), (out.read().decode(), err.read().decode())
    assert ended == code, f"exit code {ended}\n{said[0]}\n{said[1]}"
    return said


class Flow:
    """A clip, a package of four stages, pipelines for them, and the command line."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.package = folder / "flow"
        self.video = folder / "clip.mp4"
        self.work = folder / "work"
        self.package.mkdir()
        self.write("__init__", "")
        self.write("helper", HELPER)
        for name, needs in NEEDS.items():
            self.write(name, STAGE.format(name=name, needs=", ".join(needs), resumes=name == "three"))
        self.video.write_text("pixels")
        stages = "".join(f"    {n}: {{needs: [{', '.join(d)}], module: flow.{n}}}\n" for n, d in NEEDS.items())
        more = "other:\n  doc: Another.\n  extends: default\n  stages: {four: {params: {word: z}}}\n"
        (folder / "pipelines.yaml").write_text(f"default:\n  doc: Four.\n  stages:\n{stages}{more}")

    def copied(self, folder: Path) -> Self:
        """The same in another folder, with its results."""
        shutil.copytree(self.folder, folder, symlinks=True, dirs_exist_ok=True)
        other = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Path):
                setattr(other, name, folder / value.relative_to(self.folder))
        return other

    def hold(self, stage: str) -> tuple[str, str]:
        """What makes a stage wait until `go` is called."""
        (self.folder / "hold").touch()
        return ("--set", f"{stage}.hold=hold")

    def go(self) -> None:
        """Let all stages that wait go on."""
        (self.folder / "hold").unlink()

    def write(self, name: str, text: str) -> None:
        """Write one module of the package."""
        (self.package / f"{name}.py").write_text(textwrap.dedent(text))

    def edit(self, name: str, old: str, new: str) -> None:
        """Change one module of the package."""
        text = (self.package / f"{name}.py").read_text()
        assert old in text
        self.write(name, text.replace(old, new))

    def arguments(self, command: str, *args: str) -> list[str]:
        """`COMMAND clip.mp4 ARGS` as words."""
        place = (
            ["--pipelines-file", str(self.folder / "pipelines.yaml")] if command not in ("gc", "render", "view") else []
        )
        return [command, "clip.mp4", *args, *place]

    def environment(self) -> dict[str, str]:
        """Of the command line."""
        own = {"PYTHONPATH": f"{self.folder}:{ROOT}", "HUGS_CACHE": str(self.folder / "cache")}  # times of stand-ins
        return {**os.environ, **own, "NO_COLOR": "1", "COLUMNS": "200"}

    def start(self, *args: str, command: str = "run") -> subprocess.Popen:
        """Start `hugs COMMAND clip.mp4 ARGS`."""
        return subprocess.Popen(
            [sys.executable, "-c", HUGS, *self.arguments(command, *args)],
            cwd=self.folder,
            env=self.environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def hugs(self, *args: str, command: str = "run", code: int = 0) -> tuple[str, str]:
        """Run it to its end; its stdout and stderr. The exit code must be `code`."""
        return forked(self.folder, self.environment(), self.arguments(command, *args), code)

    def ran(self, *args: str) -> dict[str, list[str]]:
        """Run it; the stages that ran (not those cached), each with its reasons."""
        out, _ = self.hugs(*args, "--json")
        return {row["stage"]: row["reasons"] for row in json.loads(out)["stages"] if row["state"] == "done"}

    def text(self, stage: str, pipeline: str = "default") -> str:
        """What a stage wrote."""
        return (self.work / "clip" / pipeline / stage / "out.txt").read_text()

    @staticmethod
    def wait_for(condition: Callable[[], object], seconds: float = LONGEST) -> None:
        """Wait until something is so; fails if it does not come to be."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "waited in vain"
            time.sleep(0.01)

    @property
    def store(self) -> Path:
        """The folder of results."""
        return self.work / "clip" / "store"
