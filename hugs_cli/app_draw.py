"""The commands that draw the result of `hugs run`: render, animate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hugs_cli import options, words
from hugs_cli.cache import engine
from hugs_cli.cache.workspace import Stamp, Workspace
from hugs_cli.console import Console
from hugs_cli.direct import run_directly
from hugs_cli.options import DeviceName, PipelineName, Work
from hugs_cli.pipelines import UsageError
from stages.contract import Job


def render(
    video: options.Video,
    cameras: Annotated[
        Path, Option(help="Views to draw (npz: viewmats [C,4,4], Ks [C,3,3], width, height; the clip's world).")
    ],
    out: Annotated[Path, Option(help="Folder for the PNGs (with alpha).")],
    poses: Annotated[Path | None, Option(help="Body poses (npz); the clip's own if none.")] = None,
    only: Annotated[options.Only, Option(help="What to show.")] = options.Only.both,
    pipeline: PipelineName = "default",
    device: DeviceName = options.Device.cpu,
    work: Work = Path("work"),
) -> None:
    """Render the result of `hugs run` for your own cameras and poses."""
    (train,) = finished(video, work, pipeline, "train")
    check_files(cameras, poses)
    where = engine.device_of(device.value)
    console = Console()
    job = Job(out, where, emit=lambda event: console.say(event["text"]))
    run_directly("stages.views", job, {"only": only.value}, train=train, cameras=cameras, poses=poses)
    console.result(words.relative(out))


def animate(
    video: options.Video,
    motion: Annotated[Path, Argument(help="A BVH of any person's skeleton, or an npz of SMPL poses.")],
    out: Annotated[Path, Option(help="The video to write (mp4).")] = Path("motion.mp4"),
    only: Annotated[options.Only, Option(help="human: over white; both: in the scene.")] = options.Only.both,
    fps: Annotated[float, Option(min=0.1, max=240, help="Frames a second of the video.")] = 30,
    cameras: Annotated[
        Path | None, Option(help="As for render, one or one a frame; the middle frame's if none.")
    ] = None,
    motion_fps: Annotated[
        float | None, Option(min=0.1, help="Frames a second of the motion; the file's if none.")
    ] = None,
    up: Annotated[options.Up | None, Option(help="Up in the file; where pelvises point if none.")] = None,
    pipeline: PipelineName = "default",
    device: DeviceName = options.Device.cpu,
    work: Work = Path("work"),
) -> None:
    """Let the person perform a motion file.

    They stay where they stood in the clip. No network runs.
    """
    train, sfm, smpl = finished(video, work, pipeline, "train", "sfm", "smpl")
    check_files(motion, cameras)
    if only is options.Only.scene:
        raise UsageError("a scene alone does not move", "`--only human` or `--only both`")
    if out.suffix.lower() != ".mp4":
        raise UsageError(f"cannot write {out}: only .mp4 is written", "`--out motion.mp4`")
    where = engine.device_of(device.value)
    console = Console()
    console.started("animate", ())
    frames = 0

    def heard(event: dict[str, Any]) -> None:
        nonlocal frames
        if event["event"] == "note":
            console.say(event["text"])
        else:
            frames = event["total"]
            console.heard("animate", event)

    settings = {"fps": fps, "motion_fps": motion_fps, "up": up and up.value, "only": only.value}
    inputs = {"motion": motion, "train": train, "sfm": sfm, "smpl": smpl, "cameras": cameras}
    run_directly("stages.animate", Job(out, where, emit=heard), settings, **inputs)
    console.say(f"{words.count(frames, 'frame')}, {words.duration(frames / fps)} at {fps:g} fps")
    console.result(words.relative(out))


def finished(video: Path, work: Path, pipeline: str, *stages: str) -> list[Path]:
    """The folders of these stages as the pipeline last made them; UsageError where one is missing."""
    folders = []
    for stage in stages:
        folder = Workspace(video, work, pipeline).linked(stage)
        if folder is None or Stamp.read(folder) is None:
            command = f"hugs run {video}" + ("" if pipeline == "default" else f" --pipeline {pipeline}")
            raise UsageError(f"no finished {stage} of {video.name} in pipeline {pipeline}", f"`{command}`")
        folders.append(folder)
    return folders


def check_files(*paths: Path | None) -> None:
    """UsageError for a file that is named and not there."""
    for path in filter(None, paths):
        if not path.is_file():
            raise UsageError(f"no file at {path}", "check the path")
