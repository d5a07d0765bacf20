"""The commands that show and change nothing: status, why, stages, view."""

from __future__ import annotations

import json
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from hugs_cli import options, pipelines, times, words
from hugs_cli.app_draw import finished
from hugs_cli.cache import child
from hugs_cli.cache.freshness import Verdict
from hugs_cli.cache.workspace import Stamp, Workspace
from hugs_cli.console import Console
from hugs_cli.options import (
    AnyPipeline,
    AsJson,
    PipelineName,
    PipelinesFile,
    RunOptions,
    Settings,
    Stages,
    Work,
    on_a_run,
    pipeline_of,
)
from hugs_cli.pipelines import UsageError
from stages.contract import listed

PAGE = "viewer.html"
STAMP_FACTS = ("key", "made", "seconds", "peak_memory_bytes", "params", "machine", "notes", "warnings", "accepted")


@on_a_run
def status(video: options.Video, given: RunOptions, as_json: AsJson = False) -> None:
    """Show which results are fresh, and why others are not."""
    console = Console()
    session = given.of_results(video, console).session(video)
    show(console, session.verdicts(list(session.pipeline.stages)), as_json, {})


@on_a_run
def why(video: options.Video, given: RunOptions, stages: Stages = None) -> None:
    """Show what a result was made of and what has changed."""
    console = Console()
    session = given.of_results(video, console).session(video)
    wanted = stages or list(session.pipeline.stages)
    verdicts, now = session.verdicts(session.pipeline.upstream(wanted)), child.versions(lambda module: True)
    for i, name in enumerate(wanted):
        if i:
            console.result()
        console.why(verdicts[name], now)


def list_stages(
    stages: Stages = None,
    pipeline: PipelineName = "default",
    set_: Settings = None,
    as_json: AsJson = False,
    pipelines_file: PipelinesFile = pipelines.FILE,
) -> None:
    """List the pipelines, and the stages and settings of one."""
    loaded, console = pipelines.load(pipeline, set_ or (), pipelines_file), Console()
    loaded.upstream(stages or [])  # refuses unknown names
    chosen = [loaded.stages[name] for name in stages or loaded.stages]
    if as_json:
        rows = [
            {
                "stage": one.name,
                "needs": one.needs,
                "doc": one.doc,
                "params": one.params.model_dump(mode="json", include={*listed(type(one.params))}),
            }
            for one in chosen
        ]
        console.result(json.dumps({"pipeline": pipeline, "doc": loaded.doc, "stages": rows}, indent=1))
        return
    for name, doc in pipelines.names(pipelines_file).items():
        console.result(f"{'*' if name == pipeline else ' '} {name:<12}{doc}")
    for stage in chosen:
        console.result(f"\n{stage.name}  <- {', '.join(stage.needs)}\n  {stage.doc}".rstrip())
        values = stage.params.model_dump(mode="json")
        for name, info in listed(type(stage.params)).items():
            doc = " ".join((info.description or "").split())
            console.result(f"    {name} = {values[name]}{'   ' + doc if doc else ''}")


def view(
    video: options.Video,
    open_: Annotated[
        bool, Option("--open/--no-open", help="Open it in the default browser, or only print its path.")
    ] = True,
    pipeline: AnyPipeline = None,
    work: Work = Path("work"),
) -> None:
    """Open the page on which person and scene move.

    It is one file that needs no network. The line on stdout is its path.
    """
    console = Console()
    pipeline = pipeline_of(video, work, pipeline, console, "export")
    finished(video, work, pipeline, "export")
    page = Workspace(video, work, pipeline).links / "export" / PAGE
    if not page.is_file():
        command = words.command("run", video, "export", pipeline=pipeline, work=work)
        facts = ["it was written without `viewer` in `export.formats`, or by an older version of hugs"]
        raise UsageError(f"the export of {video.name} holds no {PAGE}", f"`{command}`", facts)
    if open_ and not webbrowser.open(page.absolute().as_uri()):
        console.say("no browser was found to open it with")
    console.result(words.relative(page))


def show(console: Console, verdicts: dict[str, Verdict], as_json: bool, ahead: Mapping[str, times.Guess]) -> None:
    """Print verdicts, and how long a run will take of which stages are `ahead`, as rows or as JSON."""
    if not as_json:
        console.verdicts(verdicts)
        if ahead:
            console.result(f"a run takes {times.said(times.total(ahead.values()))}")
        return
    rows = [
        {"stage": name, "state": verdict.state, "reasons": list(map(str, verdict.reasons))}
        | stamp_facts(verdict.stamp or verdict.last)
        | ({"expected_seconds": round(ahead[name].seconds, 1)} if name in ahead else {})
        for name, verdict in verdicts.items()
    ]
    console.result(json.dumps(rows, indent=1))


def stamp_facts(stamp: Stamp | None) -> dict[str, Any]:
    """The part of a stamp that `--json` shows."""
    return {name: getattr(stamp, name) for name in STAMP_FACTS} if stamp else {}
