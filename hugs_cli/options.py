"""The options that commands share, those kept of a pipeline's last run, and the session that they open."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_type_hints

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from typer import Argument, Option

from hugs_cli import pipelines, within, words
from hugs_cli.cache.fingerprint import Code
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.workspace import OPTIONS, Stamp, Workspace, result_behind
from hugs_cli.console import Console
from hugs_cli.pipelines import UsageError
from hugs_cli.studies.comparison import SEEDED

SEED = re.compile(r"seed([0-9]{1,19})")
MAX_SEED = 2**63 - 1  # torch takes up to 2**64 - 1, and studies count up from the seed given
PIPELINE = re.compile(r"(?!store$)[a-z][a-z0-9_]*(\.[a-z0-9_]+)*")  # names of its folder
EVERYBODY = "all"  # as the person of masks
LARGEST = 100_000  # bytes of kept options
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


class Axes(StrEnum):
    """Which way y points in a file of Gaussians."""

    y_down = "y_down"
    y_up = "y_up"


class Up(StrEnum):
    """An axis of a motion file."""

    y = "y"
    minus_y = "-y"
    z = "z"
    minus_z = "-z"


Video = Annotated[
    Path, Argument(help="A video, a folder of pictures, or the folder of a data set.", show_default=False)
]
Stages = Annotated[list[str] | None, Argument(help="Stages of the pipeline; by default all.", show_default=False)]
WHICH = Option("--pipeline", "-p", help="One of pipelines.yaml.", show_default="default")
PipelineName = Annotated[str, WHICH]
AnyPipeline = Annotated[str | None, WHICH]
PipelinesFile = Annotated[Path, Option(help="Read pipelines from this file.", show_default="pipelines.yaml")]
Settings = Annotated[list[str] | None, Option("--set", metavar="STAGE.PARAM=VALUE", help="Change one setting.")]
Work = Annotated[Path, Option(help="Results folder, with a folder for each clip.")]
BodyModel = Annotated[Path | None, Option(help="SMPL, SMPL-H or SMPL-X model (.pkl, .npz) in place of the free body.")]
Seed = Annotated[
    int | None,
    Option(min=0, max=MAX_SEED, help="Random seed; results are cached per seed.", show_default="0"),
    Field(ge=0, le=MAX_SEED, strict=True),
]
AsJson = Annotated[bool, Option("--json", help="Print the result as JSON.")]
DryRun = Annotated[bool, Option("--dry-run", help="Only show the plan.")]
Force = Annotated[bool, Option("--force", help="Run the named stages again; by default all.")]
Overwrite = Annotated[bool, Option("--force", help="Overwrite files that others made; never a source or a result.")]
DeviceName = Annotated[Device, Option(help="auto: the GPU if there is one that torch and gsplat can use.")]


@dataclass(frozen=True)
class Kept:
    """What a run makes of a clip beside its pipeline: kept in the pipeline's folder. None: not given."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")
    set_: Settings = None
    masks: Annotated[Path | None, Option(help="Person masks: a folder, a stack (.npy, .npz), COCO .json, a video.")] = (
        None
    )
    person: Annotated[
        str | None, Option(help="Id of the person to follow, as the run lists them; all: an avatar of each.")
    ] = None
    cameras: Annotated[Path | None, Option(help="Cameras to import: a COLMAP model's folder, or transforms.json.")] = (
        None
    )
    smpl_fit: Annotated[Path | None, Option(help="Body poses to import: the file or folder of another tool.")] = None
    landmarks: Annotated[
        Path | None, Option(help="Keypoints to import: OpenPose, MMPose, AlphaPose, ViTPose .json; .csv, .trc, .npz.")
    ] = None
    face: Annotated[
        Path | None, Option(help="A face capture to import (csv) that begins with the video: a time, the 52 shapes.")
    ] = None
    body_model: BodyModel = None
    height: Annotated[
        list[str] | None,
        Option(
            metavar="LENGTH",
            help="How tall, barefoot: 1.85, 185cm, 6ft1. Repeat it for each person in order, or name one: 2=1.70.",
        ),
    ] = None
    scale: Annotated[
        str | None,
        Option(
            metavar="SHOWN=TRUE",
            help="A length on the page and its true length in m; or `cameras`, if the given cameras are in metres.",
        ),
    ] = None
    seed: Seed = None

    def values(self) -> dict[str, Any]:
        """The options as plain JSON values, paths whole."""
        values = {one.name: getattr(self, one.name) for one in fields(Kept)}
        whole = {name: os.path.abspath(one) if isinstance(one, Path) else one for name, one in values.items()}
        return whole | {"set_": list(self.set_ or ()), "seed": self.seed or 0}


@dataclass(frozen=True)
class RunOptions(Kept):
    """All options of a run, for it and for commands that look at its results."""

    pipeline: AnyPipeline = None
    work: Work = Path("work")
    pipelines_file: PipelinesFile = pipelines.FILE

    def session(self, video: Path) -> Session:
        """The session of one clip and one pipeline; UsageError where the options contradict each other.

        Also names the results of other commands: `default.10m` of `--within 10m`, `default.seed1` of `hugs ablate`.
        """
        pipeline = self.pipeline or "default"
        chosen: list[pipelines.Override] = [("masks", "person", self.person)] if self.person is not None else []
        chosen += [("smpl", "height", self.height)] if self.height else []
        chosen += [("smpl", "scale", self.scale)] if self.scale is not None else []
        base, dot, last = pipeline.rpartition(".")
        within_time, seeded = bool(dot) and within.is_time(last), SEED.fullmatch(last) if dot else None
        overrides = (*(self.set_ or ()), *chosen)
        loaded = pipelines.load(base if within_time or seeded else pipeline, overrides, self.pipelines_file)
        self._check_lengths(loaded)
        sources = {
            "video": video,
            "mask_files": self.masks,
            "cameras": self.cameras,
            "smpl_fit": self.smpl_fit,
            "landmarks": self.landmarks,
            "face": self.face,
            "body_model": self.body_model,
        }
        if seeded and int(seeded[1]) > MAX_SEED:
            raise UsageError(f"pipeline {pipeline}: no such seed", f"seeds go from 0 to {MAX_SEED}")
        seeds = dict.fromkeys(SEEDED, int(seeded[1])) if seeded else {}
        place, code = Workspace(video, self.work, pipeline), Code(self.work / CODE_MEMORY)
        session = Session(place, loaded, sources, self.seed or 0, code, seeds, self.values())
        return within.last_promise(session, last) if within_time else session

    def _check_lengths(self, pipeline: pipelines.Pipeline) -> None:
        """UsageError for the height of somebody whom nobody follows, and for the unit of cameras that nobody gives."""
        settings = {name: stage.settings() for name, stage in pipeline.stages.items()}
        size, masks = settings.get("smpl", {}), settings.get("masks", {})
        if masks.get("person") != EVERYBODY and (others := [who for who in size.get("height") or () if int(who) > 1]):
            hint = "`--person all` makes an avatar of each; a person who is followed alone has the number 1"
            raise UsageError(f"a height is given for person {others[0]}, but only one person is followed", hint)
        if size.get("scale") == "cameras" and not self.cameras and "cameras" in pipeline.stages["sfm"].needs:
            raise UsageError("--scale cameras needs given cameras", "give them with `--cameras PATH`")

    def of_last_run(self, video: Path, console: Console) -> RunOptions:
        """With the options of the pipeline's last run, where no others are given; a line says which those are."""
        name = self.pipeline or "default"
        try:
            last = kept_options(Workspace(video, self.work, name).links / OPTIONS)
        except (OSError, ValueError) as error:
            why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
            console.say(f"the options of the last run of {name} cannot be read and are ignored: {why}")
            return self
        if last is None:
            return self
        own, theirs = self.values(), last.values()
        given = [one for one in own if getattr(self, one) not in (None, [])]
        taken = {one: value for one, value in theirs.items() if one not in given and value}
        if other := {one: own[one] for one in given if own[one] != theirs[one]}:
            said = as_text({one: value for one, value in theirs.items() if value}) or "none"
            console.say(f"other options than the last run of {name} ({said}): {as_text(other)}")
        elif taken:
            console.say(f"with the options of the last run of {name}: {as_text(taken)}")
        return replace(self, **{one: getattr(last, one) for one in taken})

    def of_results(self, video: Path, console: Console) -> RunOptions:
        """`of_last_run`, of the only pipeline with results where none is given."""
        pipeline = pipeline_of(video, self.work, self.pipeline, console)
        return replace(self, pipeline=pipeline).of_last_run(video, console)


def on_a_run(command: Callable[..., None]) -> Callable[..., None]:
    """The command with each of `RunOptions` as an option in place of its parameter `given`."""
    hints, names = get_type_hints(RunOptions, include_extras=True), [one.name for one in fields(RunOptions)]
    own = [one for one in signature(command, eval_str=True).parameters.values() if one.name != "given"]
    shared = [
        Parameter(one.name, Parameter.KEYWORD_ONLY, default=one.default, annotation=hints[one.name])
        for one in sorted(fields(RunOptions), key=lambda one: one.name != "pipeline")
    ]

    @wraps(command)
    def called(**values: Any) -> None:
        command(given=RunOptions(**{name: values.pop(name) for name in names}), **values)

    called.__annotations__ = {}
    vars(called)["__signature__"] = Signature([*(one.replace(kind=Parameter.KEYWORD_ONLY) for one in own), *shared])
    return called


def kept_options(file: Path) -> Kept | None:
    """The options that a run kept in its pipeline's folder; None where there are none, as of versions before 0.3.0.
    OSError or ValueError for a file that no run has written."""
    if not os.path.lexists(file):
        return None
    if not file.is_file() or file.stat().st_size > LARGEST:
        raise ValueError(f"{words.relative(file)} is no file of up to {LARGEST} bytes")
    try:  # not by pydantic's reader, which takes no path that is not UTF-8
        kept = json.loads(file.read_bytes())
    except RecursionError as error:
        raise ValueError("it is too deep") from error
    if isinstance(kept, dict):
        paths = {name for name, hint in get_type_hints(Kept).items() if hint == Path | None}
        texts = {name: one for name, one in kept.items() if name in paths and isinstance(one, str)}
        kept |= {name: Path(os.fsdecode(os.fsencode(one))) for name, one in texts.items()}
    return TypeAdapter(Kept).validate_python(kept)


def as_text(options: dict[str, Any]) -> str:
    """Options as they are typed, paths as short as can be."""
    said = []
    for name, value in options.items():
        for one in value if isinstance(value, list) else [value]:
            shown = words.relative(Path(one)) if os.path.isabs(str(one)) else one
            said.append(f"--{name.strip('_').replace('_', '-')} {shown}")
    return " ".join(said)


def pipeline_of(video: Path, work: Path, pipeline: str | None, console: Console, *stages: str) -> str:
    """The pipeline, or, where none is given, the only one of the clip that has finished results of these stages (of any if
    none is named); a line says which."""
    if pipeline:
        return pipeline
    found = []
    for folder in (Workspace(video, work, "default").root).glob("*/"):
        named = PIPELINE.fullmatch(folder.name) is not None
        links = ([folder / stage for stage in stages] or sorted(folder.iterdir())) if named else []
        done = [link for link in links if result_behind(link) and Stamp.read(link)]
        found += [folder.name] if done and len(done) >= len(stages) else []
    if len(found) != 1 or found == ["default"]:
        return "default"
    console.say(f"pipeline {found[0]}, the only one with results of {video.name}")
    return found[0]
