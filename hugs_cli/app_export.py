"""The command that brings files of a finished run to where the user wants them: export."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from hugs_cli import film as films
from hugs_cli import options, pipelines, words
from hugs_cli.app_draw import finished
from hugs_cli.cache import engine
from hugs_cli.cache.freshness import Session, Verdict
from hugs_cli.cache.workspace import Stamp, Workspace
from hugs_cli.console import Console
from hugs_cli.options import AnyPipeline, DeviceName, Overwrite, PipelinesFile, RunOptions, Settings, Work
from hugs_cli.outputs import check_out, remember_out
from hugs_cli.pipelines import UsageError
from stages.contract import whole

STAGE = "export"
LINKS = ".exports"  # of a clip: what this command made last, which `hugs gc` keeps
ELSEWHERE = "choose another `--out`"


def export(
    video: options.Video,
    out: Annotated[Path, Option(help="Folder for the files.")],
    formats: Annotated[
        str | None,
        Option(help="What to write, such as `ply,glb,usd`; `hugs stages export` lists all.", show_default=False),
    ] = None,
    names: Annotated[str | None, Option(help="Names of joints: smpl, mixamo, vrm, unreal.")] = None,
    motion: Annotated[str | None, Option(help="Motion of bvh and ..._motion: clip, wave, all and others.")] = None,
    triangles: Annotated[
        int | None, Option(help="Approximate number of triangles of the mesh.", show_default="20000")
    ] = None,
    texture: Annotated[int | None, Option(help="Width of the mesh's texture, px.", show_default="2048")] = None,
    spz_axes: Annotated[options.Axes | None, Option(help="Which way y points in .spz; y_down as in a .ply.")] = None,
    set_: Settings = None,
    force: Overwrite = False,
    pipeline: AnyPipeline = None,
    device: DeviceName = options.Device.auto,
    work: Work = Path("work"),
    pipelines_file: PipelinesFile = pipelines.FILE,
) -> None:
    """Write avatar and scene of a finished run into a folder of yours.

    Options change the run's settings for these files; the run's own export does not change.
    """
    asked = {
        "names": names,
        "motion": motion,
        "triangles": triangles,
        "texture": texture,
        "spz_axes": spz_axes and spz_axes.value,
    }
    values: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    if formats is not None:
        values["formats"] = [one.strip() for one in formats.split(",") if one.strip()]
        if not values["formats"]:
            raise UsageError("--formats names none", f"`hugs stages {STAGE}` lists them")
    console = Console()
    given = RunOptions(pipeline=pipeline, work=work, pipelines_file=pipelines_file).of_results(video, console)
    given = replace(given, set_=[*(given.set_ or ()), *(set_ or ())])
    for path in exported(video, out, values, given, device.value, force, console):
        console.result(words.relative(path))


def exported(
    video: Path, out: Path, values: dict[str, Any], given: RunOptions, device: str, force: bool, console: Console
) -> Iterator[Path]:
    """Write the files of a finished run, with settings of the stage that differ from the run's, and name them.

    Whatever else the run was `given` is taken as it is; UsageError where it is not finished, or `out` cannot be written.
    """
    changes = [f"{STAGE}.{name}={json.dumps(value)}" for name, value in values.items()]
    session, work = replace(given, set_=[*(given.set_ or ()), *changes]).session(video), given.work
    before = taken(session)
    check_out(out, work, (video,), force=True, is_folder=True)
    make_folder(out)
    shelf = Workspace(video, work, LINKS)
    if (own := session.workspace.linked(STAGE)) and not shelf.linked(STAGE):
        shelf.link(STAGE, own)  # so that what differs from the run's own export can be said
    aside = replace(session, workspace=shelf, options={})
    (made,) = engine.run(aside, [STAGE], frozenset(), device, console, before)
    yield from copied(made.folder, made.stamp, out, work, force)


def taken(session: Session) -> dict[str, Verdict]:
    """The results before the export as the pipeline has them, whatever has changed since; UsageError where one is missing."""
    *before, _ = session.pipeline.upstream([STAGE])
    place = session.workspace
    found = {}
    for stage, folder in zip(before, finished(session.video, place.work, place.links.name, *before), strict=True):
        found[stage] = Verdict(stage, folder=folder, stamp=Stamp.read(folder))
    films.check_together(STAGE, place.links)
    return found


def make_folder(out: Path) -> None:
    """The folder, made if need be; UsageError where nothing can be written into it."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UsageError(f"cannot write to {out}", ELSEWHERE, [str(error.strerror)]) from error


def copied(result: Path, stamp: Stamp, out: Path, work: Path, force: bool) -> Iterator[Path]:
    """Copy all files of a result into a folder, whole or not at all, and name them; folders of many by their own name.

    UsageError, and nothing is copied, where one would take the place of what others made.
    """
    for name in stamp.files:
        check_out(out / name, work, (), force)
    shown = dict.fromkeys(name.partition("/")[0] for name in stamp.files)
    for name in stamp.files:
        target = out / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with whole(target, partial(remember_out, target, work=work)) as part:
            shutil.copyfile(result / name, part)
    yield from (out / name for name in shown)
