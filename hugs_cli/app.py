"""The commands: parse, call, print, exit code (0 done, 1 a stage failed, 2 wrong usage, 130 stopped)."""

from __future__ import annotations

import json
import shutil
import signal
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

from hugs_cli import options, pipelines, times, words
from hugs_cli.app_compare import ablate, costs
from hugs_cli.app_compose import compose
from hugs_cli.app_draw import animate, render
from hugs_cli.app_export import export
from hugs_cli.app_fleet import fleet
from hugs_cli.app_show import list_stages, show, stamp_facts, status, view, why
from hugs_cli.cache import child, engine
from hugs_cli.cache import garbage as unused
from hugs_cli.cache.accept import accept as keep_results
from hugs_cli.cache.engine import Ran, RunStopped
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.report import PAGE
from hugs_cli.cache.workspace import Workspace, read_json, result_behind, size_of
from hugs_cli.console import Console, reasons_text
from hugs_cli.device import device_of
from hugs_cli.direct import in_words
from hugs_cli.options import (
    AsJson,
    DeviceName,
    DryRun,
    Force,
    PipelineName,
    PipelinesFile,
    RunOptions,
    Seed,
    Settings,
    Stages,
    Work,
    on_a_run,
)
from hugs_cli.pipelines import UsageError

HELP = "From a phone video to an animatable person and the scene, as 3D Gaussians."


class Groups(TyperGroup):
    """The commands, listed by what they are for."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the lists."""
        for title, names in COMMANDS.items():
            with formatter.section(title):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(100)) for name in names])


app = typer.Typer(
    cls=Groups,
    help=HELP,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def show_version(asked: bool) -> None:
    """Print the version and end."""
    if asked:
        versions = child.versions(lambda module: module == "torch")
        said = ", ".join(f"{name} {number}" for name, number in versions.items())
        Console().result(f"{said}; {': '.join(device_of('auto'))}")
        raise typer.Exit


@app.callback()
def hugs(
    version: Annotated[
        bool, Option("--version", callback=show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """The options before a command."""


@on_a_run
def run(
    video: options.Video,
    given: RunOptions,
    stages: Stages = None,
    device: DeviceName = options.Device.auto,
    force: Force = False,
    dry_run: DryRun = False,
    as_json: AsJson = False,
    within: Annotated[
        str | None,
        Option(metavar="TIME", help="Finish within a time such as 10m or 1h30m; results go to PIPELINE.TIME."),
    ] = None,
) -> None:
    """Run the pipeline; finished stages are reused.

    The last line on stdout is the path of the report, or of the last stage named.
    """
    session = given.session(video)
    run_pipeline(session, stages, device, force, dry_run, as_json, within)


def run_pipeline(
    session: Session,
    stages: list[str] | None,
    device: options.Device,
    force: bool = False,
    dry_run: bool = False,
    as_json: bool = False,
    within: str | None = None,
) -> None:
    """The common part of `run` and `demo`."""
    from hugs_cli.within import promise

    wanted = session.pipeline.upstream(stages or session.pipeline.stages)
    promised = promise(session, stages, within) if within else None
    session = promised.session if promised else session
    forced = frozenset(stages or wanted) if force else frozenset()
    console = Console(name_width=max(9, *(len(name) + 1 for name in wanted)))
    if dry_run:
        found = (promised.last_session() if promised else session).verdicts(wanted, forced)
        todo = [] if promised else [name for name, verdict in found.items() if not verdict.fresh]
        show(console, found, as_json, times.here(device_of(device)[0]).forecast(session, todo))
        return
    video, workspace = session.video, session.workspace
    session.check_sources()
    workspace.create()
    page = workspace.links / PAGE

    def opening(sure: bool) -> None:
        if session.pipeline.report and (sure or page.exists()):
            console.say(f"report: {words.relative(page)}")
        facts, place = clip_facts(workspace), words.relative(workspace.root)
        console.header(video.name, facts, session.pipeline.name, place, *device_of(device))
        if not forced:
            hint_accept(promised.last_session() if promised else session, wanted, console)

    console.opening.append(opening)
    if promised:
        ran, kept = promised.keep(forced, device.value, console)
    else:
        ran, kept = engine.run(session, wanted, forced, device.value, console, report=True), None
    path = page if session.pipeline.report and not stages else workspace.links / (stages or wanted)[-1]
    facts: dict[str, Any] = {
        "clip": video.name,
        "pipeline": session.pipeline.name,
        "result": str(path),
        "stages": rows(ran),
    }
    facts |= {"within": kept} if kept else {}
    console.result(json.dumps(facts, indent=1) if as_json else words.relative(path))


def rows(ran: list[Ran]) -> list[dict[str, Any]]:
    """The stages of a finished run as plain values."""
    return [
        {
            "stage": one.stage,
            "state": one.state,
            "reasons": list(map(str, one.reasons)),
            "folder": str(one.folder),
            **stamp_facts(one.stamp),
        }
        for one in ran
    ]


def hint_accept(session: Session, wanted: list[str], console: Console) -> None:
    """Before a run: one line if it would make results again although only code has changed."""
    if not any(map(result_behind, session.workspace.links.glob("*"))):
        return  # which spares a first run the reading of all code
    if stamps := [stamp for _, stamp in session.acceptable(wanted).values() if stamp]:
        workspace = session.workspace
        command = words.command("accept", session.video, pipeline=workspace.links.name, work=workspace.work)
        spent = words.duration(sum(stamp.seconds for stamp in stamps))
        console.say(f"only code has changed: {spent} of results are made again; `{command}` keeps them")


@on_a_run
def accept(video: options.Video, given: RunOptions, stages: Stages = None) -> None:
    """Keep existing results even though the code changed.

    Use it only if you know that the change does not alter the results.
    """
    console = Console()
    session = given.of_results(video, console).session(video)
    session.pipeline.upstream(stages or [])  # refuses unknown names
    session.check_sources()
    session.workspace.create()
    for name, (verdict, taken) in keep_results(session, stages or list(session.pipeline.stages), console).items():
        if taken and verdict.last and verdict.recipe:
            changed = reasons_text(verdict.reasons)
            console.result(f"{name} accepted: {verdict.last.key[:8]} is now {verdict.recipe.key[:8]}; {changed}")
        elif verdict.fresh:
            console.result(f"{name} is fresh: nothing to accept")
        else:
            console.result(f"{name} not accepted, only changes of code can be: {reasons_text(verdict.reasons)}")


def gc(video: options.Video, dry_run: DryRun = False, work: Work = Path("work")) -> None:
    """Delete results that no pipeline uses.

    That is: results that no pipeline of the clip links to, and leftovers of stopped runs.
    """
    workspace, console, freed = Workspace(video, work, "default"), Console(), 0
    if not workspace.store.is_dir():
        raise UsageError(f"no results of {video.name} in {work}", "choose the folder with `--work`")
    with workspace.lock(console.waiting):
        for folder in unused.garbage(workspace):
            freed += size_of(folder)
            said = "would remove" if dry_run else "removed"
            console.result(f"{said} {words.relative(folder)}  {words.size(size_of(folder))}")
            if not dry_run:
                shutil.rmtree(folder)
        for stray in unused.strays(workspace):
            console.say(f"{words.relative(stray)} is left alone: no run made it")
    console.result(f"{words.size(freed)} {'to free' if dry_run else 'freed'}")


def demo(
    pipeline: PipelineName = "default",
    set_: Settings = None,
    seed: Seed = None,
    device: DeviceName = options.Device.auto,
    work: Work = Path("work"),
    pipelines_file: PipelinesFile = pipelines.FILE,
) -> None:
    """Make a synthetic clip and run a pipeline on it.

    The folder truth/ beside the clip holds its true cameras and poses.
    """
    from hugs_cli.demo import synthetic_clip

    video = synthetic_clip(work, seed or 0, Console())
    given = RunOptions(set_, seed=seed, pipeline=pipeline, work=work, pipelines_file=pipelines_file)
    run_pipeline(given.session(video), None, device)


def doctor(
    fetch: Annotated[bool, Option("--fetch", help="Download missing model files.")] = False,
    as_json: AsJson = False,
) -> None:
    """Check the installation, and print how to get what is missing."""
    from hugs_cli.doctor import examine, fetch_missing

    console = Console()
    if fetch:
        fetch_missing(console.say)
    findings = examine()
    if as_json:
        console.result(json.dumps([asdict(finding) for finding in findings], indent=1))
    else:
        console.findings(findings)
    if not all(finding.ok or finding.optional for finding in findings):
        raise typer.Exit(1)


COMMANDS: dict[str, dict[str, Callable[..., None]]] = {
    "Make": {"run": run, "demo": demo, "fleet": fleet},
    "Look": {"view": view, "render": render, "animate": animate, "compose": compose, "export": export},
    "Know": {
        "status": status,
        "why": why,
        "costs": costs,
        "ablate": ablate,
        "stages": list_stages,
        "doctor": doctor,
    },
    "Keep": {"accept": accept, "gc": gc},
}
for group in COMMANDS.values():
    for name, command in group.items():
        app.command(name)(command)


def clip_facts(workspace: Workspace) -> str:
    """Length and size of the clip, once the frames stage has read them."""
    video: Any = read_json(workspace.links / "frames" / "frames.json").get("video")
    try:
        return f"{video['duration_s']:.1f} s, {video['frames']} frames, {video['width']}x{video['height']}"
    except (TypeError, KeyError, ValueError):
        return ""


def stop(signum: int, frame: Any) -> None:
    """Ctrl-C or SIGTERM while no stage runs."""
    raise RunStopped


def main() -> None:
    """The command `hugs`."""
    child.prepare()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    try:
        app()
    except RunStopped as stopped:
        Console().stopped(stopped.stage, stopped.continues)
        sys.exit(130)
    except Exception as error:
        said = in_words(error, f"hugs {' '.join(sys.argv[1:2])}")
        Console().error(said)
        sys.exit(2 if isinstance(said, UsageError) else 1)
