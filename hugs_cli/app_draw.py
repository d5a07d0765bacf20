"""The commands that draw the result of `hugs run`: render, animate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hugs_cli import film as films
from hugs_cli import options, words
from hugs_cli.app_compose import shoot
from hugs_cli.cache.workspace import Stamp, Workspace, clip_name
from hugs_cli.console import Console
from hugs_cli.device import device_of
from hugs_cli.direct import run_directly
from hugs_cli.options import AnyPipeline, DeviceName, Overwrite, Work, pipeline_of
from hugs_cli.outputs import check_out, remembering
from hugs_cli.pipelines import UsageError
from stages.contract import Job

SIZE = (640, 640)  # px of a film of an avatar alone
Clip = Annotated[
    Path | None, Argument(metavar="[VIDEO]", help="The video of `hugs run`; not with --avatar.", show_default=False)
]
AvatarFile = Annotated[
    Path | None,
    Option("--avatar", help="An exported avatar.npz or avatar_splats.glb in place of VIDEO; needs no work folder."),
]
SceneFile = Annotated[
    Path | None,
    Option(
        "--scene",
        help="A scene of Gaussians (.ply, .spz, .npz) in place of the trained one; for animate also a run's folder.",
    ),
]
SceneAxes = Annotated[
    options.Axes, Option("--scene-axes", help="Axes of the --scene file: y_down, as trainers write it, or y_up.")
]
Who = Annotated[int, Option(min=1, help="Number of the person, if the run of VIDEO has several.")]
Spot = Annotated[
    tuple[float, float, float],
    Option(
        help="Where the soles stand, m: in a --scene file X Y Z in its axes; in a run, LEFT of its person, 0, AHEAD."
    ),
]
CameraName = Annotated[
    str | None,
    Option(
        metavar="KIND|FILE",
        help="clip, still, follow, orbit or before, as in a film; or a file as for render, with a camera, or one a frame.",
        show_default="the clip's; before, where that sees backs",
    ),
]


def render(
    out: Annotated[Path, Option(help="Folder for the PNGs (with alpha).")],
    video: Clip = None,
    cameras: Annotated[
        Path | None,
        Option(help="Views to draw (npz: viewmats [C,4,4], Ks [C,3,3], width, height; the clip's world)."),
    ] = None,
    poses: Annotated[Path | None, Option(help="Body poses (npz); by default the clip's.")] = None,
    avatar: AvatarFile = None,
    scene: SceneFile = None,
    scene_axes: SceneAxes = options.Axes.y_down,
    who: Who = 1,
    only: Annotated[options.Only, Option(help="What to show.")] = options.Only.both,
    force: Overwrite = False,
    pipeline: AnyPipeline = None,
    device: DeviceName = options.Device.auto,
    work: Work = Path("work"),
) -> None:
    """Render the result for your own cameras and poses.

    An exported avatar (--avatar) without cameras is drawn from all sides. It overwrites its own pictures;
    a folder with other files needs --force.
    """
    check_source(video, avatar, who)
    if cameras is None and (avatar is None or scene is not None):
        raise UsageError("no cameras to draw for", "`--cameras views.npz`; only an avatar alone is drawn without")
    if only is options.Only.scene and avatar is not None and scene is None:
        raise UsageError(f"{avatar} has no scene", "`--only human`, or a scene with `--scene room.ply`")
    console, train, smpl = Console(), None, None
    if video is not None:
        train, smpl = finished(video, work, pipeline_of(video, work, pipeline, console, "train"), "train", "smpl")
    check_files(cameras, poses, avatar, scene)
    check_out(out, work, (video, cameras, poses, avatar, scene), force, is_folder=True)
    where, _ = device_of(device.value)
    said = {"warning": "warning: "}
    job = Job(
        out, where, emit=remembering(work, lambda event: console.say(said.get(event["event"], "") + event["text"]))
    )
    only = options.Only.human if avatar and not scene else only
    settings = {"only": only.value, "who": who, "scene_axes": scene_axes.value}
    inputs = {"train": train, "smpl": smpl, "avatar": avatar, "scene": scene, "cameras": cameras, "poses": poses}
    run_directly("stages.commands.views", job, settings, **inputs)
    console.result(words.relative(out))


def animate(
    video: Clip = None,
    motion: Annotated[
        Path | None,
        Argument(metavar="MOTION", help="A BVH of any person's skeleton, or an npz of SMPL poses.", show_default=False),
    ] = None,
    avatar: AvatarFile = None,
    scene: SceneFile = None,
    scene_axes: SceneAxes = options.Axes.y_down,
    at: Spot = (0, 0, 0),
    who: Who = 1,
    out: Annotated[Path | None, Option(help="The video to write (mp4).", show_default="CLIP-MOTION.mp4")] = None,
    only: Annotated[options.Only, Option(help="human: over white; both: in the scene.")] = options.Only.both,
    fps: Annotated[float, Option(min=0.1, max=240, help="Frames a second of the video.")] = 30,
    camera: CameraName = None,
    motion_fps: Annotated[
        float | None, Option(min=0.1, max=10_000, help="Frames a second of the motion; by default the file's.")
    ] = None,
    up: Annotated[
        options.Up | None, Option(help="Axis that points up in the motion file; by default that of the pelvis.")
    ] = None,
    face: Annotated[Path | None, Option(help="A face capture (csv): a time and the 52 shapes.")] = None,
    force: Overwrite = False,
    pipeline: AnyPipeline = None,
    device: DeviceName = options.Device.auto,
    work: Work = Path("work"),
) -> None:
    """Let the person perform a motion file.

    `hugs animate VIDEO MOTION`, or `hugs animate --avatar FILE MOTION`. The person stands where they stood in the clip, or in
    the scene of another run: `--scene work/kitchen/default`. No network runs. It overwrites its own videos;
    any other file needs --force.
    """
    if avatar is not None and motion is None:
        video, motion = None, video
    check_source(video, avatar, who)
    if motion is None:
        raise UsageError("no motion to perform", "`hugs animate VIDEO moves.bvh`")
    run_folder = None
    if video is not None:
        pipeline = pipeline_of(video, work, pipeline, Console(), "train")
        finished(video, work, pipeline, *films.STAGES)
        run_folder = Workspace(video, work, pipeline).links
    views = Path(camera) if camera and films.is_path("camera", camera) else None
    check_files(motion, face, views, avatar, None if scene is None or scene.is_dir() else scene)
    if only is options.Only.scene:
        raise UsageError("a scene alone does not move", "`--only human` or `--only both`")
    name = clip_name(video) if video else Path(avatar or "avatar").stem
    out = out or Path(f"{name}-{motion.stem}.mp4" if who == 1 else f"{name}-{who}-{motion.stem}.mp4")
    person: dict[str, Any] = {"avatar": run_folder or avatar, "who": who, "motion": str(motion)}
    person |= {"motion_fps": motion_fps, "up": up and up.value, "face": face}
    film: dict[str, Any] = {"fps": fps, "only": only.value, "out": {"film": out}, "scene_axes": scene_axes.value}
    film |= staged(person, scene, at, camera)
    console, given = Console(), [path for path in (video, motion, face, views, avatar, scene) if path is not None]
    for path in animated(film, device.value, work, force, given, console):
        console.result(words.relative(path))


def animated(
    film: dict[str, Any], device: str, work: Path, force: bool, given: list[Path], console: Console
) -> list[Path]:
    """Make the film of one person, and name it; `given` files are not written over, nor those that the film reads."""
    out = film["out"]["film"]
    if out.suffix.lower() != ".mp4":
        raise UsageError(f"cannot write {out}: only .mp4 is written", "`--out motion.mp4`")
    return shoot(films.checked(film, "animate"), None, device, work, force, given, console, "animate")


def staged(
    person: dict[str, Any], scene: Path | None, at: tuple[float, float, float], camera: str | None
) -> dict[str, Any]:
    """A film's one `person`, and where they stand: in the scene of another run, of their own if they are of a run, or alone."""
    run = person["avatar"] if person["avatar"].is_dir() else None
    seen = {"camera": camera or "auto"}
    if scene is not None and scene.is_dir():
        return {"people": [person | {"at": (at[0], at[2])}], "scene": scene} | seen
    if run is not None:
        return {"people": [person], "scene": run, "gaussians": scene} | seen
    floor = {} if scene is None else {"ground": {"point": at}}
    size = {} if films.is_path("camera", seen["camera"]) else {"size": SIZE}
    return {"people": [person], "scene": scene} | seen | size | floor


def check_source(video: Path | None, avatar: Path | None, who: int) -> None:
    """UsageError unless there is either a video or an avatar file, which holds one person."""
    if (video is None) == (avatar is None):
        problem = "nobody to draw" if video is None else f"{video} and {avatar} are two people, one is drawn"
        raise UsageError(problem, "give a VIDEO that `hugs run` has finished, or `--avatar avatar.npz`")

    if avatar is not None and who > 1:
        raise UsageError(
            f"{avatar} holds one person: there is no person {who}", "leave out `--who`; it goes with a VIDEO"
        )


def finished(video: Path, work: Path, pipeline: str, *stages: str) -> list[Path]:
    """The folders of these stages as the pipeline last made them; UsageError where one is missing or of another film."""
    if not video.exists():
        raise UsageError(f"no video at {video}", "check the path")
    command = words.command("run", video, pipeline=pipeline, work=work)
    folders, workspace = [], Workspace(video, work, pipeline)
    for stage in stages:
        folder = workspace.linked(stage)
        stamp = Stamp.read(folder) if folder else None
        if folder is None or stamp is None:
            raise UsageError(f"no finished {stage} of {video.name} in pipeline {pipeline}", f"`{command}`")
        check_film(video, workspace, stamp, f"`{command}` brings it up to date; `--work` keeps films of one name apart")
        folders.append(folder)
    return folders


def check_film(video: Path, workspace: Workspace, stamp: Stamp, hint: str) -> None:
    """UsageError for a result that goes back to another film than `video`: films of one name share a work folder."""
    film, films = workspace.source("video", video), sorted(workspace.films(stamp))
    if film not in films:
        made_from = " or ".join(one[:12] for one in films) or "unknown: results before it are gone"
        facts = [f"digest of {video}: {str(film)[:12]}", f"of the film behind {stamp.stage}: {made_from}"]
        raise UsageError(f"{stamp.stage} was not made from {video}, or that has changed since", hint, facts)


def check_files(*paths: Path | None) -> None:
    """UsageError for a file that is named and not there."""
    for path in filter(None, paths):
        if not path.is_file():
            raise UsageError(f"no file at {path}", "check the path")
