"""The options that commands share, and what they come to."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hugs_cli import pipelines, within
from hugs_cli.cache.fingerprint import Code
from hugs_cli.cache.freshness import Judge
from hugs_cli.cache.workspace import Workspace

CODE_MEMORY = ".code.json"  # in the work folder; see fingerprint.Code


class Device(StrEnum):
    """Where the heavy stages compute."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Only(StrEnum):
    """What a rendered view shows."""

    human = "human"
    scene = "scene"
    both = "both"


class Up(StrEnum):
    """An axis of a motion file."""

    y = "y"
    minus_y = "-y"
    z = "z"
    minus_z = "-z"


Video = Annotated[Path, Argument(help="A video, a folder of pictures, or of a data set.", show_default=False)]
Stages = Annotated[list[str] | None, Argument(help="Stages of the pipeline; all if none.", show_default=False)]
PipelineName = Annotated[str, Option("--pipeline", "-p", help="One of pipelines.yaml.")]
PipelinesFile = Annotated[Path, Option(help="Read pipelines from this file.", show_default="pipelines.yaml")]
Settings = Annotated[list[str] | None, Option("--set", metavar="STAGE.PARAM=VALUE", help="Change one setting.")]
Work = Annotated[Path, Option(help="Folder that holds a folder for each clip.")]
Masks = Annotated[Path | None, Option(help="Person masks: a folder, a stack (.npy, .npz), COCO .json, a video.")]
Person = Annotated[str | None, Option(help="Whom to follow where several are in view: an id that the run says.")]
Cameras = Annotated[Path | None, Option(help="Cameras to import: a COLMAP model's folder, or transforms.json.")]
SmplFit = Annotated[Path | None, Option(help="Body poses to import: the file or folder of another tool.")]
BodyModel = Annotated[Path | None, Option(help="SMPL model (.pkl, .npz) to use in place of the free body.")]
Seed = Annotated[int, Option(help="Of every random choice; part of what makes a result.")]
AsJson = Annotated[bool, Option("--json", help="Print the result as JSON.")]
DryRun = Annotated[bool, Option("--dry-run", help="Only say what would be done.")]
Force = Annotated[bool, Option("--force", help="Run the named stages (all if none) even if they are fresh.")]
DeviceName = Annotated[Device, Option(help="auto: the GPU if there is one.")]


def judge_of(
    video: Video,
    pipeline: PipelineName = "default",
    set_: Settings = None,
    masks: Masks = None,
    person: Person = None,
    cameras: Cameras = None,
    smpl_fit: SmplFit = None,
    body_model: BodyModel = None,
    seed: Seed = 0,
    work: Work = Path("work"),
    pipelines_file: PipelinesFile = pipelines.FILE,
) -> Judge:
    """The judge of one clip and one pipeline; UsageError where the options make no sense."""
    chosen = () if person is None else (f"masks.person={person}",)
    base, dot, last = pipeline.rpartition(".")
    within_time = bool(dot) and within.is_time(last)
    loaded = pipelines.load(base if within_time else pipeline, (*(set_ or ()), *chosen), pipelines_file)
    sources = {
        "video": video,
        "mask_files": masks,
        "cameras": cameras,
        "smpl_fit": smpl_fit,
        "body_model": body_model,
    }
    judge = Judge(Workspace(video, work, pipeline), loaded, sources, seed, Code(work / CODE_MEMORY))
    return within.remembered(judge, last) if within_time else judge


def on_clip(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose first argument is a judge: on the command line it takes the options of `judge_of` instead."""
    own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
    video, *common = inspect.signature(judge_of, eval_str=True).parameters.values()
    names = [parameter.name for parameter in (video, *common)]

    @functools.wraps(command)
    def with_options(**given: Any) -> None:
        command(judge_of(**{name: given.pop(name) for name in names}), **given)

    with_options.__signature__ = inspect.Signature([video, *own, *common])
    del with_options.__wrapped__  # or its signature would be looked at
    return with_options
