"""The options that commands share, and the session that they open."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from hugs_cli import pipelines, within
from hugs_cli.cache.fingerprint import Code
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.workspace import Workspace
from hugs_cli.pipelines import UsageError
from hugs_cli.studies.comparison import SEEDED

SEED = re.compile(r"seed([0-9]{1,19})")
MAX_SEED = 2**63 - 1  # torch takes up to 2**64 - 1, and studies count up from the seed given
CODE_MEMORY = ".code.json"  # in the work folder; see fingerprint.Code


class Device(StrEnum):
    """Where the heavy stages compute."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Only(StrEnum):
    """What a picture shows."""

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
Work = Annotated[Path, Option(help="Results folder, with a folder for each clip.")]
Masks = Annotated[Path | None, Option(help="Person masks: a folder, a stack (.npy, .npz), COCO .json, a video.")]
Person = Annotated[
    str | None, Option(help="Person to track if several are visible, an id that the run lists; all: each.")
]
Cameras = Annotated[Path | None, Option(help="Cameras to import: a COLMAP model's folder, or transforms.json.")]
SmplFit = Annotated[Path | None, Option(help="Body poses to import: the file or folder of another tool.")]
BodyModel = Annotated[Path | None, Option(help="SMPL model (.pkl, .npz) in place of the free body.")]
Seed = Annotated[int, Option(min=0, max=MAX_SEED, help="Random seed; results are cached per seed.")]
AsJson = Annotated[bool, Option("--json", help="Print the result as JSON.")]
DryRun = Annotated[bool, Option("--dry-run", help="Only show the plan.")]
Force = Annotated[bool, Option("--force", help="Run the named stages (all if none) again.")]
DeviceName = Annotated[Device, Option(help="auto: the GPU if there is one.")]


def open_session(
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
) -> Session:
    """The session of one clip and one pipeline; UsageError where the options contradict each other.

    Also names the results of other commands: `default.10m` of `--within 10m`, `default.seed1` of `hugs ablate`.
    """
    chosen = () if person is None else (("masks", "person", person),)
    base, dot, last = pipeline.rpartition(".")
    within_time, seeded = bool(dot) and within.is_time(last), SEED.fullmatch(last) if dot else None
    loaded = pipelines.load(base if within_time or seeded else pipeline, (*(set_ or ()), *chosen), pipelines_file)
    sources = {
        "video": video,
        "mask_files": masks,
        "cameras": cameras,
        "smpl_fit": smpl_fit,
        "body_model": body_model,
    }
    if seeded and int(seeded[1]) > MAX_SEED:
        raise UsageError(f"pipeline {pipeline}: no such seed", f"seeds go from 0 to {MAX_SEED}")
    seeds = dict.fromkeys(SEEDED, int(seeded[1])) if seeded else {}
    session = Session(Workspace(video, work, pipeline), loaded, sources, seed, Code(work / CODE_MEMORY), seeds)
    return within.last_promise(session, last) if within_time else session
