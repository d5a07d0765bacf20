"""A folder with a small film and the command line there, for the commands of the documents: stages run as they are."""

from __future__ import annotations

import importlib
import json
import os
import shlex
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer
import yaml

from hugs_cli.app import app
from hugs_cli.studies import variants
from stages.filming import outputs
from stages.formats.video import write_video
from tests.made import bodyfit_clips, brought, ready
from tests.made.flow import ROOT, forked
from tests.made.meshes import coarse

LIBRARIES = ("torch._dynamo", "scipy.spatial", "scipy.optimize", "numba", "cv2", "av", "trimesh", "xatlas", "skimage")
SIZES: dict[str, dict[str, Any]] = {
    "train": {"steps": 8, "human_points": 1500, "human_cap": 2500, "scene_cap": 3000, "scene_fill": 500, "channels": 8,
              "resolution": 16, "curve_points": 1, "views_per_decode": 4, "effect_gains": False},
    "export": {"triangles": 500, "texture": 64},
    "render": {"turntable_frames": 4, "motion_seconds": 0.2},
    "evaluate": {"fit_steps": 1},
}  # fmt: skip
"""Of every pipeline, in place of those of pipelines.yaml; below those of `ci`."""
LEVELS = {"steps": {(2,): 2.0}, "caps": {(2, 2): 1.4}}
"""Of the axes of a sweep, in place of all; see `variants.AXES`."""
SMALLER = {
    "8000": "12",
    "15m": "10s",
    "40m": "10s",
    "--budget 120": "--budget 0.03",
    "--budget 60": "--budget 9",
    "--seeds 3": "--seeds 1",
    "50000": "300",
    "4096": "64",
}
"""Numbers of the documents that take long -> those that are run."""
PIPELINES = "small.yaml"
PROFILE = "executor: local\nscheduler: greedy\ncores: 2\njobs: 2\n"
"""Snakemake's for this machine, under the name of a cluster's."""
HUGS = typer.main.get_command(app)
Said = tuple[str, str]


class Try(NamedTuple):
    """What is looked for, and words besides: those that make less, or bring what the command takes for granted."""

    check: Callable[[Place, Said], None]
    more: tuple[str, ...] = ()
    inside: str = ""
    code: int = 0


@dataclass(frozen=True)
class Place:
    """The folder; `hugs` takes a command line as a document shows it."""

    folder: Path

    @cached_property
    def environment(self) -> dict[str, str]:
        """Of the command line: Snakemake's profiles of its own, and a browser that shows nothing."""
        own = {"PYTHONPATH": str(ROOT), "XDG_CONFIG_HOME": str(self.folder / "config"), "BROWSER": "true"}
        return {**os.environ, **own, "NO_COLOR": "1", "COLUMNS": "200"}

    def hugs(self, line: str, *more: str, code: int = 0, inside: str = "") -> Said:
        """Run `hugs ...` with PIPELINES, numbers of SMALLER and further words, in a folder inside; its stdout and stderr."""
        for large, less in SMALLER.items():
            line = line.replace(large, less)
        words = [*shlex.split(line)[1:], *more]
        takes = {param.name for param in HUGS.commands[words[0]].params}
        words += ["--pipelines-file", str(self.folder / PIPELINES)] * ("pipelines_file" in takes)
        return forked(self.folder / inside, self.environment, words, code, __name__)

    def tried(self, line: str, one: Try) -> None:
        """Run a command of the documents, and look for what is promised of it."""
        said = self.hugs(line, *one.more, code=one.code, inside=one.inside)
        print(*said, sep="\n")
        one.check(self, said)

    def gather(self) -> None:
        """Put the film into clips/; its results stay its own, since it is no longer where it was."""
        if (self.folder / "dance.mp4").exists():
            shutil.move(self.folder / "dance.mp4", self.folder / "clips")

    def at(self, name: str) -> Path:
        """A result of dance.mp4: `default/train/avatar.npz`."""
        return self.folder / "work" / "dance" / name

    def facts(self, name: str) -> Any:
        """What a .json of dance.mp4 holds."""
        return json.loads(self.at(name).read_bytes())


def make(folder: Path) -> Place:
    """dance.mp4, the pipelines, and a profile of Snakemake."""
    write_video(folder / "dance.mp4", brought.true().views.images, brought.FPS, crf=12)
    (folder / PIPELINES).write_text(pipelines())
    (folder / "config" / "snakemake" / "slurm").mkdir(parents=True)
    (folder / "config" / "snakemake" / "slurm" / "config.yaml").write_text(PROFILE)
    return Place(folder)


def pipelines() -> str:
    """pipelines.yaml with SIZES."""
    found = yaml.safe_load((ROOT / "pipelines.yaml").read_text())
    for one in found.values():
        for stage, sizes in SIZES.items():
            entry = one["stages"].get(stage) or {}
            one["stages"][stage] = {**entry, "params": entry.get("params", {}) | sizes}
    return yaml.safe_dump(found, sort_keys=False)


def serve() -> None:
    """Run command lines in a process that has loaded LIBRARIES: body fits take few steps, meshes are coarse, sweeps have few
    levels."""
    for library in LIBRARIES:
        importlib.import_module(library)
    with pytest.MonkeyPatch.context() as patch, coarse():
        bodyfit_clips.take_steps(patch, 30, 15, 30)
        patch.setattr(outputs, "MESH", (300, 64))
        for axis, levels in LEVELS.items():
            patch.setitem(variants.AXES, axis, variants.AXES[axis]._replace(levels=levels))
        ready.serve()
